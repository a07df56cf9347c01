"""Skein's SAC beside stable-baselines3's and one in CleanRL's style, on the same task.

    python learning.py [--peers sb3,cleanrl,skein] [--seeds 1,2,3] [--steps 30000] [--skein PROGRAM]

Task: the training course, observation latent code and velocity, a frozen encoder. All have two
critics and networks of three hidden layers of 256, batches of 256, one update a step, and the same
rates. Each is judged every 1,000 steps by 20 episodes without exploration: R is the share of walls
passed. It prints, for each peer and seed, steps and wall time to R >= 0.9. The peers' judging does
not count as time; Skein's does. All have two threads.
"""

import argparse
import json
import pathlib
import subprocess
import sys
import tempfile
import time

import numpy as np

import skein_rl

REPOSITORY = pathlib.Path(__file__).resolve().parents[3]
ENCODER = REPOSITORY / "configs" / "snapshots" / "encoder.safetensors"
GOAL, EPISODES, EVERY = 0.9, 20, 1000
WIDTH, BATCH, RATE, DISCOUNT, TRACKING, WARMUP = 256, 256, 3e-4, 0.97, 0.005, 300
THREADS = 2
KEYWORDS = {"encoder": ENCODER, "observation": ["latent", "velocity"]}

CONFIG = f"""
[run]
seed = SEED
episodes = EPISODES
learner_threads = {THREADS}
[courses]
training = "{REPOSITORY}/configs/courses/training.toml"
evaluation = ["{REPOSITORY}/configs/courses/training.toml"]
[learning]
observation = "latent+velocity"
warmup_steps = {WARMUP}
updates_per_step = 1.0
episodes_per_epoch = 10
[sac]
hidden_width = {WIDTH}
critic_networks = 2
batch_size = {BATCH}
policy_learning_rate = {RATE}
critic_learning_rate = {RATE}
temperature_learning_rate = {RATE}
discount = {DISCOUNT}
target_rate = {TRACKING}
[vae]
latent = 64
train_steps = 0
start_from = "{ENCODER}"
[evaluation]
every_episodes = 50
confirm_episodes = {EPISODES}
trained_rate = {GOAL}
"""


def share_of_walls(act):
    """R of `act` (observations to actions), in episodes of fixed seeds."""
    envs = skein_rl.make_vec(EPISODES, THREADS, autoreset_mode="DISABLED", **KEYWORDS)
    observations, infos = envs.reset(seed=1000)
    passed, flying = np.zeros(EPISODES), np.ones(EPISODES, bool)
    while flying.any():
        actions = np.asarray(act(observations), np.float32)
        observations, _, terminated, truncated, infos = envs.step(actions)
        ended = flying & (terminated | truncated)
        passed[ended] = infos["walls_passed"][ended]
        flying &= ~ended
        over = terminated | truncated
        if over.any():
            # They fly on, so that the rest can, but no longer count.
            observations, _ = envs.reset(options={"reset_mask": over})
    envs.close()
    return passed.mean() / 5


class Judge:
    """Judges now and then; remembers when the goal was reached. Its own time does not count."""

    def __init__(self, act):
        self.act, self.begun, self.reached, self.rate = act, time.perf_counter(), None, 0.0

    def look(self, steps):
        if steps % EVERY or self.reached:
            return
        paused = time.perf_counter()
        self.rate = share_of_walls(self.act)
        print(f"    {steps} steps, {paused - self.begun:.0f} s: R = {self.rate:.2f}", flush=True)
        if self.rate >= GOAL:
            self.reached = (steps, paused - self.begun)
        self.begun += time.perf_counter() - paused


def with_sb3(seed, steps):
    import stable_baselines3 as sb3
    import torch
    from stable_baselines3.common.callbacks import BaseCallback

    torch.set_num_threads(THREADS)
    net = {"net_arch": [WIDTH] * 3}
    model = sb3.SAC(
        "MultiInputPolicy",
        skein_rl.CorridorEnv(**KEYWORDS),
        learning_rate=RATE,
        batch_size=BATCH,
        gamma=DISCOUNT,
        tau=TRACKING,
        learning_starts=WARMUP,
        policy_kwargs=net,
        seed=seed,
        device="cpu",
    )
    judge = Judge(lambda seen: model.predict(seen, deterministic=True)[0])

    class Callback(BaseCallback):
        def _on_step(self):
            judge.look(self.num_timesteps)
            return judge.reached is None

    model.learn(steps, callback=Callback())
    return judge


