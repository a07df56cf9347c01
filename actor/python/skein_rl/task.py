"""What an environment flies, from keywords: shared by the single and the vector environment."""

from __future__ import annotations

import operator
import os
from collections.abc import Mapping, Sequence
from typing import Any, TypedDict, Union

import numpy as np
from gymnasium import spaces

from . import _core

# Most drones of a vector environment, and most rows of a policy's batch: a mistyped number must not
# take the machine's memory.
MOST_ROWS = 1 << 16

Course = Union[str, "os.PathLike[str]", Mapping[str, Any]]

OBSERVABLE = ("depth", "latent", "velocity", "goal", "previous_action", "ground_truth")
"""Parts of an observation."""

OUTCOMES = ("flying", "collided", "reached_end", "timed_out")
"""Names of the values of ``info["outcome"]``."""

_GROUND_TRUTH = 18
_SECTIONS = ("vehicle", "camera", "reward", "generator", "disturbances")


class TaskKeywords(TypedDict, total=False):
    """Keywords that say what is flown.

    courses: one or several of: the name of a shipped course (``SHIPPED_COURSES``), the path of a
        course file, a dictionary with such a file's keys, ``"random"``. Default ``"training"``.
    generated_share: probability of a random course in an episode. Default: the share of
        ``"random"`` in ``courses``.
    levels: levels that episodes start at: 1 is before the first wall. Default 1.
    simulator: settings of ``[simulator]`` as a dictionary.
    vehicle, camera, reward, generator, disturbances, max_steps: parts of it, which win over it.
    config: TOML file of a run's configuration; its simulator, courses and levels are the defaults
        of the keywords above.
    encoder: file of an encoder or a snapshot, for latent codes.
    """

    courses: Course | Sequence[Course]
    generated_share: float
    levels: int | Sequence[int]
    simulator: Mapping[str, Any]
    vehicle: Mapping[str, Any]
    camera: Mapping[str, Any]
    reward: Mapping[str, Any]
    generator: Mapping[str, Any]
    disturbances: Mapping[str, Any]
    max_steps: int
    config: str | os.PathLike[str]
    encoder: str | os.PathLike[str]


def build(keywords: Mapping[str, Any]) -> _core.Task:
    """Builds the task of these keywords.

    Raises:
        TypeError: a keyword is unknown or of the wrong type.
        ValueError: a value is out of bounds; the message has key, value and remedy.
    """
    known = TaskKeywords.__annotations__
    for key in keywords:
        if key not in known:
            raise TypeError(f"unknown keyword {key!r}: the keywords are {', '.join(known)}")
    given = {key: value for key, value in keywords.items() if value is not None}
    defaults: dict[str, Any] = {"courses": "training", "levels": 1, "simulator": {}}
    if "config" in given:
        defaults = _core.read_config(_file("config", given["config"]))
        if "courses" in given:
            del defaults["generated_share"]
    courses = _several(given.get("courses", defaults["courses"]))
    named = [course for course in courses if course != "random"]
    share = given.get("generated_share", defaults.get("generated_share"))
    if share is None:
        share = (len(courses) - len(named)) / max(len(courses), 1)
    levels = given.get("levels", defaults["levels"])
    levels = [levels] if isinstance(levels, (int, np.integer)) else list(levels)
    encoder = given.get("encoder")
    return _core.Task(
        _simulator(given, defaults["simulator"]),
        [course if isinstance(course, Mapping) else _path(course) for course in named],
        float(share),
        [_level(level) for level in levels],
        None if encoder is None else _file("encoder", encoder),
    )


def observed(parts: Sequence[str] | None, task: _core.Task) -> tuple[str, ...]:
    """Checks which parts are observed; the default is the latent code if there is an encoder."""
    if parts is None:
        return ("latent" if task.latent else "depth", "velocity", "previous_action")
    parts = (parts,) if isinstance(parts, str) else tuple(parts)
    for part in parts:
        if part not in OBSERVABLE:
            raise ValueError(f"observation: {part!r} is none of {', '.join(OBSERVABLE)}")
    if not parts:
        raise ValueError(f"observation = () is empty: name one or more of {', '.join(OBSERVABLE)}")
    if "latent" in parts and not task.latent:
        raise ValueError("observation: \"latent\" needs an encoder: name a file with encoder=")
    return parts


