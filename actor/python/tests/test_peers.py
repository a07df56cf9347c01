"""Heavy packages that users train with: launch/peers.sh installs them, else these are skipped."""

import warnings

import numpy as np
import pytest
from conftest import CONFIGS

import skein_rl

SNAPSHOT = CONFIGS / "snapshots" / "generalist.safetensors"
CODES = {"encoder": SNAPSHOT, "observation": ["latent", "velocity"]}


def test_stable_baselines_checker_has_no_complaint():
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for keywords in ({}, CODES, {"observation": ["ground_truth"]}):
            checker.check_env(skein_rl.CorridorEnv(render_mode="rgb_array", **keywords))


def test_stable_baselines_vector_environment_keeps_its_contract():
    vec_env = pytest.importorskip("stable_baselines3.common.vec_env")
    ours = skein_rl.sb3.VecEnv(3, **CODES)
    theirs = vec_env.DummyVecEnv([lambda: skein_rl.CorridorEnv(**CODES)] * 3)
    ours.seed(5), theirs.seed(5)
    first, other = ours.reset(), theirs.reset()
    rng = np.random.default_rng(1)
    ends = 0
    for _ in range(80):
        for part in first:
            assert first[part].tobytes() == other[part].tobytes()
        actions = rng.uniform(-1, 1, (3, 2)).astype(np.float32)
        first, rewards, dones, infos = ours.step(actions)
        other, *expected = theirs.step(actions)
        np.testing.assert_array_equal(rewards, expected[0])
        np.testing.assert_array_equal(dones, expected[1])
        for info, wanted in zip(infos, expected[2]):
            assert info["TimeLimit.truncated"] == wanted["TimeLimit.truncated"]
            assert ("terminal_observation" in info) == ("terminal_observation" in wanted)
            if "terminal_observation" in info:
                ends += 1
                for part, array in info["terminal_observation"].items():
                    np.testing.assert_array_equal(array, wanted["terminal_observation"][part])
            assert info["outcome"] == wanted["outcome"]
    assert ends > 0
    assert ours.env_is_wrapped(object) == [False] * 3
    assert ours.get_attr("threads") == [ours.env.threads] * 3
    for call in (lambda: ours.set_attr("x", 1), lambda: ours.env_method("x")):
        with pytest.raises(AttributeError, match="x"):
            call()
    ours.close()


def test_stable_baselines_trains_end_to_end():
    sb3 = pytest.importorskip("stable_baselines3")
    envs = skein_rl.sb3.VecEnv(4, courses="random", **CODES)
    model = sb3.SAC(
        "MultiInputPolicy",
        envs,
        learning_starts=100,
        gradient_steps=4,
        batch_size=32,
        policy_kwargs={"net_arch": [32, 32]},
        seed=1,
    )
    model.learn(400)
    actions, _ = model.predict(envs.reset(), deterministic=True)
    assert actions.shape == (4, 2) and np.isfinite(actions).all()
    images = skein_rl.sb3.VecEnv(2)
    sb3.PPO("MultiInputPolicy", images, n_steps=16, batch_size=16, n_epochs=1).learn(32)


def test_torchrl_collects_a_batch():
    pytest.importorskip("torchrl")
    from torchrl.envs import GymWrapper

    envs = GymWrapper(skein_rl.make_vec(3, autoreset_mode="SAME_STEP"))
    batch = envs.rollout(40, break_when_any_done=False)
    assert tuple(batch.batch_size) == (3, 40)
    assert batch["depth"].shape[-2:] == (72, 128)
    assert batch["next", "done"].any()


def test_pufferlib_steps_it():
    vector = pytest.importorskip("pufferlib.vector")
    from pufferlib.emulation import GymnasiumPufferEnv

    def make(buf=None, seed=0):
        return GymnasiumPufferEnv(env_creator=skein_rl.CorridorEnv, buf=buf, seed=seed)

    envs = vector.make(make, num_envs=3, backend=vector.Serial)
    alone = [skein_rl.CorridorEnv() for _ in range(3)]
    rows, _ = envs.reset(seed=5)
    expected = [env.reset(seed=5 + place)[0] for place, env in enumerate(alone)]
    over, ends = [False] * 3, 0
    rng = np.random.default_rng(1)
    for _ in range(40):
        parts = rows.view(envs.driver_env.obs_dtype)
        for place, observation in enumerate(expected):
            for name, array in observation.items():
                np.testing.assert_array_equal(parts[name][place, 0], array)
        actions = rng.uniform(-1, 1, (3, 2)).astype(np.float32)
        rows, rewards, terminated, truncated, _ = envs.step(actions)
        for place, env in enumerate(alone):
            # The step after an end only starts the next episode.
            if over[place]:
                expected[place], over[place] = env.reset()[0], False
                continue
            expected[place], reward, *ended, _ = env.step(actions[place])
            assert rewards[place] == np.float32(reward)
            assert [terminated[place], truncated[place]] == ended
            over[place] = any(ended)
            ends += any(ended)
    assert ends > 0
    envs.close()