def with_cleanrl(seed, steps):
    """SAC as CleanRL writes it: one loop, one environment, one file."""
    import torch
    from torch import nn

    torch.set_num_threads(THREADS)
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    env = skein_rl.CorridorEnv(**KEYWORDS)

    def flat(seen):
        return np.concatenate([seen["latent"], seen["velocity"]], -1)

    def network(width, outputs):
        layers, sizes = [], [width] + [WIDTH] * 3
        for before, after in zip(sizes, sizes[1:]):
            layers += [nn.Linear(before, after), nn.ReLU()]
        return nn.Sequential(*layers, nn.Linear(WIDTH, outputs))

    seen = flat(env.reset(seed=seed)[0])
    width = len(seen)
    policy = network(width, 4)
    critics = [network(width + 2, 1) for _ in range(2)]
    targets = [network(width + 2, 1) for _ in range(2)]
    for critic, target in zip(critics, targets):
        target.load_state_dict(critic.state_dict())
    log_alpha = torch.zeros(1, requires_grad=True)
    of_critics = [parameter for critic in critics for parameter in critic.parameters()]
    critic_optimizer = torch.optim.Adam(of_critics, RATE)
    policy_optimizer = torch.optim.Adam(policy.parameters(), RATE)
    alpha_optimizer = torch.optim.Adam([log_alpha], RATE)

    def sample(observed):
        mean, log_std = policy(observed).chunk(2, -1)
        normal = torch.distributions.Normal(mean, log_std.clamp(-5, 2).exp())
        raw = normal.rsample()
        squash = 2 * (np.log(2) - raw - nn.functional.softplus(-2 * raw))
        return raw.tanh(), (normal.log_prob(raw) - squash).sum(-1)

    def values(networks, observed, action):
        joined = torch.cat([observed, action], -1)
        return torch.stack([one(joined).squeeze(-1) for one in networks])

    def update(batch):
        observed, action, reward, following, terminated = (torch.as_tensor(x) for x in batch)
        alpha = log_alpha.exp().detach()
        with torch.no_grad():
            next_action, density = sample(following)
            soft = values(targets, following, next_action).amin(0) - alpha * density
            wanted = reward + DISCOUNT * (1 - terminated) * soft
        loss = ((values(critics, observed, action) - wanted) ** 2).mean(-1).sum()
        critic_optimizer.zero_grad(), loss.backward(), critic_optimizer.step()
        own, density = sample(observed)
        loss = (alpha * density - values(critics, observed, own).amin(0)).mean()
        policy_optimizer.zero_grad(), loss.backward(), policy_optimizer.step()
        loss = -(log_alpha.exp() * (density.detach() - 2)).mean()
        alpha_optimizer.zero_grad(), loss.backward(), alpha_optimizer.step()
        with torch.no_grad():
            for critic, target in zip(critics, targets):
                for one, other in zip(critic.parameters(), target.parameters()):
                    other.lerp_(one, TRACKING)

    def act(observations):
        with torch.no_grad():
            return policy(torch.as_tensor(flat(observations))).chunk(2, -1)[0].tanh().numpy()

    stored = [np.zeros((steps, *s), np.float32) for s in ((width,), (2,), (), (width,), ())]
    judge = Judge(act)
    for step in range(steps):
        if step < WARMUP:
            action = rng.uniform(-1, 1, 2).astype(np.float32)
        else:
            with torch.no_grad():
                action = sample(torch.as_tensor(seen))[0].numpy()
        observation, reward, terminated, truncated, _ = env.step(action)
        following = flat(observation)
        for array, new in zip(stored, (seen, action, reward, following, terminated)):
            array[step] = new
        seen = flat(env.reset()[0]) if terminated or truncated else following
        if step >= WARMUP:
            chosen = rng.integers(0, step + 1, BATCH)
            update([array[chosen] for array in stored])
        judge.look(step + 1)
        if judge.reached:
            break
    return judge


def with_skein(seed, steps, program):
    """A run of Skein; episodes enough for `steps`, which an untrained drone's are 17 of."""
    with tempfile.TemporaryDirectory() as folder:
        config = pathlib.Path(folder) / "config.toml"
        episodes = max(50, steps // 60)
        text = CONFIG.replace("SEED", str(seed)).replace("= EPISODES", f"= {episodes}")
        config.write_text(text)
        directory = pathlib.Path(folder) / "run"
        command = [program, "run", "--config", config, "--run-dir", directory]
        subprocess.run([*command, "--actors", str(THREADS)], check=True, capture_output=True)
        summary = json.loads((directory / "summary.json").read_text())
    judge = Judge(None)
    if trained := summary.get("trained"):
        judge.reached, judge.rate = (trained["steps"], trained["wall_secs"]), trained["rate"]
    return judge


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--peers", default="sb3,cleanrl,skein")
    parser.add_argument("--seeds", default="1,2,3")
    parser.add_argument("--steps", type=int, default=30_000)
    parser.add_argument("--skein", default=str(REPOSITORY / "target" / "release" / "skein"))
    asked = parser.parse_args()
    peers = {
        "sb3": with_sb3,
        "cleanrl": with_cleanrl,
        "skein": lambda seed, steps: with_skein(seed, steps, asked.skein),
    }
    names = asked.peers.split(",")
    if unknown := set(names) - set(peers):
        sys.exit(f"learning.py: --peers {sorted(unknown)} unknown: choose from {sorted(peers)}")
    print(f"steps and seconds to R >= {GOAL}, at most {asked.steps} steps")
    for name in names:
        for seed in map(int, asked.seeds.split(",")):
            judge = peers[name](seed, asked.steps)
            if judge.reached:
                steps, secs = judge.reached
                print(f"{name:8} seed {seed}: {steps} steps, {secs:.0f} s", flush=True)
            else:
                print(f"{name:8} seed {seed}: not reached, R = {judge.rate:.2f}", flush=True)


if __name__ == "__main__":
    main()
