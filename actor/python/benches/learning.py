"""Skein's SAC beside stable-baselines3's and one in CleanRL's style, on the same task.

    python learning.py [--peers skein,sb3,cleanrl] [--seeds 1,2,3] [--steps 30000] [--threads 2]
                       [--skein PROGRAM]

Task: ``Skein/Corridor-v0`` on its training course, with episodes that start at any of its five
levels, so that each wall is met from the first episode on. All three see the
latent code of one frozen encoder and the velocity left and up, 66 numbers. All have a policy of
three and two critics of two hidden layers of 256, batches of 256, one update a step, the same
rates and first temperature, and 300 random steps.

R is the share of walls passed in 20 episodes without exploration. The peers are judged every 1,000
steps, Skein every 20 training episodes, which are as many steps once it flies through. The judging
of the peers does not count as time; Skein's does, and so does the start of its processes. Who
reached R >= 0.9 flies 100 other episodes, the same for all.

Seeds are the outer loop, so that other work on the machine slows all peers. Processor seconds count
all threads and processes; for Skein, also its end.
"""

import argparse
import json
import os
import pathlib
import subprocess
import sys
import tempfile
import time

import gymnasium
import numpy as np

import skein_rl

REPOSITORY = pathlib.Path(__file__).resolve().parents[3]
ENCODER = REPOSITORY / "configs" / "snapshots" / "encoder.safetensors"
GOAL, WALLS, EPISODES, EVERY = 0.9, 5, 20, 1000
CHECK_EPISODES, CHECK_SEED = 100, 5000
POLICY, CRITIC, BATCH, WARMUP = [256] * 3, [256] * 2, 256, 300
RATE, DISCOUNT, TRACKING, TEMPERATURE = 3e-4, 0.97, 0.005, 0.2
LATENT, LEVELS, ACTORS, EPOCH = 64, 5, 2, 10
KEYWORDS = {"encoder": ENCODER, "observation": ["latent", "velocity"]}

CONFIG = f"""
[run]
seed = SEED
episodes = TRAINING
learner_threads = THREADS
[courses]
training = "{REPOSITORY}/configs/courses/training.toml"
evaluation = ["{REPOSITORY}/configs/courses/training.toml"]
[learning]
observation = "latent+velocity"
levels = {LEVELS}
warmup_steps = {WARMUP}
updates_per_step = 1.0
episodes_per_epoch = {EPOCH}
policy_lag = 1
[sac]
hidden_width = {POLICY[0]}
critic_networks = 2
batch_size = {BATCH}
policy_learning_rate = {RATE}
critic_learning_rate = {RATE}
temperature_learning_rate = {RATE}
initial_temperature = {TEMPERATURE}
discount = {DISCOUNT}
target_rate = {TRACKING}
[vae]
latent = {LATENT}
train_steps = 0
start_from = "{ENCODER}"
[evaluation]
window_episodes = 10
every_episodes = 20
candidate_margin = {WALLS}.0
confirm_episodes = {EPISODES}
trained_rate = {GOAL}
"""
# Steps of an episode that passes one wall or two: enough episodes for the steps that are asked for.
STEPS_AN_EPISODE = 25
# The learner's log has it once its policy counts as trained.
TRAINED = " trained rate="


def seen(observation):
    """What a policy sees, ``[…, 66]``: the forward speed is left out, because it is commanded."""
    return np.concatenate([observation["latent"], observation["velocity"][..., 1:]], -1)


class Flat(gymnasium.ObservationWrapper):
    """The environment with observations as one vector."""

    def __init__(self):
        levels = range(1, LEVELS + 1)
        super().__init__(gymnasium.make("Skein/Corridor-v0", levels=levels, **KEYWORDS))
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (LATENT + 2,), np.float32)

    def observation(self, observation):
        return seen(observation)


