"""What Skein records: runs and recordings as NumPy arrays, pandas tables and Minari data sets."""

from __future__ import annotations

import csv
import json
import math
import os
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from . import _core

Columns = dict[str, npt.NDArray[Any]]
_COLUMNS = ("course", "episode", "step", "closing", "depth", "velocity_mps", "action", "reward")


@dataclass(frozen=True)
class Solid:
    """A wall, all obstacles of a world, or the corridor.

    Attributes:
        triangles_m: its surface, ``[n, 3, 3]``: corners in the world, metres.
        outlines_m: lines that are drawn of it, ``[points, 3]`` each: a wall's opening.
    """

    triangles_m: npt.NDArray[np.float32]
    outlines_m: list[npt.NDArray[np.float32]]


@dataclass(frozen=True)
class Recording:
    """A recording: one row for each observation, the closing ones included.

    Attributes:
        columns: arrays ``[rows, …]`` by name; ``docs/python.md`` lists them.
        course_names: names that ``columns["course"]`` indexes.
        reward_term_names: names of the columns of ``reward_terms``.
        action_names: names of the columns of ``action`` and ``oracle_action``.
        events: for each episode, rows of it and what happened there. Of an MCAP file alone.
        scenes: for each episode, its walls and obstacles by name. Of an MCAP file alone.
        period_secs: from one step to the next. Of an MCAP file; otherwise the usual one.
        horizontal_fov_deg: the camera's angle of view. Of an MCAP file; otherwise the usual one.
    """

    columns: Columns = field(repr=False)
    course_names: list[str]
    reward_term_names: list[str]
    action_names: list[str]
    events: list[list[tuple[int, str]]] = field(default_factory=list, repr=False)
    scenes: list[dict[str, Solid]] = field(default_factory=list, repr=False)
    period_secs: float = 0.5
    horizontal_fov_deg: float = 90.0

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        return self.columns[name]

    def __len__(self) -> int:
        return len(self.columns["step"])

    def episodes(self) -> Iterator[Columns]:
        """Each episode's columns, its closing row last."""
        ends = np.flatnonzero(self.columns["closing"]) + 1
        for first, end in zip([0, *ends[:-1]], ends):
            yield {name: column[first:end] for name, column in self.columns.items()}

    def to_pandas(self) -> Any:
        """A ``pandas.DataFrame`` of the columns with one number a row; parts of a vector are
        columns ``position_m_0``, … Images and codes are left out."""
        flat: dict[str, Any] = {}
        for name, column in self.columns.items():
            if column.ndim == 1:
                flat[name] = column
            elif name == "reward_terms":
                for term, values in zip(self.reward_term_names, column.T):
                    flat[f"reward_{term}"] = values
            elif column.ndim == 2 and name != "latent":
                flat.update({f"{name}_{part}": values for part, values in enumerate(column.T)})
        return _pandas().DataFrame(flat)


@dataclass(frozen=True)
class Run:
    """A run's directory.

    Attributes:
        path: the directory.
        config: configuration by sections.
        summary: ``summary.json``; empty while the run goes on.
        evaluation: ``evaluation.json``; empty before the evaluation.
        episodes: columns of ``episodes.csv``.
        curves: for each curve of TensorBoard its steps, wall times (seconds since 1970) and values.
    """

    path: Path
    config: dict[str, Any] = field(repr=False)
    summary: dict[str, Any] = field(repr=False)
    evaluation: dict[str, Any] = field(repr=False)
    episodes: Columns = field(repr=False)
    curves: dict[str, Columns] = field(repr=False)

    @property
    def snapshots(self) -> list[Path]:
        """Files of the snapshots, sorted by name; ``best.safetensors`` is the best."""
        return sorted((self.path / "snapshots").glob("*.safetensors"))

    def episodes_to_pandas(self) -> Any:
        """The episodes as a ``pandas.DataFrame``."""
        return _pandas().DataFrame(self.episodes)

    def curves_to_pandas(self) -> Any:
        """All curves as one ``pandas.DataFrame``: curve, step, wall_time, value."""
        pandas = _pandas()
        tables = [pandas.DataFrame({"curve": name, **curve}) for name, curve in self.curves.items()]
        return pandas.concat(tables, ignore_index=True) if tables else pandas.DataFrame()


