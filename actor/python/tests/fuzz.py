"""Random calls with random arguments: each works or raises an exception of Python's.

    python fuzz.py CALLS [SEED]

A crash of the interpreter ends this program, and so does a panic: neither is an ``Exception``.
"""

import copy
import pickle
import random
import sys
import time
import warnings

import numpy as np

import skein_rl
from skein_rl import _core

SNAPSHOT = None


def numbers(rng):
    """A number, of the usual and the odd kinds."""
    return rng.choice(
        [0, 1, 2, 3, -1, 5, 255, 256, 1 << 31, 1 << 63, (1 << 64) - 1, 1 << 64, 1 << 200, 0.5, -0.3]
        + [1e-30, 1e300, float("nan"), float("inf"), -float("inf"), True, False]
    )


def odd(rng, depth=0):
    """Any object."""
    kinds = [
        lambda: numbers(rng),
        lambda: None,
        lambda: "training",
        lambda: "random",
        lambda: rng.choice(["", "x" * 1000, "\0", "\ud800", "ünïcode", "/", ".", "/dev/zero"]),
        lambda: rng.randbytes(rng.randrange(9)),
        lambda: object(),
        lambda: array(rng),
        lambda: [odd(rng, depth + 1) for _ in range(rng.randrange(4))] if depth < 4 else [],
        lambda: tuple(odd(rng, depth + 1) for _ in range(rng.randrange(3))) if depth < 4 else (),
        lambda: {key(rng): odd(rng, depth + 1) for _ in range(rng.randrange(4))} if depth < 4 else {},
    ]
    return rng.choice(kinds)()


def key(rng):
    return rng.choice(
        ["vehicle", "camera", "reward", "max_steps", "range_m", "preset", "collision", "course"]
        + ["level", "course_seed", "reset_mask", "depth", "velocity", "layout", 3, None, ""]
    )


def array(rng):
    shape = rng.choice([(), (0,), (1,), (2,), (3,), (1, 2), (2, 2), (3, 2), (2, 3), (1, 1, 72, 128)])
    kind = rng.choice([np.float32, np.float64, np.int8, np.uint8, np.bool_, np.complex64, object, "U3"])
    made = np.zeros(shape, dtype=kind)
    if made.dtype.kind == "f":
        made += np.array(float(rng.choice([0, 0.5, 2, np.nan, np.inf, 1e-40, 1e38])), dtype=kind)
    return made[::-1] if made.ndim and rng.random() < 0.2 else made


def keywords(rng):
    some = {
        "courses": lambda: rng.choice(["training", "random", ["training", "random"], odd(rng)]),
        "levels": lambda: rng.choice([1, 2, [1, 2, 3], odd(rng)]),
        "generated_share": lambda: rng.choice([0, 0.5, 1, odd(rng)]),
        "max_steps": lambda: rng.choice([1, 5, 160, odd(rng)]),
        "vehicle": lambda: rng.choice([{"preset": "point"}, {"preset": odd(rng)}, odd(rng)]),
        "reward": lambda: rng.choice([{"collision": -2}, {"collision": numbers(rng)}, odd(rng)]),
        "camera": lambda: rng.choice([{"range_m": 10}, {"range_m": numbers(rng)}, odd(rng)]),
        "disturbances": lambda: rng.choice([{"share": 1.0, "mass_spread": 0.1}, odd(rng)]),
        "generator": lambda: rng.choice([{"shapes": ["circle"]}, odd(rng)]),
        "simulator": lambda: odd(rng),
        "observation": lambda: rng.choice([["velocity"], ["depth"], ["latent"], odd(rng)]),
        "render_mode": lambda: rng.choice(["rgb_array", None, odd(rng)]),
        "encoder": lambda: rng.choice([SNAPSHOT, odd(rng)]),
        "config": lambda: odd(rng),
        "smell": lambda: odd(rng),
    }
    return {name: some[name]() for name in rng.sample(list(some), rng.randrange(4))}


def new_env(rng):
    if rng.random() < 0.5:
        return skein_rl.CorridorEnv(**keywords(rng))
    count = rng.choice([1, 2, 3, odd(rng)])
    # A fleet of thousands is no crash, but slow.
    count = count if not isinstance(count, (int, float)) or count < 9 else 3
    mode = rng.choice(["NEXT_STEP", "SAME_STEP", "DISABLED", "NextStep", odd(rng)])
    return skein_rl.make_vec(
        count, rng.choice([1, 2, odd(rng)]), autoreset_mode=mode, **keywords(rng)
    )


