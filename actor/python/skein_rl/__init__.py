"""Skein in Python: the simulator, the policies and the data.

>>> import skein_rl
>>> env = skein_rl.CorridorEnv(courses="random")
>>> observation, info = env.reset(seed=1)
>>> observation["depth"].shape
(1, 72, 128)

Units are metres, seconds and radians. The world frame has x forward along the corridor, y to the
left and z up. Seeds are those of Skein's tickets: ``reset(seed=s)`` starts the episode that an
actor flies for a ticket of seed ``s``.
"""

from gymnasium.envs.registration import register, registry

from . import export, rerun, sb3
from ._core import REWARD_TERMS, SHIPPED_COURSES, __version__
from .actor import Actor
from .data import Recording, Run, read_recording, read_run, to_minari
from .env import CorridorEnv
from .policy import Policy, fly
from .task import OBSERVABLE, OUTCOMES
from .vector import CorridorVectorEnv, make_vec

__all__ = [
    "OBSERVABLE",
    "OUTCOMES",
    "REWARD_TERMS",
    "SHIPPED_COURSES",
    "Actor",
    "CorridorEnv",
    "CorridorVectorEnv",
    "Policy",
    "Recording",
    "Run",
    "__version__",
    "export",
    "fly",
    "make_vec",
    "read_recording",
    "read_run",
    "rerun",
    "sb3",
    "to_minari",
]

if "Skein/Corridor-v0" not in registry:
    register(
        id="Skein/Corridor-v0",
        entry_point="skein_rl.env:CorridorEnv",
        vector_entry_point="skein_rl.vector:CorridorVectorEnv",
    )
