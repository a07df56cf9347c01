"""The single environment."""

import copy
import os
import pickle
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from conftest import CONFIGS, refused_in_threads, rollout, same
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.utils.env_checker import check_env

import skein_rl

FLYING, COLLIDED, REACHED_END, TIMED_OUT = range(len(skein_rl.OUTCOMES))


def bits(results):
    observations = [result[0] for result in results]
    return [{name: part.tobytes() for name, part in one.items()} for one in observations]


@pytest.mark.parametrize(
    "keywords",
    [
        {},
        {"courses": "random"},
        {"observation": ["ground_truth"]},
        {"vehicle": {"action": "velocity"}},
        {"vehicle": {"action": "velocity+yaw"}, "observation": ["goal", "previous_action"]},
    ],
)
def test_gymnasiums_checker_has_no_complaint(keywords):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for mode in (None, "rgb_array"):
            env = gymnasium.make(
                "Skein/Corridor-v0", render_mode=mode, disable_env_checker=True, **keywords
            )
            check_env(env.unwrapped)


def test_an_action_has_the_numbers_of_the_setting():
    names = {"lateral": [], "velocity": ["forward"], "velocity+yaw": ["forward"]}
    for action, first in names.items():
        env = skein_rl.CorridorEnv(
            vehicle={"action": action, "max_speed_mps": 2.0},
            observation=["velocity", "goal", "previous_action"],
        )
        last = ["yaw_rate"] if action == "velocity+yaw" else []
        assert env.action_names == [*first, "left", "up", *last]
        shape = (len(env.action_names),)
        before, _ = env.reset(seed=1)
        assert env.action_space.shape == before["previous_action"].shape == shape
        assert env.oracle_action().shape == shape
        for _ in range(3):
            after, *_ = env.step(np.full(shape, 0.5, np.float32))
        assert after["previous_action"].tolist() == [0.5] * len(env.action_names)
        if first:
            assert np.linalg.norm(after["goal"]) < np.linalg.norm(before["goal"])
        with pytest.raises(ValueError, match="action has the shape"):
            env.step(np.zeros(len(env.action_names) + 1, np.float32))


def test_an_episode_is_a_function_of_its_seed():
    env = skein_rl.CorridorEnv(courses=["training", "random"], levels=[1, 2, 3])
    first, again = (bits(rollout(env, seed, 60)) for seed in (5, 5))
    assert first == again
    assert first != bits(rollout(env, 6, 60))


def test_options_choose_course_and_level():
    env = skein_rl.CorridorEnv(courses=["training", "rearranged_34125"])
    _, info = env.reset(seed=1, options={"course": "rearranged 34125", "level": 3})
    assert (info["course"], info["level"], info["walls_passed"]) == (1, 3, 0)
    _, info = env.reset(seed=1, options={"course_seed": 9})
    assert (info["course"], info["course_seed"]) == (-1, 9)
    for options, part in [
        ({"course": "nowhere"}, "nowhere"),
        ({"course": 7}, "course = 7"),
        ({"level": 9}, "9"),
        ({"level": 1.5}, "level = 1.5"),
        ({"lvl": 1}, "'lvl'"),
        ({"course": 0, "course_seed": 1}, "leave one out"),
    ]:
        with pytest.raises((ValueError, TypeError, IndexError), match=part):
            env.reset(options=options)


def test_terminated_is_not_truncated():
    env = skein_rl.CorridorEnv()
    env.reset(seed=1)
    ended, steps = False, 0
    while not ended:
        _, reward, terminated, truncated, info = env.step(np.zeros(2, np.float32))
        ended, steps = terminated or truncated, steps + 1
        assert reward == pytest.approx(float(info["reward_terms"].sum()), abs=1e-6)
    assert (terminated, truncated, info["outcome"], info["hit_wall"]) == (True, False, COLLIDED, 1)
    short = skein_rl.CorridorEnv(
        max_steps=5, vehicle={"preset": "airsim", "control_period_secs": 1.0}, courses=corridor(6.6)
    )
    short.reset(seed=1)
    for _ in range(5):
        _, _, terminated, truncated, info = short.step(np.zeros(2, np.float32))
    assert (terminated, truncated, info["outcome"]) == (False, True, TIMED_OUT)


def corridor(length_m):
    wall = {"label": 1, "shape": "rectangle", "centre_m": [0, 3.5], "width_m": 3, "height_m": 3}
    return {
        "name": "short",
        "order": [1],
        "wall_x_m": [5.0],
        "wall_thickness_m": 0.1,
        "corridor": {"length_m": length_m, "width_m": 6, "height_m": 7},
        "start": {"offset_m": 1.5, "jitter_y_m": 0, "jitter_z_m": 0},
        "wall": [wall],
    }