def observation_space(parts: Sequence[str], task: _core.Task) -> spaces.Dict:
    """The space of one observation."""
    mps, code = _core.MOST_MPS, _core.MOST_LATENT
    every: dict[str, spaces.Space[Any]] = {
        "depth": spaces.Box(0, 255, (1, 72, 128), np.uint8),
        "latent": spaces.Box(-code, code, (max(task.latent, 1),), np.float32),
        "velocity": spaces.Box(-mps, mps, (3,), np.float32),
        "goal": spaces.Box(-1e4, 1e4, (3,), np.float32),
        "previous_action": action_space(task),
        "ground_truth": spaces.Box(-1e4, 1e4, (_GROUND_TRUTH,), np.float32),
    }
    return spaces.Dict({part: every[part] for part in parts})


def action_space(task: _core.Task) -> spaces.Box:
    """The numbers of ``vehicle.action``: ``task.action_names``."""
    return spaces.Box(-1.0, 1.0, (len(task.action_names),), np.float32)


def count(name: str, value: Any) -> int:
    """Checks a number of drones, rows or threads."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise ValueError(f"{name} = {value!r} is no whole number")
    if not 1 <= value <= MOST_ROWS:
        raise ValueError(f"{name} = {value} is outside 1 to {MOST_ROWS}")
    return int(value)


def seed_of(seed: Any) -> int:
    """Checks a seed."""
    try:
        number = operator.index(seed)
    except TypeError:
        raise TypeError(f"seed = {seed!r} is no whole number") from None
    if not 0 <= number < 1 << 64:
        raise ValueError(f"seed = {seed} is outside 0 to 2**64 - 1")
    return number


def wishes(options: Mapping[str, Any] | None) -> dict[str, Any]:
    """Checks the options of a reset: course, course_seed, level."""
    options = dict(options or {})
    for key in options:
        if key not in ("course", "course_seed", "level"):
            raise ValueError(f"options: unknown key {key!r}: the keys are course, course_seed, level")
    if options.get("level") is not None:
        options["level"] = _level(options["level"])
    if options.get("course_seed") is not None:
        options["course_seed"] = seed_of(options["course_seed"])
    return options


def _level(level: Any) -> int:
    if isinstance(level, bool) or not isinstance(level, (int, np.integer)):
        raise TypeError(f"level = {level!r} is no integer: levels count from 1")
    if not 1 <= level <= 255:
        raise ValueError(f"level = {level} is no level: they count from 1")
    return int(level)


def _several(courses: Any) -> list[Any]:
    if isinstance(courses, (str, os.PathLike, Mapping)):
        return [courses]
    try:
        return list(courses)
    except TypeError:
        raise TypeError(f"courses = {courses!r} is neither a course nor a list of them") from None


def _file(name: str, value: Any) -> str:
    try:
        return os.fsdecode(value)
    except TypeError:
        raise TypeError(f"{name} = {value!r} is no path: name a file") from None


def _path(course: Any) -> Any:
    return os.fspath(course) if isinstance(course, os.PathLike) else course


def _simulator(given: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Merges settings: a configuration's, then ``simulator``, then its parts."""
    settings = _merged(defaults, _dictionary("simulator", given.get("simulator", {})))
    for section in _SECTIONS:
        if section in given:
            settings = _merged(settings, {section: _dictionary(section, given[section])})
    if "max_steps" in given:
        settings["max_steps"] = given["max_steps"]
    return settings


def _dictionary(name: str, value: Any) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise TypeError(f"{name} = {value!r} is no dictionary of settings")
    return value


def _merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(below)
    for key, value in above.items():
        under = merged.get(key)
        both = isinstance(value, Mapping) and isinstance(under, Mapping)
        merged[key] = _merged(under, value) if both else value  # type: ignore[arg-type]
        if isinstance(merged[key], Mapping):
            merged[key] = dict(merged[key])
    return merged


def in_use(error: RuntimeError, thing: str) -> RuntimeError | None:
    """The exception for a call of an object that another thread's call uses; None if ``error``
    says something else."""
    # PyO3's words for it.
    if not str(error).startswith("Already"):
        return None
    return RuntimeError(
        f"another thread's call is in progress: give each thread {thing} of its own"
    )
