"""A snapshot's networks as a PyTorch module; imported only by ``Policy.to_torch``."""

from __future__ import annotations

from typing import Any

try:
    import torch
    from torch import nn
except ImportError:
    raise ImportError('Policy.to_torch needs PyTorch: pip install "skein-rl[torch]"') from None

from .policy import Policy


class TorchPolicy(nn.Module):  # type: ignore[misc, unused-ignore]
    """Encoder, policy and history, with the inputs and outputs of the ONNX graph.

    ``forward(depth, velocity, history, goal)`` returns ``(action, next_history)``; a goal is needed
    by a policy that sees it. A history is zeros at
    the start of an episode, see :meth:`start`. Trainable parameters have the snapshot's names.
    """

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        self.sees, self.history_steps = policy.observation, policy.history_steps
        weights = {name: torch.from_numpy(w) for name, w in policy.parameters().items()}
        self.encoder = nn.ModuleDict(
            {f"conv{n}": _conv(weights, f"encoder.conv{n}") for n in range(1, 5)}
        )
        self.encoder["mean"] = _linear(weights, "encoder.mean")
        self.policy = nn.ModuleDict(
            {f"layer{n}": _linear(weights, f"policy.layer{n}") for n in range(1, 5)}
        )
        self.action = len(policy.action_names)
        # A drone that flies forward at a constant speed sees its velocity left and up alone.
        self.velocity = 3 if "forward" in policy.action_names else 2
        parts = {"velocity": self.velocity, "action": self.action, "goal": 4}
        self.step_len = policy.latent + sum(parts[part] for part in self.sees.split("+")[1:])

    def start(self, n: int = 1) -> torch.Tensor:
        """History of ``n`` episodes that begin."""
        rows = max(self.history_steps, default=1)
        return torch.zeros(n, rows, self.step_len + self.action + 1)

    def encode(self, depth: torch.Tensor) -> torch.Tensor:
        """Latent codes ``[n, latent]`` of images, uint8 ``[n, 1, 72, 128]``."""
        x = depth.to(torch.float32) * (1.0 / 255.0)
        for n in range(1, 5):
            x = torch.relu(self.encoder[f"conv{n}"](x))
        code: torch.Tensor = self.encoder["mean"](x.flatten(1))
        return code

    def distribution(self, observed: torch.Tensor) -> torch.Tensor:
        """The last layer's outputs: means before tanh ``[n, action]`` and, of SAC, log deviations."""
        for n in range(1, 4):
            observed = torch.relu(self.policy[f"layer{n}"](observed))
        outputs: torch.Tensor = self.policy["layer4"](observed)
        return outputs

    def forward(
        self,
        depth: torch.Tensor,
        velocity: torch.Tensor,
        history: torch.Tensor,
        goal: torch.Tensor | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Actions ``[n, action]`` and the next history."""
        newest = history[:, 0]
        starts = newest[:, -1:] < 0.5
        parts = {
            "latent": self.encode(depth),
            "velocity": velocity[:, 3 - self.velocity :],
            "action": newest[:, self.step_len : self.step_len + self.action],
        }
        if goal is not None:
            away = goal.norm(dim=1, keepdim=True)
            parts["goal"] = torch.cat([goal / away.clamp(min=1e-3), away * 0.05], dim=1)
        present = torch.cat([parts[part] for part in self.sees.split("+")], dim=1)
        past = torch.where(starts[:, None], present[:, None], history[:, :, : self.step_len])
        moments = [present] + [past[:, back - 1] for back in self.history_steps]
        action = torch.tanh(self.distribution(torch.cat(moments, dim=1))[:, : self.action])
        row = torch.cat([present, action, torch.ones_like(action[:, :1])], dim=1)[:, None]
        known = torch.where(starts[:, None], row, history)
        return action, torch.cat([row, known[:, :-1]], dim=1)


def _conv(weights: dict[str, Any], name: str) -> nn.Conv2d:
    outputs, inputs, size, _ = weights[f"{name}.weight"].shape
    return _filled(nn.Conv2d(inputs, outputs, size, stride=2), weights, name)


def _linear(weights: dict[str, Any], name: str) -> nn.Linear:
    outputs, inputs = weights[f"{name}.weight"].shape
    return _filled(nn.Linear(inputs, outputs), weights, name)


def _filled(layer: Any, weights: dict[str, Any], name: str) -> Any:
    with torch.no_grad():
        layer.weight.copy_(weights[f"{name}.weight"])
        layer.bias.copy_(weights[f"{name}.bias"])
    return layer
