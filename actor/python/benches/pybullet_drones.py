"""Depth images a second, beside gym-pybullet-drones on the same machine in one run.

    python pybullet_drones.py [ROUNDS]

Both fly random velocities on one thread and return a depth image of 128 x 72 pixels with each step.
gym-pybullet-drones: `HoverAviary` with its camera and its four landmarks, one image a step of 1/24
s. Its renderer draws colours and shadows too, so its best case is a second row: a bare call for an
image without shadows and without segmentation, and no physics. Skein's step is 0.5 s of flight.

Rounds alternate, so that other work on the machine slows all alike. Shown are medians; a processor
second counts this process alone, all its threads.
"""

import contextlib
import io
import sys
import time
import warnings

import numpy as np
import pybullet

import skein_rl

with warnings.catch_warnings():
    # It asks setuptools for its files, in a way that will be removed.
    warnings.simplefilter("ignore")
    from gym_pybullet_drones.envs import HoverAviary
    from gym_pybullet_drones.utils.enums import ActionType, ObservationType

WIDTH, HEIGHT = 128, 72
# The camera takes 24 images a second of simulated time: one a step.
CONTROL_HZ = 24
DRONES = 64
# Calls of a round: enough of each for a quarter of a second or more.
THEIRS, BARE, OURS, MANY = 20, 40, 1000, 30


class Theirs:
    """gym-pybullet-drones with a camera of Skein's size."""

    def __init__(self):
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            self.env = HoverAviary(
                obs=ObservationType.RGB, act=ActionType.VEL, ctrl_freq=CONTROL_HZ
            )
            # It has no setting for the size.
            self.env.IMG_RES = np.array([WIDTH, HEIGHT])
            self.env.rgb = np.zeros((1, HEIGHT, WIDTH, 4))
            self.env.dep, self.env.seg = np.ones((2, 1, HEIGHT, WIDTH))
            self.env.reset(seed=1)
        self.rng = np.random.default_rng(1)

    def step(self):
        action = self.rng.uniform(-1, 1, (1, 4)).astype(np.float32)
        _, _, terminated, truncated, _ = self.env.step(action)
        if terminated or truncated:
            self.env.reset()

    def depth(self):
        """Its last depth image, ``[HEIGHT, WIDTH]``, in [0, 1]."""
        return self.env.dep[0]

    def bare(self):
        """One image from where the drone is: the renderer alone, at its least."""
        eye = self.env.pos[0] + np.array([0, 0, self.env.L])
        client = self.env.CLIENT
        view = pybullet.computeViewMatrix(eye, eye + np.array([1, 0, 0]), [0, 0, 1])
        lens = pybullet.computeProjectionMatrixFOV(60.0, WIDTH / HEIGHT, self.env.L, 1000.0)
        *_, depth, _ = pybullet.getCameraImage(
            WIDTH,
            HEIGHT,
            view,
            lens,
            shadow=0,
            flags=pybullet.ER_NO_SEGMENTATION_MASK,
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=client,
        )
        return np.reshape(depth, (HEIGHT, WIDTH))


class Ours:
    """Skein's training course: one drone, and many in one thread."""

    def __init__(self):
        self.env = skein_rl.CorridorEnv()
        self.envs = skein_rl.make_vec(DRONES, 1, autoreset_mode="SAME_STEP")
        self.env.reset(seed=1), self.envs.reset(seed=1)
        self.rng = np.random.default_rng(1)

    def step(self):
        action = self.rng.uniform(-1, 1, 2).astype(np.float32)
        observation, _, terminated, truncated, _ = self.env.step(action)
        if terminated or truncated:
            observation, _ = self.env.reset()
        return observation["depth"]

    def step_many(self):
        action = self.rng.uniform(-1, 1, (DRONES, 2)).astype(np.float32)
        return self.envs.step(action)[0]["depth"]


def rates(call, calls, images):
    """Images a wall second and a processor second."""
    wall, processor = time.perf_counter(), time.process_time()
    for _ in range(calls):
        call()
    spent = np.array([time.perf_counter() - wall, time.process_time() - processor])
    return calls * images / spent


def main(rounds):
    theirs, ours = Theirs(), Ours()
    for image in (theirs.bare(), ours.step()[0], ours.step_many()[0, 0]):
        if image.shape != (HEIGHT, WIDTH) or image.min() == image.max():
            sys.exit("pybullet_drones.py: an image is empty or of another size")
    theirs.step()
    if theirs.depth().min() == theirs.depth().max():
        sys.exit("pybullet_drones.py: the image of HoverAviary is empty")
    rows = {
        "gym-pybullet-drones, its step": (theirs.step, THEIRS, 1),
        "gym-pybullet-drones, bare image": (theirs.bare, BARE, 1),
        "CorridorEnv.step": (ours.step, OURS, 1),
        f"make_vec({DRONES}), one thread": (ours.step_many, MANY, DRONES),
    }
    measured = [[rates(*row) for row in rows.values()] for _ in range(rounds)]
    # [rounds, rows, (wall, processor)]
    measured = np.array(measured)
    times = np.median(measured / measured[:, :1], axis=0)
    against_bare = np.median(measured / measured[:, 1:2], axis=0)
    print(f"{WIDTH} x {HEIGHT} images a second, one thread: wall, processor; times as many as")
    print(f"{'':32} {'wall':>8} {'processor':>10} {'its step':>10} {'bare image':>11}")
    for place, (name, rate) in enumerate(zip(rows, np.median(measured, axis=0))):
        print(
            f"{name:32} {rate[0]:8.0f} {rate[1]:10.0f} {times[place, 1]:9.1f}x"
            f" {against_bare[place, 1]:10.1f}x"
        )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 15)
