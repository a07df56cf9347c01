"""Trained policies, flown with the actor's own arithmetic."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from . import _core, task
from .batch import IMAGE

if TYPE_CHECKING:
    from .env import CorridorEnv
    from .torch import TorchPolicy

_PIXELS = IMAGE[0] * IMAGE[1]


class Policy:
    """A snapshot's encoder and policy.

    It remembers the episode, because a policy may see earlier steps. Call :meth:`reset` when an
    episode begins, or tell :meth:`act` which ones do. Its actions are equal to an actor's, bit for
    bit. A copy or a pickle has the networks, not the episode: it begins anew.

    >>> policy = skein_rl.Policy.load("configs/snapshots/generalist.safetensors")
    >>> policy.reset()
    >>> action = policy.act(observation)
    """

    def __init__(self, path: str | os.PathLike[str], *, threads: int | None = None) -> None:
        self._path = os.fspath(path)
        cores = len(os.sched_getaffinity(0))
        self._threads = cores if threads is None else task.count("threads", threads)
        self._core = _core.Policy(self._path, self._threads)
        self._seed = 0

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, threads: int | None = None) -> Policy:
        """Reads a snapshot, for example ``DIR/snapshots/best.safetensors`` of a run.

        Args:
            path: the snapshot's file.
            threads: threads that share a batch. Default: the processor's cores.

        Raises:
            ValueError: the file cannot be read or is no snapshot; the message names it.
        """
        return cls(path, threads=threads)

    @property
    def config(self) -> dict[str, Any]:
        """Configuration that it was trained with: dictionaries by section."""
        return self._core.config

    @property
    def simulator(self) -> dict[str, Any]:
        """Its section ``[simulator]``: ``CorridorEnv(simulator=policy.simulator)``."""
        section: dict[str, Any] = self.config.get("simulator", {})
        return section

    @property
    def version(self) -> int:
        """Number of the snapshot within its run."""
        return self._core.version

    @property
    def sha256(self) -> str:
        """SHA-256 of the parameters, as in a run's reports."""
        return self._core.sha256

    @property
    def latent(self) -> int:
        """Length of the latent code."""
        return self._core.latent

    @property
    def observation(self) -> str:
        """What it sees of a step, as ``learning.observation``: ``latent+velocity``, …"""
        return self._core.observation

    @property
    def action_names(self) -> list[str]:
        """Names of the numbers of an action, in order."""
        return self._core.action_names

    @property
    def history_steps(self) -> list[int]:
        """Numbers of steps back of the earlier steps that it also sees."""
        return self._core.history_steps

    def reset(self, n: int = 1, *, seed: int | Sequence[int] = 0) -> None:
        """Forgets everything: ``n`` episodes begin.

        Args:
            n: rows of later batches, 1 to 65,536.
            seed: of the noise of ``act(…, deterministic=False)``; row i draws as an actor with a
                ticket of ``seed + i``, or of ``seed[i]``.

        Raises:
            ValueError: a number is out of bounds.
        """
        n, several = task.count("n", n), isinstance(seed, Sequence)
        seeds = list(seed) if several else [int(seed) + row for row in range(n)]  # type: ignore[arg-type]
        self._core.reset([task.seed_of(one) for one in seeds])

    def act(
        self,
        observation: Mapping[str, npt.NDArray[Any]],
        *,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> npt.NDArray[np.float32]:
        """Chooses actions.

        Args:
            observation: one observation of :class:`skein_rl.CorridorEnv`, or a batch of
                :class:`skein_rl.CorridorVectorEnv`: ``depth`` (or ``latent``), ``velocity``,
                ``goal`` for a policy that sees it, and ``previous_action``; without the last, the
                action returned before.
            episode_start: bool ``[n]``, where an episode begins with this observation.
            deterministic: False draws from the policy, as in training.

        Returns:
            float32 ``[action]``, or ``[n, action]`` for a batch.

        Raises:
            KeyError: a part of the observation is missing.
            ValueError: a shape or a number is wrong.
            RuntimeError: another thread's call is in progress; a policy remembers one flight.
        """
        try:
            return self._act(observation, episode_start, deterministic)
        except RuntimeError as error:
            raise task.in_use(error, "a policy") or error from None

    def _act(
        self, observation: Mapping[str, npt.NDArray[Any]], episode_start: Any, deterministic: bool
    ) -> npt.NDArray[np.float32]:
        if "velocity" not in observation:
            raise KeyError("the observation has no \"velocity\": observe it, float32 [3]")
        velocity = np.asarray(observation["velocity"])
        if velocity.ndim not in (1, 2):
            raise ValueError(f"velocity has the shape {velocity.shape}: give [3] or [n, 3]")
        single = velocity.ndim == 1
        rows = 1 if single else len(velocity)
        if self._core.count != rows:
            if self._core.count:
                raise ValueError(
                    f"the observation has {rows} rows, {self._core.count} were there before: "
                    f"call reset({rows}) first"
                )
            self.reset(rows)
        lead = () if single else (rows,)

        def numbers(name: str, width: int) -> bytes | None:
            """A part as bytes, ``[width]`` for one row and ``[rows, width]`` for several."""
            part = observation.get(name)
            return None if part is None else _numbers(name, part, (*lead, width))

        depth, latent = observation.get("depth"), observation.get("latent")
        if depth is None and latent is None:
            raise KeyError("the observation has neither \"depth\" nor \"latent\"")
        if observation.get("goal") is None and "goal" in self.observation:
            raise KeyError("the observation has no \"goal\": observe it, float32 [3]")
        starts = np.zeros(rows, np.bool_) if episode_start is None else np.atleast_1d(episode_start)
        block = self._core.act(
            None if depth is None or latent is not None else _images(depth, rows),
            numbers("latent", self.latent),
            _numbers("velocity", velocity, (*lead, 3)),
            numbers("previous_action", len(self.action_names)),
            numbers("goal", 3),
            starts.astype(np.bool_).tolist(),
            "mode" if deterministic else "sample",
        )
        actions: npt.NDArray[np.float32] = np.frombuffer(block, np.float32).copy()
        return actions if single else actions.reshape(rows, len(self.action_names))

    def encode(self, depth: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
        """Latent codes, float32 ``[n, latent]``, of depth images, uint8 ``[n, …, 72, 128]``."""
        images = np.asarray(depth)
        rows = images.size // _PIXELS
        block = self._core.encode(_images(images, rows))
        codes: npt.NDArray[np.float32] = np.frombuffer(block, np.float32).copy()
        return codes if images.ndim == 2 else codes.reshape(rows, self.latent)

    def parameters(self) -> dict[str, npt.NDArray[np.float32]]:
        """Parameters by PyTorch's names, ``encoder.conv1.weight`` to ``policy.layer4.bias``."""
        return {
            name: np.frombuffer(data, dtype="<f4").reshape(shape).copy()
            for name, shape, data in self._core.parameters()
        }

    def to_torch(self) -> TorchPolicy:
        """Returns the networks as a ``torch.nn.Module``; needs ``pip install skein-rl[torch]``."""
        from .torch import TorchPolicy

        return TorchPolicy(self)

    def to_onnx(self, path: str | os.PathLike[str] | None = None) -> bytes:
        """Returns the networks as an ONNX graph, and writes it to ``path``: see ``docs/python.md``,
        *Export*."""
        graph = self._core.to_onnx()
        if path is not None:
            Path(path).write_bytes(graph)
        return graph

    def __reduce__(self) -> Any:
        return _loaded, (self._path, self._threads)


def _loaded(path: str, threads: int) -> Policy:
    return Policy(path, threads=threads)


def fly(
    env: CorridorEnv,
    policy: Policy,
    seed: int,
    *,
    exploration: str = "mode",
    options: Mapping[str, Any] | None = None,
) -> dict[str, npt.NDArray[Any]]:
    """Flies a whole episode as an actor does, by the actor's own loop.

    Args:
        env: what is flown; the environment itself is left as it is.
        policy: who flies.
        seed: the ticket's seed, as in ``env.reset(seed=…)``.
        exploration: ``"mode"`` (none), ``"sample"`` (from the policy) or ``"uniform"``.
        options: as in ``env.reset``.

    Returns:
        The columns of a recording, ``[steps + 1, …]``: see :func:`skein_rl.read_recording`.
    """
    wishes = task.wishes(options)
    blocks = _core.fly(env._task, policy._core, task.seed_of(seed), exploration, **wishes)
    rows = len(blocks["depth"]) // _PIXELS
    columns: dict[str, npt.NDArray[Any]] = {}
    for name, block in blocks.items():
        kind = np.uint8 if name in _BYTES else np.float32
        column = np.frombuffer(block, kind).copy()
        columns[name] = column if column.size == rows else column.reshape(rows, -1)
    columns["depth"] = columns["depth"].reshape(rows, *IMAGE)
    return columns


_BYTES = ("depth", "walls_passed", "terminated", "truncated")


def _images(depth: Any, rows: int) -> bytes:
    array = np.asarray(depth)
    if array.dtype != np.uint8:
        raise ValueError(f"depth has the dtype {array.dtype}: give uint8, 255 for the range")
    if array.size != rows * _PIXELS or array.shape[-2:] != (72, 128):
        raise ValueError(f"depth has the shape {array.shape}, not [{rows}, 1, 72, 128]")
    return array.tobytes()


def _numbers(name: str, numbers: Any, shape: tuple[int, ...]) -> bytes:
    array = np.asarray(numbers)
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name} has the dtype {array.dtype}: give float32")
    if array.shape != shape:
        raise ValueError(f"{name} has the shape {array.shape}, not {list(shape)}")
    return array.astype(np.float32).tobytes()
