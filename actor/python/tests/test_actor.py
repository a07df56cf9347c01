"""Environments of Python's in a run under way: real processes."""

import csv
import json
import os
import pathlib
import signal
import subprocess
import sys
import time

import gymnasium
import numpy as np
import pytest
from conftest import CONFIGS, REPOSITORY

import skein_rl

pytest.importorskip("skein_rl_actor", reason="launch/python.sh builds it")

COURSES = [CONFIGS / "courses" / f"{name}.toml" for name in ("training", "non_rectangular")]
LIMIT_SECS = 180


class Run:
    """A run of tests/small.toml: processes as a user starts them."""

    def __init__(self, folder, actors, *overrides):
        program = os.environ.get("SKEIN")
        if not program:
            pytest.skip("SKEIN names no program: launch/python.sh sets it once skein is built")
        self.directory = folder / "run"
        command = [program, "run", "--config", REPOSITORY / "tests" / "small.toml"]
        command += ["--run-dir", self.directory, "--actors", str(actors)]
        for setting in overrides:
            command += ["--set", setting]
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        deadline = time.monotonic() + LIMIT_SECS
        while not (self.directory / "logs" / "learner.log").exists():
            assert self.process.poll() is None, self.process.stdout.read()
            assert time.monotonic() < deadline
            time.sleep(0.05)

    def end(self):
        printed, _ = self.process.communicate(timeout=LIMIT_SECS)
        assert self.process.returncode == 0, printed

    def episodes(self):
        with open(self.directory / "episodes.csv", newline="") as file:
            return list(csv.DictReader(file))

    def policy_sha256(self):
        return json.loads((self.directory / "summary.json").read_text())["policy_sha256"]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            self.process.communicate(timeout=LIMIT_SECS)


def simulator_of(run):
    """The run's own simulator, as an environment."""
    return skein_rl.CorridorEnv(
        config=run.directory / "config.toml", courses=COURSES, generated_share=0.0
    )


class Tiny(gymnasium.Env):
    """A world of its own: a depth image of noise, an episode of `length` steps."""

    observation_space = gymnasium.spaces.Dict(
        {
            "depth": gymnasium.spaces.Box(0, 255, (1, 72, 128), np.uint8),
            "velocity": gymnasium.spaces.Box(-100, 100, (3,), np.float32),
        }
    )
    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, length=12, **changed):
        self.length, self.changed = length, changed

    def observation(self):
        depth = self.np_random.integers(0, 256, (1, 72, 128), dtype=np.uint8)
        return {"depth": depth, "velocity": np.array([1, 0, 0], np.float32), **self.changed}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.observation(), {}

    def step(self, action):
        self.steps += 1
        reward = float(action[0])
        return self.observation(), reward, self.steps == self.length, False, {}


def test_a_run_flown_in_python_is_equal_to_one_of_its_own_actors(tmp_path):
    (tmp_path / "python").mkdir(), (tmp_path / "own").mkdir()
    with Run(tmp_path / "python", 0) as run:
        actor = skein_rl.Actor(simulator_of(run))
        actor.join(run.directory)
        run.end()
        flown = run.episodes()
        assert len(flown) == 40 and {row["actor"] for row in flown} == {"0"}
        assert actor.episodes >= 40
    with Run(tmp_path / "own", 2) as own:
        own.end()
    same = [[{**row, "actor": ""} for row in one.episodes()] for one in (run, own)]
    assert same[0] == same[1]
    assert run.policy_sha256() == own.policy_sha256()


def test_a_foreign_environment_flies_beside_an_actor_and_both_fly(tmp_path):
    with Run(tmp_path, 1, "run.episodes=120") as run:
        skein_rl.Actor(Tiny()).join(run.directory)
        run.end()
        flown = run.episodes()
    assert len(flown) == 120
    theirs = [row for row in flown if row["actor"] == "1"]
    assert theirs and all(row["outcome"] == "collided" for row in theirs)
    assert {row["steps"] for row in theirs} == {"12"}


