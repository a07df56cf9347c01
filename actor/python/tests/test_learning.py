"""A small SAC on JAX learns on the vector environment (arXiv:1812.05905), seeded and short."""

import numpy as np
import pytest
from conftest import CONFIGS

import skein_rl

jax = pytest.importorskip("jax")
optax = pytest.importorskip("optax")
jnp = jax.numpy

ENVIRONMENTS = 8
STEPS = 600  # of all environments together: 4,800 transitions
RANDOM_STEPS = 100
WIDTH, BATCH, UPDATES = 64, 128, 4
DISCOUNT, RATE, TRACKING = 0.97, 1e-3, 0.01
TARGET_ENTROPY = -2.0


def network(key, sizes):
    """Weights of a multi-layer perceptron, He's range."""
    keys = jax.random.split(key, len(sizes))
    pairs = zip(keys, sizes[:-1], sizes[1:])
    return [(jax.random.normal(k, (a, b)) * np.sqrt(2 / a), jnp.zeros(b)) for k, a, b in pairs]


def apply(layers, x):
    for weights, bias in layers[:-1]:
        x = jax.nn.relu(x @ weights + bias)
    weights, bias = layers[-1]
    return x @ weights + bias


def sample(policy, seen, key):
    """Actions of a squashed normal distribution, and their log density (appendix C)."""
    mean, log_std = jnp.split(apply(policy, seen), 2, axis=-1)
    log_std = jnp.clip(log_std, -5, 2)
    noise = jax.random.normal(key, mean.shape)
    raw = mean + jnp.exp(log_std) * noise
    density = -0.5 * noise**2 - log_std - 0.5 * jnp.log(2 * jnp.pi)
    squash = 2 * (jnp.log(2.0) - raw - jax.nn.softplus(-2 * raw))
    return jnp.tanh(raw), (density - squash).sum(-1)


def values(critics, seen, action):
    joined = jnp.concatenate([seen, action], -1)
    return jnp.stack([apply(critic, joined)[..., 0] for critic in critics])


optimizer = optax.adam(RATE)


@jax.jit
def update(state, batch, key):
    """One update of critics, policy and temperature (equations 5, 7, 18)."""
    nets, targets, moments = state
    seen, action, reward, following, terminated = batch
    of_target, of_policy = jax.random.split(key)
    next_action, next_density = sample(nets["policy"], following, of_target)
    alpha = jnp.exp(nets["log_alpha"])
    soft = values(targets, following, next_action).min(0) - alpha * next_density
    wanted = jax.lax.stop_gradient(reward + DISCOUNT * (1 - terminated) * soft)

    def loss(nets):
        frozen = jax.lax.stop_gradient(nets)
        critic = ((values(nets["critics"], seen, action) - wanted) ** 2).mean()
        own, density = sample(nets["policy"], seen, of_policy)
        worth = values(frozen["critics"], seen, own).min(0)
        policy = (jnp.exp(frozen["log_alpha"]) * density - worth).mean()
        surplus = jax.lax.stop_gradient(density + TARGET_ENTROPY).mean()
        return critic + policy - nets["log_alpha"] * surplus

    changes, moments = optimizer.update(jax.grad(loss)(nets), moments)
    nets = optax.apply_updates(nets, changes)
    return nets, optax.incremental_update(nets["critics"], targets, TRACKING), moments


act = jax.jit(sample)


def test_a_small_sac_on_jax_learns():
    envs = skein_rl.make_vec(
        ENVIRONMENTS,
        2,
        vehicle={"preset": "point"},
        encoder=CONFIGS / "snapshots" / "generalist.safetensors",
        observation=["latent", "velocity"],
        autoreset_mode="SAME_STEP",
    )

    def flat(parts):
        return np.concatenate([parts["latent"], parts["velocity"]], -1)

    observations, _ = envs.reset(seed=1)
    seen = flat(observations)
    width = seen.shape[1]
    keys = iter(jax.random.split(jax.random.key(1), 2 * STEPS + STEPS * UPDATES + 3))
    nets = {
        "policy": network(next(keys), (width, WIDTH, WIDTH, 4)),
        "critics": [network(next(keys), (width + 2, WIDTH, WIDTH, 1)) for _ in range(2)],
        "log_alpha": jnp.log(0.2),
    }
    state = (nets, nets["critics"], optimizer.init(nets))
    stored = [
        np.zeros((STEPS * ENVIRONMENTS, *shape), np.float32)
        for shape in ((width,), (2,), (), (width,), ())
    ]
    rng = np.random.default_rng(1)
    so_far, returns = np.zeros(ENVIRONMENTS), []
    for step in range(STEPS):
        if step < RANDOM_STEPS:
            action = rng.uniform(-1, 1, (ENVIRONMENTS, 2)).astype(np.float32)
        else:
            action = np.asarray(act(state[0]["policy"], seen, next(keys))[0])
        observations, reward, terminated, truncated, infos = envs.step(action)
        after = flat(observations)
        following = after.copy()
        for ended in np.flatnonzero(terminated | truncated):
            last = infos["final_obs"][ended]
            following[ended] = np.concatenate([last["latent"], last["velocity"]], -1)
        rows = slice(step * ENVIRONMENTS, (step + 1) * ENVIRONMENTS)
        for array, new in zip(stored, (seen, action, reward, following, terminated)):
            array[rows] = new
        so_far += reward
        for ended in np.flatnonzero(terminated | truncated):
            returns.append((step, so_far[ended]))
            so_far[ended] = 0
        seen = after
        if step >= RANDOM_STEPS:
            for _ in range(UPDATES):
                chosen = rng.integers(0, rows.stop, BATCH)
                state = update(state, tuple(array[chosen] for array in stored), next(keys))
    at_random = np.mean([value for step, value in returns if step < RANDOM_STEPS])
    learned = np.mean([value for step, value in returns if step >= STEPS * 3 // 4])
    print(f"return: {at_random:.2f} at random, {learned:.2f} learned, {len(returns)} episodes")
    assert learned > at_random + 3.0
