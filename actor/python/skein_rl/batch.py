"""A batch of moments: arrays of the block of bytes that a call returns, without a copy."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from . import _core

Batch = dict[str, npt.NDArray[Any]]

IMAGE = (72, 128)
_PIXELS = IMAGE[0] * IMAGE[1]

# Type and width of each column; 0 is a single number a row. `src/batch.rs` has the order.
_KINDS: dict[str, tuple[Any, int]] = {
    "reward": (np.float64, 0),
    "seed": (np.int64, 0),
    "course_seed": (np.int64, 0),
    "course": (np.int64, 0),
    "step": (np.int64, 0),
    "level": (np.int64, 0),
    "walls_passed": (np.int64, 0),
    "hit_wall": (np.int64, 0),
    "outcome": (np.int64, 0),
    "velocity": (np.float32, 3),
    "goal": (np.float32, 3),
    "previous_action": (np.float32, 4),
    "reward_terms": (np.float32, len(_core.REWARD_TERMS)),
    "position_m": (np.float32, 3),
    "orientation": (np.float32, 4),
    "ground_truth": (np.float32, 18),
    "latent": (np.float32, 64),
    "terminated": (np.bool_, 0),
    "truncated": (np.bool_, 0),
}
if list(_KINDS) != _core.COLUMNS:
    raise ImportError("skein_rl and its compiled part are of different versions: install again")


def arrays(block: bytearray, n: int, task: _core.Task) -> Batch:
    """Arrays ``[n, …]`` by name; they share the block's memory, which nobody else has."""
    latent, numbers = task.latent, len(task.action_names)
    depth = np.frombuffer(block, np.uint8, n * _PIXELS)
    batch: Batch = {"depth": depth.reshape(n, 1, *IMAGE)}
    place = n * _PIXELS
    for name, (kind, width) in _KINDS.items():
        column = np.frombuffer(block, kind, n * max(width, 1), place)
        place += column.nbytes
        batch[name] = column.reshape(n, width) if width else column
    batch["previous_action"] = batch["previous_action"][:, :numbers]
    if latent:
        batch["latent"] = batch["latent"][:, :latent]
    else:
        del batch["latent"]
    return batch
