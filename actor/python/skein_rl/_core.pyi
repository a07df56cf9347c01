from os import PathLike
from typing import Any, Sequence

REWARD_TERMS: list[str]
SHIPPED_COURSES: list[str]
COLUMNS: list[str]
MOST_MPS: float
MOST_LATENT: float
__version__: str

class Task:
    course_names: list[str]
    action_names: list[str]
    latent: int
    settings: dict[str, Any]
    def __init__(
        self,
        simulator: dict[str, Any],
        courses: Sequence[Any],
        generated_share: float,
        levels: Sequence[int],
        encoder: str | None,
    ) -> None: ...

class Fleet:
    def __init__(self, task: Task, environments: int, threads: int, autoreset: str) -> None: ...
    def reset(
        self,
        seeds: Sequence[int | None],
        mask: Sequence[bool],
        course: int | str | None = None,
        course_seed: int | None = None,
        level: int | None = None,
    ) -> bytearray: ...
    def step(self, actions: bytes) -> tuple[bytearray, list[int], bytearray]: ...
    def oracle_actions(self) -> list[list[float]]: ...
    def chase(self, index: int) -> tuple[bytearray, list[float]]: ...
    def view(self, index: int) -> bytearray: ...
    def state(self) -> list[Any]: ...
    def restore(self, states: list[Any]) -> None: ...

class Policy:
    count: int
    config: dict[str, Any]
    version: int
    sha256: str
    latent: int
    observation: str
    action_names: list[str]
    history_steps: list[int]
    def __init__(self, path: str | PathLike[str], threads: int) -> None: ...
    def reset(self, seeds: Sequence[int]) -> None: ...
    def act(
        self,
        images: bytes | None,
        latents: bytes | None,
        velocities: bytes,
        previous: bytes | None,
        goals: bytes | None,
        starts: Sequence[bool],
        exploration: str,
    ) -> bytes: ...
    def encode(self, images: bytes) -> bytes: ...
    def parameters(self) -> list[tuple[str, list[int], bytes]]: ...
    def to_onnx(self) -> bytes: ...

def parse_toml(text: str) -> dict[str, Any]: ...
def read_config(path: str) -> dict[str, Any]: ...
def fly(
    task: Task,
    policy: Policy,
    seed: int,
    exploration: str,
    course: int | str | None = None,
    course_seed: int | None = None,
    level: int | None = None,
) -> dict[str, bytes]: ...
def simulate(task: Task, environments: int, threads: int, steps: int) -> None: ...
