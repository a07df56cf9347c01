"""Steps a second of the vector environment, beside as many simulators alone on as many threads.

    python vector.py [ENVIRONMENTS] [ROUNDS]

Both fly random actions with depth image and reward. Rounds alternate, so that other work on the
machine slows both; the processor's time counts only this process.
"""

import sys
import time

import numpy as np

import skein_rl
from skein_rl import _core

STEPS = 6400


def spent(work):
    """Wall and processor seconds of a call."""
    wall, processor = time.perf_counter(), time.process_time()
    work()
    return np.array([time.perf_counter() - wall, time.process_time() - processor])


def main(environments, rounds):
    print("threads  environment        steps/s    share of the simulator (wall, processor)")
    for threads in (1, 2):
        for name, keywords in (("training course", {}), ("random courses", {"courses": "random"})):
            env = skein_rl.make_vec(environments, threads, autoreset_mode="SAME_STEP", **keywords)
            env.reset(seed=1)
            rng = np.random.default_rng(1)

            def ours():
                for _ in range(STEPS // environments):
                    actions = rng.uniform(-1, 1, (environments, 2)).astype(np.float32)
                    env.step(actions)

            def alone():
                _core.simulate(env._task, environments, threads, STEPS // environments)

            ours(), alone()
            pairs = [(spent(ours), spent(alone)) for _ in range(rounds)]
            mine, theirs = (np.median([pair[side] for pair in pairs], axis=0) for side in (0, 1))
            share = theirs / mine
            rate = STEPS / mine[0]
            print(f"{threads:7}  {name:15} {rate:10.0f}    {share[0]:.1%}, {share[1]:.1%}")


if __name__ == "__main__":
    main(*(int(argument) for argument in (sys.argv[1:] + ["64", "15"][len(sys.argv) - 1 :])))