def test_the_oracle_reaches_the_end():
    env = skein_rl.CorridorEnv(courses="random")
    for seed in range(3):
        env.reset(seed=seed)
        ended = False
        while not ended:
            _, _, terminated, truncated, info = env.step(env.oracle_action())
            ended = terminated or truncated
        assert (info["outcome"], info["walls_passed"]) == (REACHED_END, 5)


@pytest.mark.parametrize("exploration", ["mode", "sample", "uniform"])
@pytest.mark.parametrize("disturbed", [False, True])
def test_an_actors_training_episode_is_flown_again_by_its_actions(policy, exploration, disturbed):
    disturbances = {"share": 1.0, "latency_periods": 1, "mass_spread": 0.2} if disturbed else {}
    if disturbed:
        disturbances["gust"] = {"force_rms_n": 0.15}
        disturbances["depth"] = {"model": "stereo"}
    env = skein_rl.CorridorEnv(
        courses=["training", "random"], levels=[1, 2], disturbances=disturbances
    )
    for seed in range(4):
        flown = skein_rl.fly(env, policy, seed, exploration=exploration)
        observation, _ = env.reset(seed=seed)
        for step, action in enumerate(flown["action"][:-1]):
            assert observation["depth"][0].tobytes() == flown["depth"][step].tobytes()
            assert observation["velocity"].tobytes() == flown["velocity_mps"][step].tobytes()
            observation, reward, terminated, truncated, info = env.step(action)
            assert np.float32(reward) == flown["reward"][step]
            assert info["reward_terms"].tobytes() == flown["reward_terms"][step].tobytes()
            assert terminated == flown["terminated"][step]
            assert truncated == flown["truncated"][step]
            assert info["position_m"].tobytes() == flown["position_m"][step + 1].tobytes()
        assert terminated or truncated


def test_a_recorded_episode_is_flown_again_by_its_actions(recording, policy):
    recorded = skein_rl.read_recording(recording)
    files = sorted((CONFIGS / "courses").glob("*.toml"))
    env = skein_rl.CorridorEnv(courses=files, simulator=policy.simulator)
    seeds = evaluation_seeds(policy.config["run"]["seed"], 2)
    for episode in recorded.episodes():
        course, number = int(episode["course"][0]), int(episode["episode"][0])
        observation, _ = env.reset(seed=seeds[number], options={"course": course})
        for step, action in enumerate(episode["action"][:-1]):
            assert observation["depth"][0].tobytes() == episode["depth"][step].tobytes()
            observation, reward, terminated, truncated, _ = env.step(action)
            assert np.float32(reward) == episode["reward"][step]
        assert observation["velocity"].tobytes() == episode["velocity_mps"][-1].tobytes()
        assert terminated or truncated


def evaluation_seeds(run_seed, count):
    """Seeds of a run's evaluation episodes: xxh3 of purpose 2 and the index."""
    xxhash = pytest.importorskip("xxhash")
    places = ((2).to_bytes(8, "little") + n.to_bytes(8, "little") for n in range(count))
    return [xxhash.xxh3_64_intdigest(place, seed=run_seed) for place in places]


def test_settings_come_from_keywords_and_files(tmp_path):
    env = skein_rl.CorridorEnv(
        simulator={"max_steps": 200, "vehicle": {"preset": "point"}}, reward={"collision": -3}
    )
    assert env.settings["max_steps"] == 200
    assert env.settings["vehicle"]["preset"] == "point"
    assert env.settings["reward"]["collision"] == -3
    env = skein_rl.CorridorEnv(config=CONFIGS / "generalist.toml", max_steps=300)
    assert env.settings["disturbances"]["latency_periods"] == 1
    assert env.settings["max_steps"] == 300
    assert env.reset(seed=1)[1]["course"] == -1


@pytest.mark.parametrize(
    ("keywords", "part"),
    [
        ({"cours": "training"}, "'cours'"),
        ({"courses": "nowhere.toml"}, "nowhere.toml"),
        ({"courses": []}, r"courses = \[\]"),
        ({"courses": 3}, "courses"),
        ({"courses": {"name": "x"}}, r"courses\[0\]"),
        ({"max_steps": 0}, "max_steps = 0"),
        ({"max_steps": "many"}, "many"),
        ({"vehicle": {"mass": 3}}, "mass"),
        ({"vehicle": 3}, "vehicle = 3"),
        ({"reward": {"collision": float("nan")}}, "collision"),
        ({"reward": {"collision": 1e19}, "courses": "random"}, "collision"),
        ({"levels": 6}, "levels: 6"),
        ({"levels": 0}, "level = 0"),
        ({"levels": []}, "levels"),
        ({"generated_share": 2}, "generated_share = 2"),
        ({"encoder": "none.safetensors"}, "none.safetensors"),
        ({"encoder": 3}, "encoder = 3"),
        ({"config": "none.toml"}, "none.toml"),
        ({"observation": ["smell"]}, "smell"),
        ({"observation": []}, "observation"),
        ({"observation": ["latent"]}, "encoder"),
        ({"render_mode": "ansi"}, "ansi"),
        ({"simulator": {"vehicle": object()}}, "vehicle"),
        ({"generator": {"clearance_m": [0.1, 0.2]}, "courses": "random"}, "clearance_m"),
    ],
)
def test_what_is_wrong_is_named(keywords, part):
    with pytest.raises((ValueError, TypeError), match=part):
        skein_rl.CorridorEnv(**keywords)