def act(rng, env):
    """Mostly a sound call, so that episodes go on."""
    count = getattr(env, "num_envs", None)
    sound = np.random.default_rng(rng.randrange(99)).uniform(-1, 1, (2,) if count is None else (count, 2))
    return env.step(sound if rng.random() < 0.8 else odd(rng))


def reset(rng, env):
    options = rng.choice([None, {}, {"level": numbers(rng)}, {key(rng): odd(rng)}, odd(rng)])
    return env.reset(seed=rng.choice([None, 1, 7, numbers(rng), odd(rng)]), options=options)


def observe(rng):
    sound = {
        "depth": np.zeros((1, 72, 128), np.uint8),
        "velocity": np.zeros(3, np.float32),
        "previous_action": np.zeros(2, np.float32),
    }
    if rng.random() < 0.6:
        sound[rng.choice(list(sound))] = odd(rng)
    return sound if rng.random() < 0.9 else odd(rng)


def raw(rng, env):
    """The compiled part, without the checks before it."""
    fleet = getattr(env, "_fleet", None)
    calls = [
        lambda: fleet.step(odd(rng)),
        lambda: fleet.step(rng.randbytes(8 * rng.randrange(4))),
        lambda: fleet.reset([numbers(rng)], [rng.choice([True, False, odd(rng)])]),
        lambda: fleet.restore(odd(rng)),
        lambda: fleet.restore([(1, 2, (0, 1, rng.choice([-1, 0, 9]), 3, 1, [(0.5, numbers(rng))]))]),
        lambda: fleet.chase(numbers(rng)),
        lambda: fleet.view(numbers(rng)),
        lambda: _core.Fleet(odd(rng), 1, 1, "NextStep"),
        lambda: _core.Task(odd(rng), odd(rng), odd(rng), odd(rng), odd(rng)),
        lambda: _core.Policy(odd(rng), 1),
        lambda: _core.parse_toml(odd(rng)),
        lambda: _core.read_config(odd(rng)),
    ]
    return rng.choice(calls)()


def main(calls, seed):
    rng = random.Random(seed)
    policy = skein_rl.Policy.load(SNAPSHOT, threads=1)
    envs = [skein_rl.CorridorEnv(), skein_rl.make_vec(2, 2)]
    done, worked, began = 0, 0, time.time()
    while done < calls:
        env = rng.choice(envs)
        kind = rng.choices(
            ["step", "reset", "new", "copy", "close", "render", "act", "raw", "oracle"],
            [80, 5, 1, 0.5, 0.3, 0.5, 3, 8, 2],
        )[0]
        done += 1
        if done % 50_000 == 0:
            print(f"{done} calls, {worked} worked, {time.time() - began:.0f} s", flush=True)
        try:
            if kind == "step":
                act(rng, env)
            elif kind == "reset":
                reset(rng, env)
            elif kind == "new":
                envs[rng.randrange(len(envs))] = new_env(rng)
            elif kind == "copy":
                copied = rng.choice([copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
                envs[rng.randrange(len(envs))] = copied(env)
            elif kind == "close":
                env.close()
            elif kind == "render":
                env.render()
            elif kind == "act":
                if rng.random() < 0.1:
                    policy.reset(odd(rng), seed=odd(rng))
                    policy.reset()
                policy.act(observe(rng), episode_start=rng.choice([None, True, odd(rng)]))
            elif kind == "raw":
                raw(rng, env)
            else:
                getattr(env, "oracle_action", getattr(env, "oracle_actions", None))()
            worked += 1
        except Exception:
            # An environment that cannot fly any more makes room for others.
            if rng.random() < 0.05 or getattr(env, "_fleet", None) is None:
                made = rng.choice([skein_rl.CorridorEnv, lambda: skein_rl.make_vec(2)])()
                made.reset(seed=1)
                envs[next(place for place, one in enumerate(envs) if one is env)] = made
    print(f"{done} calls, {worked} worked, {time.time() - began:.0f} s, seed {seed}")


if __name__ == "__main__":
    import pathlib

    SNAPSHOT = pathlib.Path(__file__).resolve().parents[3] / "configs/snapshots/generalist.safetensors"
    warnings.simplefilter("ignore")
    np.seterr(all="ignore")
    main(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 1)
