"""Where the repository's files lie, and what tests share."""

import os
import pathlib
import subprocess
import threading

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
    """A recording that skein-evaluate wrote, of every shipped course."""
    path = tmp_path_factory.mktemp("recording") / "episodes.npz"
    return record(path, generalist, 2, sorted((CONFIGS / "courses").glob("*.toml")))


@pytest.fixture(scope="session")
def same_episode(tmp_path_factory, generalist):
    """An episode recorded twice: as .npz and as .mcap."""
    folder = tmp_path_factory.mktemp("same")
    courses = [CONFIGS / "courses" / "training.toml"]
    return [record(folder / name, generalist, 1, courses) for name in ("one.npz", "one.mcap")]


def record(path, snapshot, episodes, courses):
    """Records episodes on each of the courses, if launch/python.sh found skein-evaluate."""
    program = os.environ.get("SKEIN_EVALUATE")
    if not program:
        pytest.skip("SKEIN_EVALUATE names no program: launch/python.sh sets it once it is built")
    command = [*program.split(), "--snapshot", snapshot, "--episodes", str(episodes), "--record", path]
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


def snapshot_file(path, config, latent, step_len, history, outputs, width=16, seed=1):
    """Writes a snapshot with random parameters, as a run does. ``config``: its TOML."""
    import struct

    from safetensors.numpy import save_file
    from xxhash import xxh3_64

    shapes, channels = {}, (1, 32, 64, 128, 256)
    for n in range(4):
        shapes[f"encoder.conv{n + 1}"] = (channels[n + 1], channels[n], 4, 4)
    shapes["encoder.mean"] = (latent, 3072)
    widths = (step_len * (1 + len(history)), width, width, width, outputs)
    for n in range(4):
        shapes[f"policy.layer{n + 1}"] = (widths[n + 1], widths[n])
    rng = np.random.default_rng(seed)
    tensors = {}
    for name, shape in shapes.items():
        bound = min(np.sqrt(1 / np.prod(shape[1:])) * 1.7, 0.5)
        tensors[f"{name}.weight"] = rng.uniform(-bound, bound, shape).astype(np.float32)
        tensors[f"{name}.bias"] = rng.uniform(-0.1, 0.1, shape[0]).astype(np.float32)
    digest = xxh3_64()
    for text in ("7", config):
        digest.update(struct.pack("<Q", len(text)) + text.encode())
    for tensor in tensors.values():
        digest.update(tensor.tobytes())
    metadata = {
        "skein.format": "policy-snapshot-2",
        "skein.policy_version": "7",
        "skein.config": config,
        "skein.checksum": digest.hexdigest(),
    }
    save_file(tensors, path, metadata)
    return path


def refused_in_threads(call, times):
    """Exceptions of a call that four threads make at the same time, so many times each."""
    refused = []

    def repeat():
        for _ in range(times):
            try:
                call()
            except Exception as error:
                refused.append(error)

    threads = [threading.Thread(target=repeat) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return refused
