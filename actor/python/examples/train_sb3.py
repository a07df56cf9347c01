"""Trains stable-baselines3's SAC on random courses, flies what came out, and draws it.

    python train_sb3.py SNAPSHOT [STEPS] [PICTURE]

SNAPSHOT gives the encoder, for example configs/snapshots/generalist.safetensors: SAC learns the
policy alone, from codes and velocity. PICTURE is a .gif file of one flight of the result.
"""

import sys

import numpy as np
from PIL import Image
from stable_baselines3 import SAC

import skein_rl

TASK = {"courses": "random", "observation": ["latent", "velocity"]}


def fly(model, env, episodes):
    """Flies without exploration: share of the walls passed, share of episodes that arrived."""
    passed, arrived = [], 0
    for seed in range(1000, 1000 + episodes):
        observation, info = env.reset(seed=seed)
        ended = False
        while not ended:
            action, _ = model.predict(observation, deterministic=True)
            observation, _, terminated, truncated, info = env.step(action)
            ended = terminated or truncated
        passed.append(info["walls_passed"] / 5)
        arrived += skein_rl.OUTCOMES[info["outcome"]] == "reached_end"
    return np.mean(passed), arrived / episodes


def frames(model, env, seed):
    """Images of one flight, ``[steps, 288, 512, 3]``."""
    observation, _ = env.reset(seed=seed)
    images, ended = [env.render()], False
    while not ended:
        action, _ = model.predict(observation, deterministic=True)
        observation, _, terminated, truncated, _ = env.step(action)
        images.append(env.render())
        ended = terminated or truncated
    return np.stack(images)


def main(snapshot, steps=20_000, picture=None):
    envs = skein_rl.sb3.VecEnv(8, encoder=snapshot, **TASK)
    model = SAC(
        "MultiInputPolicy",
        envs,
        learning_starts=1000,
        train_freq=1,
        gradient_steps=8,
        gamma=0.97,
        seed=1,
        verbose=1,
    )
    env = skein_rl.CorridorEnv(encoder=snapshot, render_mode="rgb_array", **TASK)
    print("before: walls passed {:.2f}, arrived {:.2f}".format(*fly(model, env, 20)))
    model.learn(int(steps), log_interval=40)
    print("after:  walls passed {:.2f}, arrived {:.2f}".format(*fly(model, env, 20)))
    if picture:
        first, *others = map(Image.fromarray, frames(model, env, 1000))
        first.save(picture, save_all=True, append_images=others, duration=200, loop=0)


if __name__ == "__main__":
    main(*sys.argv[1:])
