"""stable-baselines3's own vector environment, which takes no Gymnasium ``VectorEnv``."""

from __future__ import annotations

from typing import Any

__all__ = ["VecEnv"]  # noqa: F822


def __getattr__(name: str) -> Any:
    # stable-baselines3 needs PyTorch, which takes seconds to import.
    if name != "VecEnv":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from ._sb3 import VecEnv

    return VecEnv
