"""A wall too wide for one camera: a camera for each group of superimposed projectors, and it sees their neighbours."""

from __future__ import annotations

import numpy as np

from controller.core.arrays import FloatImage
from controller.optics.calibrate.values import Calibration, Metapixels, PhaseMap, ProjectorCalibration, Radiometry
from controller.optics.transport import build_transport
from controller.optics.transport.views import ViewsTransport
from lab.timings.tools.synthetic import MOSAIC, TO_XYZ

OVERLAP = 0.15
"""Of two groups of projectors."""
BESIDE = 0.1
"""Of a group's width, that its camera sees on either side of it."""
PITCH = 1.5
"""Camera pixels for one of a projector."""


def facade(groups: int, each: int, size: tuple[int, int]) -> list[Calibration]:
    """What each camera sees of ``groups`` x ``each`` projectors of ``size`` (rows, columns), all of which it lists."""
    step = size[1] * (1 - OVERLAP)
    places = [(g * step + 0.31 * k, 0.17 * k, 1 + 0.01 * (k - each / 2)) for g in range(groups) for k in range(each)]
    views = []
    for g in range(groups):
        y, x = wall(g, size)
        paint, left = _paint(y, x), float(x[0, 0] - 0.5 / PITCH)
        seen = [_projector(n, place, size, left, paint, y, x) for n, place in enumerate(places)]
        mask = np.any([part.white.any(axis=2) for part in seen], axis=0)
        views.append(Calibration(tuple(seen), 0.002 * paint + np.float32(0.0005), mask, TO_XYZ, mosaic=MOSAIC))
    return views


def wall(g: int, size: tuple[int, int]) -> tuple[FloatImage, FloatImage]:
    """Where the pixels of a group's camera look at the wall: y and x, in pixels of a projector."""
    rows, columns = size
    shape = 2 * round(rows * PITCH / 2), 2 * round(columns * (1 + 2 * BESIDE) * PITCH / 2)
    y, x = (np.mgrid[: shape[0], : shape[1]].astype(np.float32) + 0.5) / PITCH
    return y, x + np.float32(max(g * columns * (1 - OVERLAP) - columns * BESIDE, 0))


def facade_solve(groups: int, each: int, size: tuple[int, int]) -> tuple[ViewsTransport, FloatImage, FloatImage]:
    """T, a target of shades, edges and fine detail on the wall, and the black image, the latter on the views' sheet."""
    views, wanted = facade(groups, each, size), []
    for g in range(groups):
        y, x = wall(g, size)
        shade = 0.2 + 0.06 * np.sin(x / 23) * np.cos(y / 17) + 0.05 * ((np.floor(x / 40) + np.floor(y / 30)) % 2)
        wanted.append(np.stack([shade, 0.9 * shade, 0.8 * shade + 0.02 * np.sin(x * y / 900)], -1).astype(np.float32))
    transport = ViewsTransport.of([build_transport(view) for view in views])
    black = transport.sheet.joined([view.black for view in views])
    return transport, transport.sheet.joined(wanted) + black, black


def _paint(y: FloatImage, x: FloatImage) -> FloatImage:
    waves = 0.15 * np.sin(x / 31) * np.sin(y / 27)
    stripes = 0.3 * ((np.floor(x / 73) + np.floor(y / 51)) % 2)
    return np.stack([0.4 + stripes, 0.5 + waves, 0.45 + 0.5 * stripes - waves], -1).astype(np.float32)


def _projector(
    n: int, place: tuple[float, float, float], size: tuple[int, int], left: float, paint: FloatImage,
    y: FloatImage, x: FloatImage,
) -> ProjectorCalibration:  # fmt: skip
    """``place``: left, top and zoom on the wall; ``left``: of the camera; ``y``, ``x``: places that its pixels see."""
    along, down, zoom = place
    at = np.stack([(x - along) / zoom - 0.5, (y - down) / zoom - 0.5], -1).astype(np.float32)
    inside = np.all((at > -0.5) & (at < np.array([size[1], size[0]], np.float32) - 0.5), axis=-1)
    at[~inside] = np.nan
    row, column = np.mgrid[: size[0], : size[1]].astype(np.float32) + np.float32(0.5)
    centre = np.stack([(along + zoom * column - left) * PITCH - 0.5, (down + zoom * row) * PITCH - 0.5], -1)
    valid = np.all((centre >= 0) & (centre < np.array([x.shape[1], x.shape[0]]) - 1), axis=-1)
    width = np.array([(0.42 * PITCH) ** 2 + 0.1, 0, (0.42 * PITCH) ** 2 + 0.1], np.float32)
    covariance = np.broadcast_to(width, (*size, 3))
    spread = np.broadcast_to(np.array([0.19, 0, 0.2], np.float32), (*size, 3))
    response = np.tile(np.linspace(0, 1, 256) ** 2.2, (3, 1))
    mixing = 0.95 * np.eye(3) + 0.05 / 3
    white = np.where(inside[..., None], paint * np.float32(0.5 + 0.1 * (n % 4)), 0).astype(np.float32)
    metapixels = Metapixels(centre.astype(np.float32), np.ascontiguousarray(covariance), valid)
    phase_map = PhaseMap(at, np.ascontiguousarray(spread))
    return ProjectorCalibration(f"p{n}", metapixels, Radiometry(response, mixing), white, phase_map)
