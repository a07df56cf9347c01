"""A user's own environment flies tickets of a run that is under way."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from . import _core
from .batch import IMAGE
from .task import OUTCOMES

_TERMS = len(_core.REWARD_TERMS)
_TRUTHS = 18
# Largest magnitude that a run accepts.
_LARGEST = 1e7
_REQUIRED: dict[str, tuple[int, ...]] = {"depth": (1, *IMAGE), "velocity": (3,)}


class Actor:
    """Joins runs as an actor, with an environment in the simulator's place.

    The run's policy flies it, with exploration, for each ticket that the learner issues; the
    learner takes the episodes like any other actor's. Needs ``pip install skein-rl[actor]``.

    The environment has an action of as many numbers as the run's ``simulator.vehicle.action``, in
    [-1, 1], and these parts of a ``Dict`` observation:

    ============  ====================  =========================================================
    ``depth``     uint8 [1, 72, 128]    planar depth, top row first; 255 is the range of the
                                        run's camera or farther
    ``velocity``  float32 [3]           forward, left, up, m/s
    ``goal``      float32 [3]           forward, left, up, m; for a policy that sees it
    ============  ====================  =========================================================

    Others are ignored. ``reset`` gets the ticket's seed, and as ``options`` the ticket's
    ``course`` (a name, or ``"random"`` with its ``course_seed``) and ``level``. An environment with
    a world of its own may ignore them. ``info`` may have:

    ================  ====================  =====================================================
    ``reward_terms``  float32 [8]           in the order of ``REWARD_TERMS``; their sum is the
                                            reward. Without them, the whole reward counts as
                                            ``open_view``
    ``walls_passed``  int                   so far. Default 0
    ``walls``         int                   of the course. Default: of the ticket's course
    ``outcome``       int                   index into ``OUTCOMES``. Default: a terminated episode
                                            has collided
    ``hit_wall``      int                   the wall that was hit, from 1; 0 for none
    ``position_m``    float32 [3]           along the corridor, left, up
    ``orientation``   float32 [4]           world from body, unit quaternion (i, j, k, w)
    ``ground_truth``  float32 [18]          as of :class:`skein_rl.CorridorEnv`
    ================  ====================  =====================================================

    Args:
        env: the environment; it is not closed.

    Raises:
        TypeError: it is no ``gymnasium.Env``.
        ValueError: a space is wrong; the message names it.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        if not isinstance(env, gymnasium.Env):
            raise TypeError(f"env = {env!r} is no gymnasium.Env")
        _check_spaces(env)
        self._env = env
        self._episodes = 0

    @property
    def episodes(self) -> int:
        """Episodes begun since this object was created."""
        return self._episodes

    def join(self, run_dir: str | os.PathLike[str]) -> None:
        """Flies tickets until the run is over.

        If the learner dies, it waits for the next incarnation. Call it from the main thread, or
        Ctrl-C goes elsewhere. An exception ends this actor alone: the run goes on, and another
        actor flies the episode.

        Args:
            run_dir: the run's directory.

        Raises:
            ImportError: the package skein-rl-actor is not installed.
            ValueError: the directory is no run, the run has all its actors, or the environment
                returned a wrong shape or number; the message names it.
            TimeoutError: a reset or a step took longer than ``transport.actor_silence_secs``.
            ConnectionError: no learner was heard of for ``transport.learner_silence_secs``.
            KeyboardInterrupt: Ctrl-C.
            Exception: whatever the environment raised.
        """
        try:
            import skein_rl_actor
        except ImportError as error:
            raise ImportError(
                f"{error}: joining a run needs the package skein-rl-actor: "
                "pip install skein-rl[actor], or launch/python.sh"
            ) from error
        if skein_rl_actor.__version__ != _core.__version__:
            raise ImportError(
                f"skein-rl-actor {skein_rl_actor.__version__} does not match skein-rl "
                f"{_core.__version__}: install both again"
            )
        skein_rl_actor.join(os.fspath(run_dir), self)

    # Called by the package skein-rl-actor.

    def reset(self, seed: int, options: dict[str, Any]) -> tuple[Any, ...]:
        """Starts an episode; returns its first moment for the transport."""
        self._episodes += 1
        returned = self._env.reset(seed=seed, options=options)
        if not isinstance(returned, tuple) or len(returned) != 2:
            raise ValueError("env.reset() did not return (observation, info)")
        observation, info = returned
        return _moment("env.reset()", observation, info, 0.0, 0)

    def step(self, action: list[float]) -> tuple[Any, ...]:
        """Flies a step; returns the moment after it for the transport."""
        if self._env.action_space.shape != (len(action),):
            raise ValueError(
                f"action_space has the shape {self._env.action_space.shape}, but actions of this "
                f"run have {len(action)} numbers: simulator.vehicle.action"
            )
        returned = self._env.step(np.array(action, dtype=np.float32))
        if not isinstance(returned, tuple) or len(returned) != 5:
            raise ValueError(
                "env.step() did not return (observation, reward, terminated, truncated, info)"
            )
        observation, reward, terminated, truncated, info = returned
        ended = _outcome(bool(terminated), bool(truncated), info)
        return _moment("env.step()", observation, info, reward, ended)

    def oracle(self, numbers: int) -> list[float]:
        """The action of the environment's oracle, for runs that learn from one."""
        oracle = getattr(self._env.unwrapped, "oracle_action", None)
        if oracle is None:
            raise ValueError(
                "the environment has no oracle_action(), but [teacher] policy = \"oracle\" of this "
                "run needs it: give the run a trained policy as its teacher"
            )
        return _numbers("env.oracle_action()", "action", oracle(), numbers)


