"""A SAC update in JAX: the same network, minibatch and loss as Skein's, many in one `lax.scan`.

Prints the seconds of one update in each sample, one number a line. Arguments: updates in a sample,
samples. One sample more is run first, to compile.
"""

import sys
import time

import jax
import jax.numpy as jnp
import optax

OBSERVATION, ACTION, WIDTH, BATCH = 34, 2, 256, 256
DISCOUNT, TARGET_RATE, LEARNING_RATE = 0.99, 0.005, 3e-4


def layers(key, widths):
    """Weights and biases of linear layers, uniform as PyTorch's."""
    made = []
    for inputs, outputs in zip(widths, widths[1:]):
        key, weight, bias = jax.random.split(key, 3)
        bound = inputs**-0.5
        made.append(
            (
                jax.random.uniform(weight, (inputs, outputs), minval=-bound, maxval=bound),
                jax.random.uniform(bias, (outputs,), minval=-bound, maxval=bound),
            )
        )
    return made


def forward(network, x):
    for weight, bias in network[:-1]:
        x = jax.nn.relu(x @ weight + bias)
    weight, bias = network[-1]
    return x @ weight + bias


def sample(policy, observations, noise):
    """Actions of the squashed Gaussian, and their log-probabilities."""
    mean, log_std = jnp.split(forward(policy, observations), 2, axis=-1)
    log_std = jnp.clip(log_std, -20.0, 2.0)
    raw = mean + jnp.exp(log_std) * noise
    log_prob = -0.5 * noise**2 - log_std - 0.5 * jnp.log(2.0 * jnp.pi)
    # log(1 - tanh²), stable.
    log_prob -= 2.0 * (jnp.log(2.0) - raw - jax.nn.softplus(-2.0 * raw))
    return jnp.tanh(raw), log_prob.sum(-1)


def smaller(critic, observations, actions):
    return forward(critic, jnp.concatenate([observations, actions], -1)).min(-1)


def main():
    updates, samples = int(sys.argv[1]), int(sys.argv[2])
    keys = jax.random.split(jax.random.PRNGKey(1), 8)
    policy = layers(keys[0], [OBSERVATION, WIDTH, WIDTH, WIDTH, 2 * ACTION])
    critic = layers(keys[1], [OBSERVATION + ACTION, WIDTH, WIDTH, 2])
    observations = jax.random.uniform(keys[2], (BATCH, OBSERVATION))
    actions = jax.random.uniform(keys[3], (BATCH, ACTION))
    rewards = jax.random.uniform(keys[4], (BATCH,))
    next_observations = jax.random.uniform(keys[5], (BATCH, OBSERVATION))
    adam = optax.adam(LEARNING_RATE)
    log_temperature = jnp.zeros(())
    state = (
        policy,
        critic,
        critic,
        log_temperature,
        adam.init(policy),
        adam.init(critic),
        adam.init(log_temperature),
    )

    def update(state, key):
        policy, critic, target, log_temperature, policy_adam, critic_adam, temperature_adam = state
        noise, next_noise = jax.random.normal(key, (2, BATCH, ACTION))
        temperature = jnp.exp(log_temperature)
        next_actions, next_log_prob = sample(policy, next_observations, next_noise)
        next_values = smaller(target, next_observations, next_actions)
        targets = rewards + DISCOUNT * (next_values - temperature * next_log_prob)

        def critic_loss(critic):
            values = forward(critic, jnp.concatenate([observations, actions], -1))
            return 0.5 * ((values - targets[:, None]) ** 2).sum(-1).mean()

        def policy_loss(policy):
            drawn, log_prob = sample(policy, observations, noise)
            values = smaller(critic, observations, drawn)
            return (temperature * log_prob - values).mean(), log_prob.mean()

        critic_gradient = jax.grad(critic_loss)(critic)
        policy_gradient, log_prob = jax.grad(policy_loss, has_aux=True)(policy)
        temperature_gradient = -temperature * (log_prob - ACTION)
        change, critic_adam = adam.update(critic_gradient, critic_adam)
        critic = optax.apply_updates(critic, change)
        change, policy_adam = adam.update(policy_gradient, policy_adam)
        policy = optax.apply_updates(policy, change)
        change, temperature_adam = adam.update(temperature_gradient, temperature_adam)
        log_temperature = optax.apply_updates(log_temperature, change)
        target = optax.incremental_update(critic, target, TARGET_RATE)
        return (
            policy,
            critic,
            target,
            log_temperature,
            policy_adam,
            critic_adam,
            temperature_adam,
        ), None

    @jax.jit
    def run(state, key):
        return jax.lax.scan(update, state, jax.random.split(key, updates))[0]

    key = keys[6]
    for number in range(samples + 1):
        key, own = jax.random.split(key)
        begun = time.perf_counter()
        state = jax.block_until_ready(run(state, own))
        if number > 0:
            print((time.perf_counter() - begun) / updates, flush=True)


if __name__ == "__main__":
    main()