def share_of_walls(act, episodes, seed, **keywords):
    """R of `act` (observations to actions), in episodes of fixed seeds."""
    envs = skein_rl.make_vec(episodes, 2, autoreset_mode="DISABLED", **keywords)
    observations, infos = envs.reset(seed=seed)
    passed, flying = np.zeros(episodes), np.ones(episodes, bool)
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
    return passed.mean() / WALLS


class Judge:
    """Judges now and then; remembers when the goal was reached. Its own time does not count."""

    def __init__(self, act):
        self.act, self.rate, self.check, self.steps = act, 0.0, None, None
        self.secs = np.zeros(2)
        self.since = self._now()

    @staticmethod
    def _now():
        """Wall and processor seconds."""
        return np.array([time.perf_counter(), time.process_time()])

    def look(self, steps):
        """Returns whether training is over: the goal was reached."""
        if steps % EVERY:
            return False
        self.secs += self._now() - self.since
        self.rate = share_of_walls(lambda o: self.act(seen(o)), EPISODES, 1000, **KEYWORDS)
        print(f"    {steps} steps, {self.secs[0]:.0f} s: R = {self.rate:.2f}", flush=True)
        if self.rate >= GOAL:
            self.steps = steps
            self.check = share_of_walls(
                lambda o: self.act(seen(o)), CHECK_EPISODES, CHECK_SEED, **KEYWORDS
            )
        self.since = self._now()
        return self.steps is not None


def with_sb3(seed, asked):
    import stable_baselines3 as sb3
    import torch
    from stable_baselines3.common.callbacks import BaseCallback

    torch.set_num_threads(1)
    model = sb3.SAC(
        "MlpPolicy",
        Flat(),
        learning_rate=RATE,
        batch_size=BATCH,
        gamma=DISCOUNT,
        tau=TRACKING,
        ent_coef=f"auto_{TEMPERATURE}",
        learning_starts=WARMUP,
        policy_kwargs={"net_arch": {"pi": POLICY, "qf": CRITIC}},
        seed=seed,
        device="cpu",
    )
    judge = Judge(lambda observed: model.predict(observed, deterministic=True)[0])

    class Callback(BaseCallback):
        def _on_step(self):
            return not judge.look(self.num_timesteps)

    model.learn(asked.steps, callback=Callback())
    return judge


def with_cleanrl(seed, asked):
    """SAC as CleanRL writes it: one loop, one environment, one file."""
    import torch
    from torch import nn

    torch.set_num_threads(1)
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    env = Flat()

    def network(inputs, hidden, outputs):
        layers, sizes = [], [inputs, *hidden]
        for before, after in zip(sizes, sizes[1:]):
            layers += [nn.Linear(before, after), nn.ReLU()]
        return nn.Sequential(*layers, nn.Linear(sizes[-1], outputs))

    width = LATENT + 2
    policy = network(width, POLICY, 4)
    critics = [network(width + 2, CRITIC, 1) for _ in range(2)]
    targets = [network(width + 2, CRITIC, 1) for _ in range(2)]
    for critic, target in zip(critics, targets):
        target.load_state_dict(critic.state_dict())
    log_alpha = torch.full([1], np.log(TEMPERATURE), dtype=torch.float32, requires_grad=True)
    of_critics = [parameter for critic in critics for parameter in critic.parameters()]
    critic_optimizer = torch.optim.Adam(of_critics, RATE)
    policy_optimizer = torch.optim.Adam(policy.parameters(), RATE)
    alpha_optimizer = torch.optim.Adam([log_alpha], RATE)

    def sample(observed):
        mean, log_std = policy(observed).chunk(2, -1)
        # The range -5 to 2, as CleanRL squashes it.
        log_std = -5 + 3.5 * (log_std.tanh() + 1)
        normal = torch.distributions.Normal(mean, log_std.exp(), validate_args=False)
        raw = normal.rsample()
        action = raw.tanh()
        density = normal.log_prob(raw) - torch.log(1 - action**2 + 1e-6)
        return action, density.sum(-1)

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

    def act(observed):
        with torch.no_grad():
            return policy(torch.as_tensor(observed)).chunk(2, -1)[0].tanh().numpy()

    stored = [np.zeros((asked.steps, *s), np.float32) for s in ((width,), (2,), (), (width,), ())]
    judge = Judge(act)
    now = env.reset(seed=seed)[0]
    for step in range(asked.steps):
        if step < WARMUP:
            action = rng.uniform(-1, 1, 2).astype(np.float32)
        else:
            with torch.no_grad():
                action = sample(torch.as_tensor(now))[0].numpy()
        following, reward, terminated, truncated, _ = env.step(action)
        for array, new in zip(stored, (now, action, reward, following, terminated)):
            array[step] = new
        now = env.reset()[0] if terminated or truncated else following
        if step >= WARMUP:
            chosen = rng.integers(0, step + 1, BATCH)
            update([array[chosen] for array in stored])
        if judge.look(step + 1):
            break
    return judge


