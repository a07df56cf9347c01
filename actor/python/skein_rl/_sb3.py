"""See :mod:`skein_rl.sb3`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Optional

import numpy as np

try:
    from stable_baselines3.common.vec_env import VecEnv as _VecEnv
except ImportError:
    raise ImportError('skein_rl.sb3 needs stable-baselines3: pip install "skein-rl[sb3]"') from None

from gymnasium.vector import AutoresetMode

from .vector import CorridorVectorEnv


class VecEnv(_VecEnv):  # type: ignore[misc]
    """``n`` drones as stable-baselines3 sees them; keywords as in :class:`skein_rl.make_vec`.

    >>> from stable_baselines3 import SAC
    >>> SAC("MultiInputPolicy", skein_rl.sb3.VecEnv(4, encoder="encoder.safetensors"))
    """

    def __init__(self, n: int, threads: int | None = None, **keywords: Any) -> None:
        self.env = CorridorVectorEnv(
            n, threads=threads, autoreset_mode=AutoresetMode.SAME_STEP, **keywords
        )
        self.render_mode = self.env.render_mode
        self._actions: Any = None
        super().__init__(n, self.env.single_observation_space, self.env.single_action_space)

    def reset(self) -> Any:
        """Starts an episode in every environment, with the seeds of :meth:`seed`."""
        seeds = [None if seed is None else int(seed) for seed in self._seeds]
        observations, infos = self.env.reset(seed=seeds, options=self._options[0] or None)
        self.reset_infos = [_single(infos, index) for index in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: Any) -> None:
        """Takes actions, ``[n, 2]``."""
        self._actions = actions

    def step_wait(self) -> Any:
        """Flies them: observations, rewards, ends, infos."""
        observations, rewards, terminated, truncated, infos = self.env.step(self._actions)
        singles = []
        for index in range(self.num_envs):
            ended = terminated[index] or truncated[index]
            info = _single(infos["final_info"] if ended else infos, index)
            if ended:
                info["terminal_observation"] = infos["final_obs"][index]
            info["TimeLimit.truncated"] = bool(truncated[index] and not terminated[index])
            singles.append(info)
        return observations, rewards.astype(np.float32), terminated | truncated, singles

    def close(self) -> None:
        """Frees the simulators."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of the environments, once for each index."""
        return [getattr(self.env, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refused: the environments have no attributes of their own."""
        raise AttributeError(f"{attr_name} cannot be set: give it as a keyword of VecEnv")

    def env_method(
        self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any
    ) -> list[Any]:
        """Refused: the environments have no methods of their own."""
        raise AttributeError(f"{method_name}: the environments of this VecEnv have no methods")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """False: nothing wraps a single environment."""
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[Optional[Any]]:
        """An image of each environment."""
        frames: Iterable[Any] = self.env.render() or [None] * self.num_envs
        return list(frames)


def _single(infos: dict[str, Any], index: int) -> dict[str, Any]:
    plain = (key for key in infos if not key.startswith("_") and not key.startswith("final_"))
    return {key: infos[key][index] for key in plain}