@pytest.mark.parametrize(
    "action",
    [
        np.zeros(3, np.float32),
        np.zeros((1, 2), np.float32),
        np.array([np.nan, 0], np.float32),
        np.array([0, np.inf]),
        np.array([1e300, 0]),
        np.array(["a", "b"]),
        None,
        "left",
        [1j, 0],
        np.array([None, None]),
    ],
)
def test_a_wrong_action_is_refused_and_flies_nothing(action):
    env = skein_rl.CorridorEnv()
    env.reset(seed=1)
    with pytest.raises(ValueError, match="action"):
        env.step(action)
    _, _, _, _, info = env.step(np.zeros(2))
    assert info["step"] == 1


def test_the_order_of_calls_is_checked():
    env = skein_rl.CorridorEnv()
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(2))
    with pytest.raises(ResetNeeded):
        env.oracle_action()
    env.reset(seed=1)
    env.close()
    env.close()
    for call in (env.reset, lambda: env.step(np.zeros(2)), env.oracle_action):
        with pytest.raises(ClosedEnvironmentError):
            call()
    for seed in (-1, 1 << 64):
        with pytest.raises(ValueError, match="seed"):
            skein_rl.CorridorEnv().reset(seed=seed)
    for seed in ("x", 1.5):
        with pytest.raises(TypeError, match="seed"):
            skein_rl.CorridorEnv().reset(seed=seed)


def test_a_second_thread_is_told_that_it_is_one():
    vector = skein_rl.make_vec(16)
    vector.reset(seed=1)
    refused = refused_in_threads(lambda: vector.step(np.zeros((16, 2))), 30)
    assert refused
    assert all(type(error) is RuntimeError and "another thread" in str(error) for error in refused)
    vector.step(np.zeros((16, 2)))


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_continues_where_the_original_stands(copied):
    env = skein_rl.CorridorEnv(
        courses=["training", "random"], disturbances={"share": 1.0, "gust": {"force_rms_n": 0.1}}
    )
    env.reset(seed=3)
    for _ in range(7):
        env.step(np.array([0.3, -0.2]))
    twin = copied(env)
    for _ in range(3):
        for result, other in zip(env.step(np.array([-0.3, 0.2])), twin.step(np.array([-0.3, 0.2]))):
            same(result, other) if isinstance(result, dict) else None
            assert isinstance(result, dict) or result == other
    same(env.reset()[0], twin.reset()[0])
    env.close()
    assert copied(env)._fleet is None


def test_arrays_are_never_used_again():
    env = skein_rl.CorridorEnv()
    observation, _ = env.reset(seed=1)
    kept = {name: part.copy() for name, part in observation.items()}
    for _ in range(3):
        env.step(np.array([0.5, 0.5]))
    same(observation, kept)
    observation["depth"][:] = 0


def test_a_fork_flies_on():
    vector = skein_rl.make_vec(4, threads=2)
    vector.reset(seed=1)
    vector.step(np.zeros((4, 2)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if child == 0:
        try:
            vector.step(np.zeros((4, 2)))
            os._exit(0)
        except BaseException:
            os._exit(1)
    assert os.waitpid(child, 0)[1] == 0
    vector.step(np.zeros((4, 2)))


def test_a_second_interpreter_is_refused_or_works():
    code = (
        "import skein_rl\n"
        "try:\n    import _interpreters as sub\n"
        "except ImportError:\n    import _xxsubinterpreters as sub\n"
        "other = sub.create()\n"
        "try:\n    sub.run_string(other, 'import skein_rl._core')\n"
        "except Exception as error:\n    print('refused', type(error).__name__)\n"
        "print('alive')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0 and "alive" in done.stdout, done.stderr


def test_images_for_people():
    env = skein_rl.CorridorEnv(render_mode="rgb_array")
    with pytest.raises(ResetNeeded):
        env.render()
    env.reset(seed=1)
    image = env.render()
    assert image.shape == (288, 512, 3) and image.dtype == np.uint8
    drone = (image == [255, 140, 0]).all(axis=2)
    assert 2000 < drone.sum() < 40000
    env.step(np.array([1.0, 0.0]))
    assert (env.render() != image).any()


def test_it_is_imported_quickly():
    code = (
        "import time, gymnasium, numpy; t = time.process_time()\n"
        "import skein_rl; print(time.process_time() - t)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert float(done.stdout) < 0.3
