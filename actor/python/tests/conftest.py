"""Where the repository's files lie, and what tests share."""

import os
import pathlib

import numpy as np
import pytest

import skein_rl

REPOSITORY = pathlib.Path(__file__).resolve().parents[3]
CONFIGS = REPOSITORY / "configs"


@pytest.fixture(scope="session")
def generalist():
    return CONFIGS / "snapshots" / "generalist.safetensors"


@pytest.fixture(scope="session")
def policy(generalist):
    return skein_rl.Policy.load(generalist, threads=2)


@pytest.fixture(scope="session")
def recording(tmp_path_factory, generalist):
    """A recording that skein-evaluate wrote, if launch/python.sh found that program."""
    program = os.environ.get("SKEIN_EVALUATE")
    if not program:
        pytest.skip("SKEIN_EVALUATE names no program: launch/python.sh sets it once it is built")
    import subprocess

    path = tmp_path_factory.mktemp("recording") / "episodes.npz"
    command = [*program.split(), "--snapshot", generalist, "--episodes", "2", "--record", path]
    courses = sorted((CONFIGS / "courses").glob("*.toml"))
    for course in courses:
        command += ["--course", course]
    subprocess.run(command, check=True, capture_output=True)
    return path


def same(one, other):
    """Raises if two observations, or dictionaries of arrays, differ in a bit."""
    assert one.keys() == other.keys()
    for name in one:
        a, b = np.asarray(one[name]), np.asarray(other[name])
        assert a.dtype == b.dtype and a.shape == b.shape, name
        assert a.tobytes() == b.tobytes(), name


def rollout(env, seed, steps, policy=None, options=None):
    """Actions from a seeded generator, episodes one after another; every result."""
    rng = np.random.default_rng(seed)
    results = [env.reset(seed=seed, options=options)]
    for _ in range(steps):
        results.append(env.step(rng.uniform(-1, 1, 2).astype(np.float32)))
        if results[-1][2] or results[-1][3]:
            results.append(env.reset())
    return results
