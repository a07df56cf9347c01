"""Policies, beside the actor."""

import pickle

import numpy as np
import pytest
from conftest import refused_in_threads

import skein_rl


@pytest.fixture(scope="module")
def env(policy):
    return skein_rl.CorridorEnv(courses="random", simulator=policy.simulator)


@pytest.mark.parametrize("exploration", ["mode", "sample"])
def test_its_actions_are_the_actors_bit_for_bit(env, policy, exploration):
    for seed in range(3):
        flown = skein_rl.fly(env, policy, seed, exploration=exploration)
        policy.reset(seed=seed)
        observation, _ = env.reset(seed=seed)
        for step, expected in enumerate(flown["action"][:-1]):
            action = policy.act(observation, deterministic=exploration == "mode")
            assert action.tobytes() == expected.tobytes(), step
            observation, *_ = env.step(action)


def test_a_batch_is_its_rows(policy):
    vector = skein_rl.make_vec(4, courses="random", autoreset_mode="SAME_STEP")
    singles = [skein_rl.Policy.load(policy._path, threads=1) for _ in range(4)]
    observations, _ = vector.reset(seed=1)
    policy.reset(4)
    started = np.ones(4, bool)
    for _ in range(60):
        actions = policy.act(observations, episode_start=started)
        for row, single in enumerate(singles):
            own = {name: part[row] for name, part in observations.items()}
            action = single.act(own, episode_start=started[row])
            assert action.tobytes() == actions[row].tobytes()
        observations, _, terminated, truncated, _ = vector.step(actions)
        started = terminated | truncated


def test_a_second_thread_is_told_that_it_is_one(generalist):
    policy = skein_rl.Policy.load(generalist, threads=1)
    observations, _ = skein_rl.make_vec(16).reset(seed=1)
    refused = refused_in_threads(lambda: policy.act(observations), 10)
    assert refused
    assert all(type(error) is RuntimeError and "another thread" in str(error) for error in refused)
    policy.act(observations)


def test_codes_serve_as_well_as_images(policy, generalist):
    env = skein_rl.CorridorEnv(
        encoder=generalist, observation=["depth", "latent", "velocity", "previous_action"]
    )
    observation, _ = env.reset(seed=1)
    policy.reset()
    by_code = policy.act({k: v for k, v in observation.items() if k != "depth"})
    policy.reset()
    by_image = policy.act({k: v for k, v in observation.items() if k != "latent"})
    assert by_code.tobytes() == by_image.tobytes()


def test_what_is_wrong_is_named(policy, env, tmp_path):
    observation, _ = env.reset(seed=1)
    policy.reset()
    without = {name: part for name, part in observation.items() if name != "velocity"}
    with pytest.raises(KeyError, match="velocity"):
        policy.act(without)
    for change, part in [
        ({"depth": observation["depth"].astype(np.float32)}, "dtype"),
        ({"depth": observation["depth"][:, :50]}, "shape"),
        ({"velocity": np.array([np.nan, 0, 0])}, "velocity"),
        ({"velocity": np.zeros(2)}, "velocity"),
        ({"velocity": np.zeros(3, complex)}, "velocity"),
        ({"previous_action": np.zeros(5)}, "previous_action"),
        ({"previous_action": np.zeros((2, 2))}, "previous_action"),
        ({"latent": np.zeros((policy.latent, 1), np.float32)}, "latent"),
        ({"velocity": np.zeros((2, 3))}, "rows"),
    ]:
        with pytest.raises(ValueError, match=part):
            policy.act({**observation, **change})
    with pytest.raises(ValueError, match="episode_start"):
        policy.act(observation, episode_start=[True, False])
    with pytest.raises(ValueError, match="velocity"):
        policy.act({**observation, "velocity": np.float32(1)})
    for rows in (0, -1, 1.5, True, 10**12):
        with pytest.raises(ValueError, match="n = "):
            policy.reset(rows)
    for threads in (0, "a", 1 << 70):
        with pytest.raises(ValueError, match="threads = "):
            skein_rl.Policy.load(policy._path, threads=threads)
    with pytest.raises(ValueError, match="none.safetensors"):
        skein_rl.Policy.load(tmp_path / "none.safetensors")
    (tmp_path / "bad.safetensors").write_bytes(b"abc" * 100)
    with pytest.raises(ValueError, match="bad.safetensors"):
        skein_rl.Policy.load(tmp_path / "bad.safetensors")
    with pytest.raises(ValueError, match="exploration"):
        skein_rl.fly(env, policy, 1, exploration="wild")


def test_it_says_what_it_is(policy):
    config = policy.config
    assert policy.latent == config["vae"]["latent"]
    assert policy.observation == config["learning"]["observation"]
    assert policy.action_names == ["left", "up"]
    assert policy.history_steps == config["learning"]["history_steps"]
    assert len(policy.sha256) == 64
    assert policy.parameters()["encoder.conv1.weight"].shape == (32, 1, 4, 4)
    assert pickle.loads(pickle.dumps(policy)).sha256 == policy.sha256


def test_the_torch_module_agrees(policy, env):
    torch = pytest.importorskip("torch")
    module = policy.to_torch()
    history = module.start()
    policy.reset()
    observation, _ = env.reset(seed=4)
    for _ in range(12):
        action = policy.act(observation)
        depth = torch.from_numpy(observation["depth"])[None]
        velocity = torch.from_numpy(observation["velocity"])[None]
        with torch.no_grad():
            found, history = module(depth, velocity, history)
        np.testing.assert_allclose(found[0].numpy(), action, atol=1e-5)
        observation, *_ = env.step(action)
