"""Many drones at once: a vector environment over Rust threads."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any, Optional

import numpy as np
import numpy.typing as npt
from gymnasium.error import ClosedEnvironmentError
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from typing_extensions import Unpack

from . import _core, render, task
from .batch import Batch, arrays
from .env import ARRAYS, INTEGERS, Observation, actions_of, refusal
from .task import TaskKeywords



class CorridorVectorEnv(VectorEnv[Observation, npt.NDArray[np.float32], npt.NDArray[Any]]):
    """``num_envs`` drones, each as in :class:`skein_rl.CorridorEnv`, with the same episodes.

    The threads fly without the interpreter's lock, and the camera draws into the arrays that a call
    returns. Arrays are never used again. The number of threads changes no bit.

    Args:
        num_envs: number of drones.
        threads: threads that fly. Default: the processor's cores, at most ``num_envs``.
        autoreset_mode: Gymnasium's ``NEXT_STEP`` (default), ``SAME_STEP`` or ``DISABLED``.
        observation, render_mode, **keywords: as in :class:`skein_rl.CorridorEnv`.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        threads: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        observation: Sequence[str] | None = None,
        render_mode: str | None = None,
        **keywords: Unpack[TaskKeywords],
    ) -> None:
        self.autoreset_mode = _mode(autoreset_mode)
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": 10,
            "autoreset_mode": self.autoreset_mode,
        }
        render.check_mode(render_mode, ["rgb_array"])
        self.render_mode = render_mode
        self.num_envs = task.count("num_envs", num_envs)
        if threads is None:
            threads = min(len(os.sched_getaffinity(0)), self.num_envs)
        self.threads = task.count("threads", threads)
        self._keywords = dict(keywords)
        self._task = task.build(keywords)
        self._parts = task.observed(observation, self._task)
        self.single_observation_space = task.observation_space(self._parts, self._task)
        self.single_action_space = task.action_space(self._task)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._fleet: Optional[_core.Fleet] = self._new_fleet()
        self._seeded = np.zeros(self.num_envs, dtype=np.bool_)

    @property
    def settings(self) -> dict[str, Any]:
        """All settings of the simulator, defaults included."""
        return self._task.settings

    @property
    def action_names(self) -> list[str]:
        """Names of the numbers of an action, in order."""
        return self._task.action_names

    @property
    def course_names(self) -> list[str]:
        """Names of the courses; ``info["course"]`` holds indices into them."""
        return self._task.course_names

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode in every environment, or where ``options["reset_mask"]`` is true.

        Args:
            seed: a number (environment i gets ``seed + i``) or one for each environment.
            options: as in ``CorridorEnv.reset``, and ``reset_mask``, bool ``[num_envs]``.
        """
        fleet, options = self._open(), dict(options or {})
        mask = _mask(options.pop("reset_mask", None), self.num_envs)
        wishes = task.wishes(options)
        seeds = self._seeds(seed)
        super().reset(seed=seed if isinstance(seed, int) else None)
        for index in np.flatnonzero(mask & ~self._seeded):
            if seeds[index] is None:
                seeds[index] = int(self.np_random.integers(1 << 63))
        try:
            block = fleet.reset(seeds, mask.tolist(), **wishes)
        except RuntimeError as error:
            raise refusal(error, " without a reset_mask") from None
        self._seeded |= mask
        batch = arrays(block, self.num_envs, self._task)
        return self._observation(batch), _infos(batch, mask)

    def step(
        self, actions: npt.NDArray[np.float32]
    ) -> tuple[
        Observation, npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any], dict[str, Any]
    ]:
        """Flies one control period in every environment.

        Args:
            actions: float32 ``[num_envs, action]``.

        Raises:
            ValueError: shape or type is wrong, or a number is not finite; nothing was flown.
            ResetNeeded: an environment has no episode in progress.
        """
        fleet = self._open()
        try:
            block, ended, lasts = fleet.step(
                actions_of(actions, (self.num_envs, len(self.action_names)))
            )
        except RuntimeError as error:
            raise refusal(error) from None
        batch = arrays(block, self.num_envs, self._task)
        infos = _infos(batch, np.ones(self.num_envs, dtype=np.bool_))
        if ended:
            self._add_lasts(infos, ended, arrays(lasts, len(ended), self._task))
        return (
            self._observation(batch),
            batch["reward"],
            batch["terminated"],
            batch["truncated"],
            infos,
        )

    def oracle_actions(self) -> npt.NDArray[np.float32]:
        """Actions of an oracle that knows the courses, float32 ``[num_envs, action]``."""
        try:
            return np.array(self._open().oracle_actions(), dtype=np.float32)
        except RuntimeError as error:
            raise refusal(error) from None

    def render(self) -> tuple[npt.NDArray[np.uint8], ...] | None:
        """Returns an image of each environment, as ``CorridorEnv.render``."""
        if self.render_mode is None:
            return None
        fleet = self._open()
        return tuple(render.frame(fleet, index, self._task) for index in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Frees the simulators."""
        self._fleet = None

    def __getstate__(self) -> dict[str, Any]:
        state = self.__dict__.copy()
        del state["_task"]
        state["_fleet"] = None if self._fleet is None else self._fleet.state()
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._task = task.build(self._keywords)
        if self._fleet is not None:
            self._fleet = self._new_fleet()
            self._fleet.restore(state["_fleet"])

    def _new_fleet(self) -> _core.Fleet:
        return _core.Fleet(self._task, self.num_envs, self.threads, self.autoreset_mode.value)

    def _open(self) -> _core.Fleet:
        if self._fleet is None:
            raise ClosedEnvironmentError("the environments are closed: make others")
        return self._fleet

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, (int, np.integer)):
            return [task.seed_of(seed + index) for index in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(f"{len(seed)} seeds were given for {self.num_envs} environments")
        return [None if one is None else task.seed_of(one) for one in seed]

    def _observation(self, batch: Batch) -> Observation:
        return {part: batch[part] for part in self._parts}

    def _add_lasts(self, infos: dict[str, Any], ended: Sequence[int], lasts: Batch) -> None:
        """Adds what SAME_STEP returns beside: ``final_obs`` and ``final_info``."""
        mask = np.zeros(self.num_envs, dtype=np.bool_)
        mask[ended] = True
        final_obs = np.full(self.num_envs, None, dtype=object)
        for row, index in enumerate(ended):
            final_obs[index] = {part: lasts[part][row] for part in self._parts}
        final: dict[str, Any] = {}
        for key, value in _values(lasts).items():
            final[key] = np.zeros((self.num_envs, *value.shape[1:]), dtype=value.dtype)
            final[key][ended] = value
        infos["final_obs"], infos["_final_obs"] = final_obs, mask
        infos["final_info"] = {**final, **{f"_{key}": mask.copy() for key in final}}
        infos["_final_info"] = mask.copy()


def make_vec(
    n: int, threads: int | None = None, **keywords: Any
) -> CorridorVectorEnv:
    """Makes ``n`` drones on ``threads`` threads; keywords as in :class:`CorridorVectorEnv`."""
    return CorridorVectorEnv(n, threads=threads, **keywords)


def _values(batch: Batch) -> Batch:
    return {key: batch[key] for key in (*ARRAYS, *INTEGERS)}


def _infos(batch: Batch, mask: npt.NDArray[np.bool_]) -> dict[str, Any]:
    infos = _values(batch)
    if not mask.all():
        # The observation may share these arrays.
        infos = {key: column.copy() for key, column in infos.items()}
        for column in infos.values():
            column[~mask] = 0
    return {**infos, **{f"_{key}": mask.copy() for key in infos}}


def _mode(mode: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode[mode] if isinstance(mode, str) and mode.isupper() else AutoresetMode(mode)
    except (KeyError, ValueError):
        names = ", ".join(one.name for one in AutoresetMode)
        raise ValueError(f"autoreset_mode = {mode!r} is none of {names}") from None


def _mask(mask: Any, count: int) -> npt.NDArray[np.bool_]:
    if mask is None:
        return np.ones(count, dtype=np.bool_)
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or mask.shape != (count,):
        raise ValueError(f"options: reset_mask must be a bool array of the shape ({count},)")
    if not mask.any():
        raise ValueError("options: reset_mask is false everywhere: nothing would be reset")
    return mask
