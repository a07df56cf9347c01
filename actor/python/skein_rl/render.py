"""Images for people: the drone from behind, with its depth image in a corner."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from . import _core
from .batch import IMAGE, arrays

_SCALE = 4
_HEIGHT, _WIDTH = IMAGE[0] * _SCALE, IMAGE[1] * _SCALE
# Half the drone's size along its axes, metres.
_HALF_M = np.array([0.49, 0.49, 0.145])
_DRONE = np.array([255, 140, 0], dtype=np.uint8)
_NEAR = np.array([245.0, 240.0, 225.0])
_FAR = np.array([25.0, 35.0, 70.0])


def check_mode(mode: str | None, modes: Sequence[str]) -> None:
    """Refuses an unknown mode."""
    if mode is not None and mode not in modes:
        raise ValueError(f"render_mode = {mode!r} is none of {', '.join(modes)}")


def frame(fleet: _core.Fleet, index: int, task: _core.Task) -> npt.NDArray[np.uint8]:
    """Draws environment ``index``, uint8 ``[288, 512, 3]``."""
    behind, eye = fleet.chase(index)
    now = arrays(fleet.view(index), 1, task)
    image = _coloured(np.frombuffer(behind, np.uint8).reshape(IMAGE))
    image = image.repeat(_SCALE, 0).repeat(_SCALE, 1)
    _draw_drone(image, now["position_m"][0] - np.array(eye), now["orientation"][0])
    inset = now["depth"][0, 0, :, :, None].repeat(3, 2)
    image[-74:, -130:] = 255
    image[-73:-1, -129:-1] = inset
    return image


def _coloured(depth: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    far = np.sqrt(depth.astype(np.float32) / 255.0)[:, :, None]
    colour: npt.NDArray[np.uint8] = (_NEAR + far * (_FAR - _NEAR)).astype(np.uint8)
    return colour


def _draw_drone(
    image: npt.NDArray[np.uint8], at: npt.NDArray[Any], orientation: npt.NDArray[Any]
) -> None:
    """Fills the outline of the drone's box, ``at`` from the camera, metres."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    corners = (signs * _HALF_M) @ _rotation(orientation).T + at
    ahead = np.maximum(corners[:, 0], 0.05)
    # The image is 90 degrees wide, so the focal length is half its width.
    columns = _WIDTH / 2 * (1 - corners[:, 1] / ahead)
    rows = _HEIGHT / 2 - _WIDTH / 2 * corners[:, 2] / ahead
    hull = _hull(np.stack([columns, rows], axis=1))
    y, x = np.mgrid[0:_HEIGHT, 0:_WIDTH]
    inside = np.ones((_HEIGHT, _WIDTH), dtype=np.bool_)
    for (x0, y0), (x1, y1) in zip(hull, np.roll(hull, -1, axis=0)):
        inside &= (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) >= 0
    image[inside] = _DRONE


def _rotation(orientation: npt.NDArray[Any]) -> npt.NDArray[Any]:
    i, j, k, w = orientation
    return np.array(
        [
            [1 - 2 * (j * j + k * k), 2 * (i * j - k * w), 2 * (i * k + j * w)],
            [2 * (i * j + k * w), 1 - 2 * (i * i + k * k), 2 * (j * k - i * w)],
            [2 * (i * k - j * w), 2 * (j * k + i * w), 1 - 2 * (i * i + j * j)],
        ]
    )


def _hull(points: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Convex hull, in the order in which a pixel inside lies on the positive side of each edge."""
    ordered = sorted(map(tuple, points))

    def half(chain: Any) -> list[Any]:
        kept: list[Any] = []
        for point in chain:
            while len(kept) > 1 and _turn(kept[-2], kept[-1], point) <= 0:
                kept.pop()
            kept.append(point)
        return kept[:-1]

    return np.array(half(ordered) + half(reversed(ordered)))


def _turn(a: Any, b: Any, c: Any) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


class Window:
    """A window that shows frames."""

    def __init__(self, fps: int) -> None:
        try:
            import pygame
        except ImportError:
            raise ImportError(
                'render_mode="human" needs pygame: pip install "skein-rl[human]"'
            ) from None
        self._pygame = pygame
        self._fps = fps
        pygame.init()
        self._screen = pygame.display.set_mode((_WIDTH, _HEIGHT))
        pygame.display.set_caption("Skein")
        self._clock = pygame.time.Clock()

    def show(self, image: npt.NDArray[np.uint8]) -> None:
        """Shows an image and waits until its time is over."""
        surface = self._pygame.surfarray.make_surface(image.swapaxes(0, 1))
        self._screen.blit(surface, (0, 0))
        self._pygame.event.pump()
        self._pygame.display.flip()
        self._clock.tick(self._fps)

    def close(self) -> None:
        """Closes the window."""
        self._pygame.display.quit()
        self._pygame.quit()