def _check_spaces(env: gymnasium.Env[Any, Any]) -> None:
    spaces = env.observation_space
    if not isinstance(spaces, gymnasium.spaces.Dict):
        raise ValueError(
            f"observation_space = {spaces} is no Dict: give \"depth\" and \"velocity\""
        )
    for name, shape in _REQUIRED.items():
        if name not in spaces.spaces:
            raise ValueError(f"observation_space has no {name!r}: the policy needs it, {shape}")
        found = spaces[name].shape
        if found != shape:
            raise ValueError(f"observation_space[{name!r}] has the shape {found}, not {shape}")
    if spaces["depth"].dtype != np.uint8:
        raise ValueError(f"observation_space[\"depth\"] has {spaces['depth'].dtype}, not uint8")
    actions = env.action_space.shape
    if actions is None or len(actions) != 1 or not 2 <= actions[0] <= 4:
        raise ValueError(
            f"action_space has the shape {actions}, not (2,), (3,) or (4,): the numbers of the run's "
            "simulator.vehicle.action, in [-1, 1]"
        )


def _outcome(terminated: bool, truncated: bool, info: Mapping[str, Any]) -> int:
    """Index into OUTCOMES; termination wins over truncation, because it has no future."""
    if not terminated:
        return OUTCOMES.index("timed_out") if truncated else 0
    named = _count("env.step()", "outcome", info.get("outcome", OUTCOMES.index("collided")))
    if named not in (OUTCOMES.index("collided"), OUTCOMES.index("reached_end")):
        raise ValueError(
            f"env.step(): info[\"outcome\"] = {named} of a terminated episode: it is "
            f"{OUTCOMES.index('collided')} (collided) or {OUTCOMES.index('reached_end')} "
            "(reached_end)"
        )
    return named


def _moment(
    where: str, observation: Any, info: Mapping[str, Any], reward: Any, outcome: int
) -> tuple[Any, ...]:
    """A moment as ``actor/python/actor/src/foreign.rs`` takes it."""
    for name in _REQUIRED:
        if name not in observation:
            raise ValueError(f"{where}: the observation has no {name!r}")
    terms = info.get("reward_terms")
    whole = _numbers(where, "reward", reward, 1)[0]
    if terms is None:
        terms = [0.0] * _TERMS
        terms[_core.REWARD_TERMS.index("open_view")] = whole
    truth = info.get("ground_truth")
    walls = info.get("walls")
    collided = outcome == OUTCOMES.index("collided")
    return (
        _image(where, observation["depth"]),
        _numbers(where, "velocity", observation["velocity"], 3),
        None if "goal" not in observation else _numbers(where, "goal", observation["goal"], 3),
        _numbers(where, "info[\"position_m\"]", info.get("position_m", (0, 0, 0)), 3),
        _numbers(where, "info[\"orientation\"]", info.get("orientation", (0, 0, 0, 1)), 4),
        None if truth is None else _numbers(where, "info[\"ground_truth\"]", truth, _TRUTHS),
        _numbers(where, "info[\"reward_terms\"]", terms, _TERMS),
        _count(where, "walls_passed", info.get("walls_passed", 0)),
        _count(where, "hit_wall", info.get("hit_wall", 0)) if collided else 0,
        outcome,
        None if walls is None else _count(where, "walls", walls),
    )


def _image(where: str, depth: Any) -> bytes:
    array: npt.NDArray[Any] = np.asarray(depth)
    if array.dtype != np.uint8 or array.shape not in ((1, *IMAGE), IMAGE):
        raise ValueError(
            f"{where}: depth is {array.dtype} {list(array.shape)}, not uint8 [1, 72, 128]"
        )
    return array.tobytes()


def _numbers(where: str, name: str, values: Any, length: int) -> list[float]:
    array = np.asarray(values, dtype=np.float32).reshape(-1)
    if array.size != length:
        raise ValueError(f"{where}: {name} has {array.size} numbers, not {length}")
    if not (np.abs(array) <= _LARGEST).all():
        raise ValueError(
            f"{where}: {name} = {array.tolist()} is not finite or beyond ±{_LARGEST:g}"
        )
    numbers: list[float] = array.tolist()
    return numbers


def _count(where: str, name: str, value: Any) -> int:
    if not isinstance(value, (int, np.integer)) or not 0 <= value <= 255:
        raise ValueError(f"{where}: info[{name!r}] = {value!r} is no integer from 0 to 255")
    return int(value)