class Breaks(Tiny):
    def step(self, action):
        if self.steps == 3:
            raise RuntimeError("the battery is empty")
        return super().step(action)


class Counts(Tiny):
    """Says of walls what it is given."""

    def __init__(self, **info):
        super().__init__()
        self.info = info

    def step(self, action):
        return (*super().step(action)[:4], self.info)


@pytest.mark.parametrize(
    ("env", "error", "message"),
    [
        (Breaks(), RuntimeError, "battery is empty"),
        (Counts(walls_passed=6), ValueError, r"\"walls_passed\"\] = 6 of 5 walls"),
        (Counts(hit_wall=9), ValueError, r"\"hit_wall\"\] = 9 of 5 walls"),
        (Counts(walls=0), ValueError, r"\"walls\"\] = 0"),
        (Tiny(velocity=np.array([1, np.nan, 0])), ValueError, r"env.reset\(\): velocity = .*nan"),
        (Tiny(velocity=np.ones(2)), ValueError, "velocity has 2 numbers, not 3"),
        (Tiny(depth=np.zeros((72, 127), np.uint8)), ValueError, r"depth is uint8 \[72, 127\]"),
        (Tiny(depth=np.zeros((72, 128))), ValueError, "depth is float64"),
        (Tiny(length=1000), ValueError, "max_records_per_episode = 256.*TimeLimit"),
    ],
)
def test_a_fault_of_the_environment_ends_its_actor_alone(broken, env, error, message):
    with pytest.raises(error, match=message):
        skein_rl.Actor(env).join(broken.directory)
    assert broken.process.poll() is None


@pytest.fixture(scope="module")
def broken(tmp_path_factory):
    """A run that goes on although every actor but the last breaks."""
    with Run(tmp_path_factory.mktemp("broken"), 0, "run.episodes=20") as run:
        yield run
        skein_rl.Actor(simulator_of(run)).join(run.directory)
        run.end()
        assert len(run.episodes()) == 20


def test_ctrl_c_ends_an_actor_that_waits_and_one_that_flies(broken):
    program = (
        "import sys, test_actor, skein_rl\n"
        "class Slow(test_actor.Tiny):\n"
        "    def step(self, action):\n"
        "        print('flying', flush=True)\n"
        "        import time; time.sleep(0.2)\n"
        "        return super().step(action)\n"
        "skein_rl.Actor(Slow()).join(sys.argv[1])\n"
    )
    command = [sys.executable, "-c", program, broken.directory]
    folder = pathlib.Path(__file__).parent
    process = subprocess.Popen(
        command,
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # Where these tests run in the background, a shell has them ignore the signal.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert process.stdout.readline() == "flying\n"
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=20)
    assert "KeyboardInterrupt" in errors and process.returncode != 0


def test_what_is_no_run_and_no_environment_is_named(tmp_path):
    with pytest.raises(ValueError, match=str(tmp_path)):
        skein_rl.Actor(Tiny()).join(tmp_path)
    with pytest.raises(TypeError, match="no gymnasium.Env"):
        skein_rl.Actor(object())
    for space, message in (
        (gymnasium.spaces.Box(0, 1, (3,)), "is no Dict"),
        (gymnasium.spaces.Dict({"depth": Tiny.observation_space["depth"]}), "no 'velocity'"),
    ):
        env = Tiny()
        env.observation_space = space
        with pytest.raises(ValueError, match=message):
            skein_rl.Actor(env)


def test_a_vanished_learner_is_a_connection_error(tmp_path):
    overrides = ("run.episodes=20", "transport.learner_silence_secs=3.0")
    with Run(tmp_path, 0, *overrides, "transport.actor_silence_secs=1.0") as run:
        run.process.kill()
        run.process.communicate()
        with pytest.raises(ConnectionError, match="learner_silence_secs"):
            skein_rl.Actor(Tiny(length=200)).join(run.directory)