def read_recording(path: str | os.PathLike[str]) -> Recording:
    """Reads a file that ``--record`` wrote, or ``recordings/*.mcap`` of a run.

    A file ``.mcap`` needs ``pip install skein-rl[mcap]``. It has events and scenes too, and
    ``columns["reconstruction"]`` if a decoder was there; it lacks ``oracle_action`` if no teacher
    was asked.

    Raises:
        ImportError: the packages that read MCAP are not installed.
        OSError: the file cannot be read.
        ValueError: it is no recording; the message names it and what is missing.
    """
    if Path(path).suffix == ".mcap":
        return _read_mcap(Path(path))
    try:
        with np.load(path, allow_pickle=False) as file:
            columns = {name: file[name] for name in file.files}
    except (ValueError, EOFError, KeyError, AttributeError) as error:
        raise ValueError(f"{path} is no recording: {error}") from error
    except Exception as error:
        if isinstance(error, OSError):
            raise
        raise ValueError(f"{path} is damaged: {error}") from error
    missing = [name for name in (*_COLUMNS, "course_names") if name not in columns]
    if missing:
        raise ValueError(f"{path} is no recording: it has no array {', '.join(missing)}")
    names = [str(name) for name in columns.pop("course_names")]
    terms = [str(name) for name in columns.pop("reward_term_names", _core.REWARD_TERMS)]
    # Recordings without names are of a drone that chose left and up alone.
    axes = [str(name) for name in columns.pop("action_names", ("left", "up"))]
    rows = len(columns["step"])
    for name, column in columns.items():
        if column.shape[:1] != (rows,):
            raise ValueError(f"{path} is damaged: {name} has {column.shape} for {rows} rows")
    return Recording(columns, names, terms, axes)


def _read_mcap(path: Path) -> Recording:
    try:
        from mcap.reader import make_reader
        from mcap_protobuf.decoder import DecoderFactory
    except ImportError:
        raise ImportError('reading MCAP needs its packages: pip install "skein-rl[mcap]"') from None
    with path.open("rb") as file:
        try:
            return _from_messages(make_reader(file, decoder_factories=[DecoderFactory()]))
        except Exception as error:
            raise ValueError(f"{path} is no recording, or damaged: {error!r}") from error


def _from_messages(reader: Any) -> Recording:
    messages: dict[str, list[Any]] = {}
    events: list[list[tuple[int, str]]] = []
    scenes: list[dict[str, Solid]] = []
    begin = 0
    nanos: list[int] = []
    for _, channel, logged, message in reader.iter_decoded_messages(log_time_order=False):
        row = len(messages.get("/drone/step", ())) - 1
        if channel.topic == "/scene" and message.deletions:
            # It begins an episode; others are pieces of the trail.
            begin = row + 1
            scenes.append(_solids(message))
            events.append([])
        elif channel.topic == "/drone/step":
            nanos.append(logged.log_time)
        elif channel.topic == "/events":
            events[-1].append((max(row - begin, 0), message.message))
        messages.setdefault(channel.topic, []).append(message)
    columns = _step_columns(messages["/drone/step"])
    for name, topic in (("depth", "/camera/image"), ("reconstruction", "/camera/reconstruction")):
        if images := [np.frombuffer(image.data, np.uint8) for image in messages.get(topic, ())]:
            columns[name] = np.stack(images).reshape(-1, 72, 128)
    lists = {found.name: found.metadata for found in reader.iter_metadata()}
    names = {name: [texts[str(place)] for place in range(len(texts))] for name, texts in lists.items()}
    focal_px = messages["/camera/calibration"][0].K[0]
    # An episode has at least two rows; those of a segment need not begin with step 0.
    steps = int(columns["step"][1]) - int(columns["step"][0])
    return Recording(
        columns,
        names["course_names"],
        names["reward_term_names"],
        names["action_names"],
        events,
        scenes,
        (nanos[1] - nanos[0]) / 1e9 / steps,
        2 * math.degrees(math.atan(64 / focal_px)),
    )


