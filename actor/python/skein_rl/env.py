"""The Gymnasium environment: one drone, one episode after another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Optional

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from typing_extensions import Unpack

from . import _core, render, task
from .batch import Batch, arrays
from .task import TaskKeywords

Observation = dict[str, npt.NDArray[Any]]
Action = npt.NDArray[np.float32]


class CorridorEnv(gymnasium.Env[Observation, Action]):
    """A quadrotor that flies through a corridor of walls with openings, by its depth camera.

    An action is float32 in [-1, 1], for one control period (0.5 s). By default it is ``[2]``: the
    velocity to command left and up, m/s; the drone flies forward on its own. With
    ``vehicle={"action": "velocity"}`` it is ``[3]``: forward (1 is ``max_speed_mps``, 0 hovers, -1
    flies back at 1 m/s), left and up; ``"velocity+yaw"`` adds the turning rate to the left, rad/s.
    :attr:`action_names` has the order.

    An observation is a dictionary of fresh arrays:

    ==================  ===================  ==================================================
    ``depth``           uint8 [1, 72, 128]   planar depth, top row first; 255 is the camera's
                                             range (20 m) or farther, 0 is no reading
    ``latent``          float32 [latent]     the encoder's code of that image
    ``velocity``        float32 [3]          forward, left, up, m/s, heading frame
    ``goal``            float32 [3]          forward, left, up, m, heading frame
    ``previous_action`` float32 [action]     zeros after a reset
    ``ground_truth``    float32 [18]         what the camera does not show
    ==================  ===================  ==================================================

    The reward is the sum of ``info["reward_terms"]``, in the order of ``REWARD_TERMS``. A collision
    and the end of the corridor terminate the episode; the step limit truncates it.

    Args:
        observation: parts of the observation. Default: depth, or latent with an encoder; velocity;
            previous_action.
        render_mode: ``"rgb_array"``, ``"human"`` (needs ``pip install skein-rl[human]``) or None.
        **keywords: what is flown, see :class:`skein_rl.task.TaskKeywords`.

    Raises:
        TypeError: a keyword is unknown or of the wrong type.
        ValueError: a setting is out of bounds; the message has key, value and remedy.
    """

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 10}

    def __init__(
        self,
        *,
        observation: Sequence[str] | None = None,
        render_mode: str | None = None,
        **keywords: Unpack[TaskKeywords],
    ) -> None:
        render.check_mode(render_mode, self.metadata["render_modes"])
        self.render_mode = render_mode
        self._keywords = dict(keywords)
        self._task = task.build(keywords)
        self._parts = task.observed(observation, self._task)
        self.observation_space = task.observation_space(self._parts, self._task)  # type: ignore[assignment]
        self.action_space = task.action_space(self._task)  # type: ignore[assignment]
        self._fleet: Optional[_core.Fleet] = _core.Fleet(self._task, 1, 1, "Disabled")
        self._seeded = False
        self._window: Optional[render.Window] = None

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
        """Names of the courses; ``info["course"]`` is an index into them."""
        return self._task.course_names

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: starts the episode that a ticket of this seed has. Later resets without a seed
                start the episodes that follow from it.
            options: ``course`` (index, name or ``"random"``), ``course_seed`` (of a random course),
                ``level``; by default drawn from the seed.

        Raises:
            ValueError: an option or the seed is wrong.
        """
        fleet, wishes = self._open(), task.wishes(options)
        number = None if seed is None else task.seed_of(seed)
        super().reset(seed=seed)
        if number is None and not self._seeded:
            number = int(self.np_random.integers(1 << 63))
        batch = self._batch(fleet.reset([number], [True], **wishes))
        self._seeded = True
        self._show()
        return self._observation(batch), _info(batch)

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Flies one control period.

        Raises:
            ValueError: the action has another shape or is not finite; nothing was flown.
            ResetNeeded: no episode is in progress.
        """
        fleet = self._open()
        try:
            stepped, *_ = fleet.step(actions_of(action, (len(self.action_names),)))
        except RuntimeError as error:
            raise refusal(error) from None
        self._show()
        batch = self._batch(stepped)
        return (
            self._observation(batch),
            float(batch["reward"][0]),
            bool(batch["terminated"][0]),
            bool(batch["truncated"][0]),
            _info(batch),
        )

    def oracle_action(self) -> Action:
        """The action of an oracle that knows the course, float32 ``[action]``: for teachers and
        tests."""
        try:
            return np.array(self._open().oracle_actions()[0], dtype=np.float32)
        except RuntimeError as error:
            raise refusal(error) from None

    def render(self) -> npt.NDArray[np.uint8] | None:
        """Returns an image from behind the drone with the depth image in a corner, uint8
        ``[288, 512, 3]``; None in the mode ``"human"``, which shows it in a window."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() was called, but no render_mode was given")
            return None
        if self.render_mode == "human":
            self._show()
            return None
        return self._frame()

    def close(self) -> None:
        """Closes the window and frees the simulator; a second call does nothing."""
        if self._window is not None:
            self._window.close()
        self._window = None
        self._fleet = None

    def __getstate__(self) -> dict[str, Any]:
        state = self.__dict__.copy()
        for name in ("_task", "_window"):
            del state[name]
        state["_fleet"] = None if self._fleet is None else self._fleet.state()
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._task = task.build(self._keywords)
        self._window = None
        if self._fleet is not None:
            self._fleet = _core.Fleet(self._task, 1, 1, "Disabled")
            self._fleet.restore(state["_fleet"])

    def _open(self) -> _core.Fleet:
        if self._fleet is None:
            raise ClosedEnvironmentError("the environment is closed: make another one")
        return self._fleet

    def _batch(self, block: bytearray) -> Batch:
        return arrays(block, 1, self._task)

    def _observation(self, batch: Batch) -> Observation:
        return {part: batch[part][0] for part in self._parts}

    def _frame(self) -> npt.NDArray[np.uint8]:
        try:
            return render.frame(self._open(), 0, self._task)
        except RuntimeError as error:
            raise refusal(error) from None

    def _show(self) -> None:
        if self.render_mode == "human":
            if self._window is None:
                self._window = render.Window(self.metadata["render_fps"])
            self._window.show(self._frame())


def refusal(error: RuntimeError, remedy: str = "") -> Exception:
    """The exception for a call that the simulator could not do: no episode is in progress, or
    another thread's call is. ``remedy`` is added to the first."""
    return task.in_use(error, "an environment") or ResetNeeded(f"{error}{remedy}")


def actions_of(actions: Any, shape: tuple[int, ...]) -> bytes:
    """Checks shape and type of actions; their values are checked where they are flown."""
    array = np.asarray(actions)
    if array.dtype.kind not in "fiu":
        raise ValueError(f"the action has the dtype {array.dtype}: give float32")
    if array.shape != shape:
        raise ValueError(f"the action has the shape {array.shape}, not {shape}")
    # A number beyond float32 becomes infinite, which is refused by its value.
    with np.errstate(over="ignore"):
        return array.astype(np.float32).tobytes()


def _info(batch: Batch) -> dict[str, Any]:
    info: dict[str, Any] = {key: batch[key][0] for key in ARRAYS}
    info.update({key: batch[key][0] for key in INTEGERS})
    return info


ARRAYS = ("reward_terms", "ground_truth", "position_m", "orientation")
"""Parts of ``info`` that are arrays."""

INTEGERS = (
    "outcome",
    "walls_passed",
    "level",
    "hit_wall",
    "step",
    "seed",
    "course",
    "course_seed",
)
"""Parts of ``info`` that are integers."""
