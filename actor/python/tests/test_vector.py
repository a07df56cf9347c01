"""The vector environment, beside single ones."""

import copy
import pickle

import gymnasium
import numpy as np
import pytest
from conftest import same
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import skein_rl

KEYWORDS = {"courses": ["training", "random"], "levels": [1, 2]}


def equal(one, other, path="info"):
    """Raises if two infos differ."""
    assert one.keys() == other.keys(), (path, one.keys() ^ other.keys())
    for key, value in one.items():
        if isinstance(value, dict):
            equal(value, other[key], f"{path}.{key}")
        elif key == "final_obs":
            for a, b in zip(value, other[key]):
                assert (a is None) == (b is None)
                if a is not None:
                    same(a, b)
        else:
            np.testing.assert_array_equal(value, other[key], err_msg=f"{path}.{key}")


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("count", [1, 2, 8])
@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_it_flies_as_single_environments_do(mode, count, threads, generalist):
    keywords = {**KEYWORDS, "observation": ["depth", "velocity", "previous_action"]}
    ours = skein_rl.make_vec(count, threads, autoreset_mode=mode, **keywords)
    makers = [lambda: skein_rl.CorridorEnv(**keywords)] * count
    theirs = SyncVectorEnv(makers, autoreset_mode=mode)
    rng = np.random.default_rng(1)
    for env, one in ((ours, ours.reset(seed=11)), ):
        other = theirs.reset(seed=11)
        same(one[0], other[0])
        equal(one[1], other[1])
    ends = 0
    for _ in range(70):
        actions = rng.uniform(-1, 1, (count, 2)).astype(np.float32)
        one, other = ours.step(actions), theirs.step(actions)
        same(one[0], other[0])
        for a, b in zip(one[1:4], other[1:4]):
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b)
        equal(one[4], other[4])
        ended = one[2] | one[3]
        ends += ended.sum()
        if mode == AutoresetMode.DISABLED and ended.any():
            one = ours.reset(options={"reset_mask": ended})
            other = theirs.reset(options={"reset_mask": ended.copy()})
            same(one[0], other[0])
            equal(one[1], other[1])
    assert ends > 0


def test_gymnasium_makes_it():
    env = gymnasium.make_vec("Skein/Corridor-v0", num_envs=3, courses="random")
    assert type(env) is skein_rl.CorridorVectorEnv
    assert env.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    observations, _ = env.reset(seed=1)
    assert observations in env.observation_space
    assert observations["depth"].shape == (3, 1, 72, 128)
    observations, *_ = env.step(env.action_space.sample())
    assert observations in env.observation_space


def test_latent_codes_are_the_encoders(generalist, policy):
    parts = ["depth", "latent", "velocity"]
    env = skein_rl.make_vec(3, 2, observation=parts, encoder=generalist, courses="random")
    observations, _ = env.reset(seed=1)
    assert observations in env.observation_space
    assert observations["latent"].tobytes() == policy.encode(observations["depth"]).tobytes()


def test_what_is_wrong_is_named():
    env = skein_rl.make_vec(3)
    with pytest.raises(ResetNeeded):
        env.step(np.zeros((3, 2)))
    with pytest.raises(ResetNeeded, match="reset_mask"):
        env.reset(options={"reset_mask": np.array([True, False, False])})
    env.reset(seed=[1, None, 3])
    for actions, part in [
        (np.zeros((2, 2)), "shape"),
        (np.zeros(6), "shape"),
        (np.full((3, 2), np.nan), "environment 0"),
    ]:
        with pytest.raises(ValueError, match=part):
            env.step(actions)
    for seed in ([1, 2], -1, [1 << 64, 1, 2]):
        with pytest.raises((ValueError, gymnasium.error.Error)):
            env.reset(seed=seed)
    for mask in ([True] * 3, np.ones(2, bool), np.zeros(3, bool), np.ones(3)):
        with pytest.raises(ValueError, match="reset_mask"):
            env.reset(options={"reset_mask": mask})
    # A number beyond the machine's memory is refused before anything is allocated.
    for keywords in (
        {"num_envs": 0},
        {"num_envs": 10**12},
        {"threads": 0},
        {"threads": 1000},
        {"autoreset_mode": "never"},
    ):
        with pytest.raises(ValueError, match=next(iter(keywords))):
            skein_rl.CorridorVectorEnv(**keywords)
    env.close()
    with pytest.raises(ClosedEnvironmentError):
        env.reset()


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_continues_where_the_original_stands(copied):
    env = skein_rl.make_vec(4, 2, autoreset_mode="SAME_STEP", **KEYWORDS)
    env.reset(seed=2)
    rng = np.random.default_rng(0)
    for _ in range(30):
        env.step(rng.uniform(-1, 1, (4, 2)))
    twin = copied(env)
    for _ in range(30):
        actions = rng.uniform(-1, 1, (4, 2))
        one, other = env.step(actions), twin.step(actions)
        same(one[0], other[0])
        equal(one[4], other[4])


def test_unseeded_environments_differ():
    observations, infos = skein_rl.make_vec(4).reset()
    assert len(set(infos["seed"].tolist())) == 4