def _step_columns(steps: list[Any]) -> Columns:
    """Columns of the messages ``skein.Step``, with the types of the ``.npz``."""
    columns: Columns = {}
    for part in steps[0].DESCRIPTOR.fields:
        kind = {part.TYPE_FLOAT: np.float32, part.TYPE_INT32: np.int32}.get(part.type, np.uint8)
        values = [getattr(step, part.name) for step in steps]
        if hasattr(values[0], "__len__"):
            values = [list(value) for value in values]
            width = max(map(len, values))
            # No teacher was asked: in this episode, or ever.
            values = [value or [0] * width for value in values]
            if width == 0:
                continue
        columns[part.name] = np.array(values, dtype=kind)
    return columns


def _solids(scene: Any) -> dict[str, Solid]:
    solids = {}
    for entity in scene.entities:
        if entity.frame_id == "world":
            corners = [points for part in entity.triangles for points in _points(part.points)]
            outlines = [_points(line.points) for line in entity.lines]
            closed = [np.vstack([line, line[:1]]) if drawn.type == 1 else line
                      for line, drawn in zip(outlines, entity.lines)]
            triangles = np.array(corners, np.float32).reshape(-1, 3, 3)
            solids[entity.id.split(":")[0]] = Solid(triangles, closed)
    return solids


def _points(points: Any) -> npt.NDArray[np.float32]:
    return np.array([(point.x, point.y, point.z) for point in points], np.float32).reshape(-1, 3)


def read_run(path: str | os.PathLike[str]) -> Run:
    """Reads a run's directory, during the run or after it.

    Raises:
        FileNotFoundError: the directory holds no run.
        ValueError: a file of it is damaged; the message names it.
    """
    root = Path(path)
    if not (root / "config.toml").is_file():
        raise FileNotFoundError(f"{root} holds no run: it has no config.toml")
    return Run(
        path=root,
        config=_toml(root / "config.toml"),
        summary=_json(root / "summary.json"),
        evaluation=_json(root / "evaluation.json"),
        episodes=_table(root / "episodes.csv"),
        curves=_curves(root / "tensorboard"),
    )


def to_minari(
    recording: Recording,
    dataset_id: str = "skein/corridor/recorded-v0",
    **keywords: Any,
) -> Any:
    """Makes a Minari data set of a recording, for offline learning.

    Observations are as :class:`skein_rl.CorridorEnv` gives them: depth, velocity, previous_action.

    Args:
        recording: of :func:`read_recording`.
        dataset_id: name of the data set, ``namespace/name-v0``.
        **keywords: for ``minari.create_dataset_from_buffers``, such as ``author``.

    Returns:
        The ``minari.MinariDataset``, stored where Minari keeps its data sets.
    """
    try:
        import minari
        from minari.data_collector import EpisodeBuffer
    except ImportError:
        raise ImportError('to_minari needs Minari: pip install "skein-rl[minari]"') from None
    from .env import CorridorEnv

    parts = ("depth", "velocity", "previous_action")
    spaces = {("left", "up"): "lateral", ("forward", "left", "up"): "velocity"}
    action = spaces.get(tuple(recording.action_names), "velocity+yaw")
    env = CorridorEnv(observation=parts, vehicle={"action": action})
    buffers = [
        EpisodeBuffer(
            id=number,
            observations={name: list(column) for name, column in observations(episode, action).items()},
            actions=list(episode["action"][:-1]),
            rewards=[float(reward) for reward in episode["reward"][:-1]],
            terminations=[bool(end) for end in episode["terminated"][:-1]],
            truncations=[bool(end) for end in episode["truncated"][:-1]],
        )
        for number, episode in enumerate(recording.episodes())
    ]
    keywords.setdefault("algorithm_name", "skein")
    return minari.create_dataset_from_buffers(
        dataset_id=dataset_id,
        buffer=buffers,
        observation_space=env.observation_space,
        action_space=env.action_space,
        **keywords,
    )


