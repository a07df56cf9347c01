"""Recordings in Rerun, as Rerun's own types: the drone and its way, the depth image as points in the
world, velocity, actions, rewards and the latent code. A recording as MCAP has more to show: walls
with their openings, obstacles, reconstructions, and what the drone hit.

>>> skein_rl.rerun.save(skein_rl.read_recording("flights.mcap"), "flights.rrd")
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from types import ModuleType
from typing import Any

import numpy as np

from .data import Columns, Recording, Solid

_HEIGHT, _WIDTH = 72, 128
# As in the simulator's [camera] section.
_CAMERA = {"range_m": 20.0, "mount_m": [0.2, 0.0, 0.0], "mount_pitch_deg": 0.0}
# The drone's width and height.
_HALF_SIZE_M = [0.49, 0.49, 0.145]
_WALL, _EDGE = [115, 128, 148, 190], [51, 56, 66]


def save(
    recording: Recording,
    path: str | os.PathLike[str],
    camera: Mapping[str, Any] | None = None,
    period_secs: float | None = None,
) -> None:
    """Writes a recording to a file ``.rrd``, with the layout that ``rerun FILE`` opens it in.

    Args:
        recording: of :func:`skein_rl.read_recording`.
        path: the file.
        camera: what differs from the simulator's default ``[camera]``, and from the recording's
            angle of view.
        period_secs: ``simulator.vehicle.control_period_secs``; by default the recording's.

    Raises:
        ImportError: Rerun is not installed.
    """
    rr = _rerun()
    stream = rr.RecordingStream("skein")
    stream.save(os.fspath(path), default_blueprint=_layout())
    log(recording, stream, camera, period_secs)
    stream.flush()
    stream.disconnect()


def log(
    recording: Recording,
    stream: Any,
    camera: Mapping[str, Any] | None = None,
    period_secs: float | None = None,
) -> None:
    """Logs a recording to a ``rerun.RecordingStream``. Episodes follow each other on the timeline
    ``flight``. Arguments as of :func:`save`.
    """
    rr = _rerun()
    fov = {"horizontal_fov_deg": recording.horizontal_fov_deg}
    settings = {**_CAMERA, **fov, **(camera or {})}
    period_secs = period_secs or recording.period_secs
    stream.log("world", rr.ViewCoordinates.FLU, static=True)
    stream.log("world/drone/body", rr.Boxes3D(half_sizes=[_HALF_SIZE_M]), static=True)
    _log_camera(rr, stream, settings)
    begin = 0.0
    for number, episode in enumerate(recording.episodes()):
        secs = begin + period_secs * episode["step"].astype(float)
        if recording.scenes:
            stream.set_time("flight", duration=begin)
            _log_scene(rr, stream, recording.scenes[number])
        for row, event in recording.events[number] if recording.events else _events(episode):
            stream.set_time("flight", duration=float(secs[row]))
            stream.log("events", rr.TextLog(event))
        _log_episode(rr, stream, recording, episode, secs, settings["range_m"])
        begin = float(secs[-1]) + 2 * period_secs


def _log_camera(rr: ModuleType, stream: Any, settings: Mapping[str, Any]) -> None:
    focal = _WIDTH / 2 / math.tan(math.radians(settings["horizontal_fov_deg"]) / 2)
    # Forward, left, up to right, down, forward; a pitch upwards is about the axis to the right.
    level = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], float)
    sin, cos = (f(math.radians(settings["mount_pitch_deg"])) for f in (math.sin, math.cos))
    pitched = level @ np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
    stream.log("world/drone/camera", rr.Transform3D(translation=settings["mount_m"], mat3x3=pitched), static=True)
    pinhole = rr.Pinhole(focal_length=focal, width=_WIDTH, height=_HEIGHT, image_plane_distance=1.0)
    stream.log("world/drone/camera/depth", pinhole, static=True)


def _log_scene(rr: ModuleType, stream: Any, scene: Mapping[str, Solid]) -> None:
    stream.log("world/course", rr.Clear(recursive=True))
    for name, solid in scene.items():
        path = f"world/course/{name.replace(' ', '_')}"
        if len(solid.triangles_m):
            corners = solid.triangles_m.reshape(-1, 3)
            stream.log(f"{path}/surface", rr.Mesh3D(vertex_positions=corners, albedo_factor=_WALL))
        if solid.outlines_m:
            stream.log(f"{path}/outline", rr.LineStrips3D(solid.outlines_m, colors=[_EDGE]))


def _events(episode: Columns) -> list[tuple[int, str]]:
    """What the columns tell, where no events were recorded."""
    passed = np.concatenate([[0], episode["walls_passed"].astype(int)])
    events = [(0, f"episode {int(episode['episode'][0])} begins")]
    events += [(int(row), f"passed wall {passed[row + 1]}") for row in np.flatnonzero(np.diff(passed) > 0)]
    timed_out = episode["truncated"].any()
    return [*events, (len(passed) - 2, "timed out" if timed_out else "collided or reached the end")]


def _log_episode(
    rr: ModuleType, stream: Any, recording: Recording, episode: Columns, secs: Any, range_m: float
) -> None:
    positions = episode["position_m"]
    for row, now in enumerate(secs):
        stream.set_time("flight", duration=float(now))
        turned = rr.Quaternion(xyzw=episode["orientation"][row])
        stream.log("world/drone", rr.Transform3D(translation=positions[row], quaternion=turned))
        velocity = episode["velocity_mps"][row]
        stream.log("world/velocity", rr.Arrows3D(origins=[positions[row]], vectors=[velocity]))
        for axis, value in zip(("forward", "left", "up"), velocity):
            stream.log(f"velocity/{axis}", rr.Scalars(float(value)))
        stream.log("world/way", rr.LineStrips3D([positions[: row + 1]]))
        # 255 is the range or farther: no surface. Rerun leaves out a depth of 0.
        depth = episode["depth"][row].reshape(_HEIGHT, _WIDTH)
        metres = np.where(depth == 255, 0.0, depth / 255.0 * range_m).astype(np.float32)
        stream.log("world/drone/camera/depth", rr.DepthImage(metres, meter=1.0))
        if "reconstruction" in episode:
            stream.log("reconstruction", rr.Image(episode["reconstruction"][row]))
        stream.log("code", rr.BarChart(episode["latent"][row]))
        stream.log("reward/total", rr.Scalars(float(episode["reward"][row])))
        for name, value in zip(recording.reward_term_names, episode["reward_terms"][row]):
            stream.log(f"reward/{name}", rr.Scalars(float(value)))
        for who in ("action", "oracle_action"):
            for axis, value in zip(recording.action_names, episode[who][row] if who in episode else ()):
                stream.log(f"{who}/{axis}", rr.Scalars(float(value)))


def _layout() -> Any:
    import rerun.blueprint as rrb

    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Spatial3DView(origin="world", name="flight"),
                rrb.TextLogView(origin="events", name="events"),
                row_shares=[4, 1],
            ),
            rrb.Vertical(
                rrb.Horizontal(
                    rrb.Spatial2DView(origin="world/drone/camera/depth", name="depth"),
                    rrb.Spatial2DView(origin="reconstruction", name="reconstruction"),
                ),
                rrb.TimeSeriesView(origin="reward", name="reward"),
                rrb.TimeSeriesView(origin="velocity", name="velocity, m/s"),
                rrb.TimeSeriesView(contents=["action/**", "oracle_action/**"], name="action, and the oracle's"),
                rrb.BarChartView(origin="code", name="latent code"),
                row_shares=[3, 2, 2, 2, 1],
            ),
            column_shares=[3, 2],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed"),
    )


def _rerun() -> ModuleType:
    try:
        import rerun
    except ImportError:
        raise ImportError('Rerun is missing: pip install "skein-rl[rerun]"') from None
    module: ModuleType = rerun
    return module