def with_skein(seed, asked):
    """A run of Skein, stopped once it is trained."""
    with tempfile.TemporaryDirectory() as folder:
        config, directory = pathlib.Path(folder) / "config.toml", pathlib.Path(folder) / "run"
        text = CONFIG.replace("SEED", str(seed)).replace("THREADS", str(asked.threads))
        config.write_text(text.replace("TRAINING", str(asked.steps // STEPS_AN_EPISODE)))
        command = [asked.skein, "run", "--config", config, "--run-dir", directory]
        command += ["--actors", str(ACTORS)]
        before = os.times()
        run = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        log = directory / "logs" / "learner.log"
        try:
            while run.poll() is None and not (log.exists() and TRAINED in log.read_text()):
                time.sleep(1.0)
        finally:
            run.terminate()
            run.wait()
        after = os.times()
        judge = Judge(None)
        summary = json.loads((directory / "summary.json").read_text())
        trained = summary["trained"]
        if trained and trained["steps"] <= asked.steps:
            spent = after.children_user + after.children_system
            spent -= before.children_user + before.children_system
            judge.steps, judge.secs = trained["steps"], np.array([trained["wall_secs"], spent])
            policy = skein_rl.Policy.load(directory / "snapshots" / "best.safetensors")
            policy.reset(CHECK_EPISODES)
            judge.check = share_of_walls(policy.act, CHECK_EPISODES, CHECK_SEED, **KEYWORDS)
        else:
            judge.rate = summary["best_confirmed_walls_passed"] / WALLS
    return judge


PEERS = {"skein": with_skein, "sb3": with_sb3, "cleanrl": with_cleanrl}


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--peers", default=",".join(PEERS))
    parser.add_argument("--seeds", default="1,2,3")
    parser.add_argument("--steps", type=int, default=30_000)
    # PyTorch has one thread: with two it is slower here.
    parser.add_argument("--threads", type=int, default=2, help="of Skein's learner")
    parser.add_argument("--skein", default=str(REPOSITORY / "target" / "release" / "skein"))
    asked = parser.parse_args()
    names = asked.peers.split(",")
    if unknown := set(names) - set(PEERS):
        sys.exit(f"learning.py: --peers {sorted(unknown)} unknown: choose from {sorted(PEERS)}")
    print(f"steps, wall and processor seconds to R >= {GOAL}, at most {asked.steps} steps")
    for seed in map(int, asked.seeds.split(",")):
        for name in names:
            judge = PEERS[name](seed, asked)
            wall, processor = judge.secs
            if judge.steps:
                result = f"{judge.steps} steps, {wall:.0f} s, {processor:.0f} s"
                print(f"{name:8} seed {seed}: {result}, R = {judge.check:.2f} in others", flush=True)
            else:
                print(f"{name:8} seed {seed}: not reached, R = {judge.rate:.2f}", flush=True)


if __name__ == "__main__":
    main()