def observations(episode: Mapping[str, npt.NDArray[Any]], action: str = "lateral") -> Columns:
    """Observations of an episode, ``[steps + 1, …]``, as the environment gives them."""
    turns = action == "velocity+yaw"
    world = episode["velocity_mps"]
    previous = np.zeros_like(episode["action"])
    previous[1:] = episode["action"][:-1]
    return {
        "depth": episode["depth"][:, None],
        "velocity": _in_heading_frame(world, episode["orientation"]) if turns else world,
        "previous_action": previous,
    }


def _in_heading_frame(
    vectors: npt.NDArray[Any], orientations: npt.NDArray[Any]
) -> npt.NDArray[np.float32]:
    """Vectors of the world ``[n, 3]``, as a drone sees them: where its nose points, left, up."""
    i, j, k, w = orientations.T
    along, beside = 1 - 2 * (j * j + k * k), 2 * (i * j + w * k)
    level = np.hypot(along, beside)
    cos, sin = along / level, beside / level
    x, y, z = vectors.T
    return np.stack([cos * x + sin * y, cos * y - sin * x, z], axis=1).astype(np.float32)


def _pandas() -> Any:
    try:
        import pandas
    except ImportError:
        raise ImportError('tables need pandas: pip install "skein-rl[data]"') from None
    return pandas


def _toml(path: Path) -> dict[str, Any]:
    try:
        return _core.parse_toml(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path} is damaged: {error}") from error


def _json(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    return content


def _table(path: Path) -> Columns:
    """Columns of a CSV file with a header: integers, numbers or texts."""
    if not path.is_file():
        return {}
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    if not rows:
        return {}
    header, *rows = rows
    # A run that goes on may be writing its last line.
    rows = [row for row in rows if len(row) == len(header)]
    return {name: _column([row[place] for row in rows]) for place, name in enumerate(header)}


def _column(texts: list[str]) -> npt.NDArray[Any]:
    for kind in (np.int64, np.float64):
        try:
            return np.array(texts, dtype=kind)
        except ValueError:
            continue
    return np.array(texts)


def _curves(folder: Path) -> dict[str, Columns]:
    points: dict[str, list[tuple[int, float, float]]] = {}
    for path in sorted(folder.glob("*tfevents*")):
        for step, wall_time, tag, value in _scalars(path.read_bytes()):
            points.setdefault(tag, []).append((step, wall_time, value))
    return {tag: _curve(points[tag]) for tag in sorted(points)}


def _curve(points: list[tuple[int, float, float]]) -> Columns:
    steps, times, values = zip(*points)
    return {
        "step": np.array(steps, dtype=np.int64),
        "wall_time": np.array(times, dtype=np.float64),
        "value": np.array(values, dtype=np.float32),
    }


def _scalars(data: bytes) -> Iterator[tuple[int, float, str, float]]:
    """Scalars of a TensorBoard event file; a record that is cut off ends it."""
    place = 0
    while place + 12 <= len(data):
        (length,) = struct.unpack_from("<Q", data, place)
        place += 12
        if place + length + 4 > len(data):
            return
        event = dict(_fields(data[place : place + length]))
        place += length + 4
        if 5 not in event:
            continue
        step, wall_time = int(event.get(2, 0)), float(_double(event.get(1, bytes(8))))
        for number, value in _fields(event[5]):
            content = dict(_fields(value)) if number == 1 else {}
            if 1 in content and 2 in content:
                (scalar,) = struct.unpack("<f", content[2])
                yield step, wall_time, content[1].decode("utf-8", "replace"), scalar


def _double(data: bytes) -> float:
    (number,) = struct.unpack("<d", data)
    return float(number)


def _fields(data: bytes) -> Iterator[tuple[int, Any]]:
    """Fields of a protocol buffer message: numbers, or bytes."""
    place = 0
    while place < len(data):
        key, place = _varint(data, place)
        kind = key & 7
        if kind == 0:
            value, place = _varint(data, place)
            yield key >> 3, value
            continue
        if kind == 2:
            length, place = _varint(data, place)
        else:
            length = {1: 8, 5: 4}.get(kind, len(data))
        yield key >> 3, data[place : place + length]
        place += length


def _varint(data: bytes, place: int) -> tuple[int, int]:
    number = shift = 0
    while place < len(data):
        byte = data[place]
        place += 1
        number |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            break
    return number, place
