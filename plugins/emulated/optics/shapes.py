"""The project's own objects: a fluted, painted vase and a bust. About 0.3 m tall, standing side by side.

Both are grids over (height, angle) round an upright axis. Local frame: metres, x to the right, y up from the table,
z towards the audience. Albedo is linear RGB between 0.25 and 0.85, so that every colour leaves light to work with.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, TypeAlias

import numpy as np
import numpy.typing as npt

Floats: TypeAlias = npt.NDArray[np.float64]
Surface: TypeAlias = tuple[Floats, npt.NDArray[np.int32]]
"""Vertices (V, 3) in metres and triangles (F, 3)."""
Rgb: TypeAlias = npt.NDArray[np.float32]

VASE_AXIS_X: Final = -0.115
BUST_AXIS_X: Final = 0.085

_VASE_RADIUS: Final = (
    0.046,
    0.044,
    0.033,
    0.062,
    0.080,
    0.068,
    0.040,
    0.034,
    0.052,
    0.0555,
    0.049,
    0.032,
    0.026,
    0.020,
)
_VASE_HEIGHT: Final = (0.000, 0.012, 0.032, 0.088, 0.145, 0.200, 0.240, 0.264, 0.292, 0.298, 0.2985, 0.268, 0.245, 0.2)


def vase(rows: int = 420, columns: int = 540) -> Surface:
    """A vase with a fluted, twisted belly, a beaded shoulder and a flared, open mouth."""
    from scipy.interpolate import CubicSpline

    along = np.arange(len(_VASE_RADIUS), dtype=np.float64)
    s = np.linspace(0.0, along[-1], rows)[:, None]
    radius = np.repeat(CubicSpline(along, _VASE_RADIUS)(s), columns, axis=1)
    height = np.repeat(CubicSpline(along, _VASE_HEIGHT)(s), columns, axis=1)
    angle = np.broadcast_to(_angles(columns), radius.shape)
    outside = s < 9.0
    belly = np.exp(-(((height - 0.128) / 0.040) ** 4)) * outside
    beads = np.exp(-(((height - 0.205) / 0.006) ** 2)) * outside
    flutes = np.abs(np.sin(9.0 * angle + 22.0 * height)) ** 1.2 - 0.6
    radius = radius - 0.0045 * belly * flutes + 0.0028 * beads * np.cos(14.0 * angle)
    return _tube(radius, height, angle, VASE_AXIS_X)


def bust(rows: int = 460, columns: int = 480) -> Surface:
    """Head and shoulders: smoothly blended ellipsoids, with eye sockets, nose, lips, ears and wavy hair."""
    top = _crossing(lambda y: _bust_distance(np.zeros_like(y), y, np.zeros_like(y)), np.array([0.20]), np.array([0.34]))
    t = np.linspace(0.0, 1.0, rows)
    height = np.repeat((float(top[0]) * np.sin(0.5 * np.pi * t))[:, None], columns, axis=1)
    angle = np.broadcast_to(_angles(columns), height.shape)
    cosine, sine = np.cos(angle), np.sin(angle)
    radius = _crossing(
        lambda r: _bust_distance(r * cosine, height, r * sine), np.zeros_like(height), np.full_like(height, 0.2)
    )
    return _tube(radius, height, angle, BUST_AXIS_X)


def paint_vase(points: Floats) -> Rgb:
    """Albedo of the vase at local points (N, 3): bands of zigzag, dots, diamonds and stripes in six colours."""
    x, y, z = points[:, 0] - VASE_AXIS_X, points[:, 1], points[:, 2]
    turn = np.arctan2(z, x) / (2.0 * np.pi)
    cream, cobalt, rust = (0.82, 0.76, 0.62), (0.27, 0.33, 0.66), (0.74, 0.36, 0.27)
    teal, mustard, plum = (0.27, 0.54, 0.52), (0.83, 0.62, 0.27), (0.50, 0.27, 0.44)
    zigzag = np.abs((turn * 12.0) % 1.0 - 0.5) * 0.05 + 0.032
    column, row = (turn * 20.0) % 1.0 - 0.5, ((y - 0.165) / 0.0275) % 1.0 - 0.5
    diamond = np.abs(column) + np.abs(row)
    dots = np.hypot((turn * 24.0) % 1.0 - 0.5, (y - 0.226) / 0.012)
    stripes = ((turn * 18.0 + y * 40.0) % 1.0) < 0.5
    layers: list[tuple[npt.NDArray[np.bool_], tuple[float, float, float]]] = [
        (y < 0.300, cream),
        (y < 0.070, teal),
        (y < zigzag, rust),
        ((y > 0.078) & (y < 0.165), cobalt),
        ((y > 0.078) & (y < 0.165) & stripes, mustard),
        ((y > 0.165) & (y < 0.1925), plum),
        ((y > 0.165) & (y < 0.1925) & (diamond < 0.40), cream),
        ((y > 0.165) & (y < 0.1925) & (diamond < 0.20), rust),
        ((y > 0.212) & (dots < 0.36), cobalt),
        (y > 0.242, teal),
        ((y > 0.258) & (((turn * 30.0) % 1.0) < 0.5), mustard),
        ((y > 0.288), rust),
        ((y > 0.19) & (np.hypot(x, z) < 0.033) & (y < 0.25), plum),
    ]
    return _paint(layers, points)


def paint_bust(points: Floats) -> Rgb:
    """Albedo of the bust at local points (N, 3): skin, hair, eyes, lips, and a patterned shirt."""
    x, y, z = points[:, 0] - BUST_AXIS_X, points[:, 1], points[:, 2]
    side = np.abs(x)
    front = z > 0.01
    hair = _in_hair(x, y, z)
    strands = (np.sin(260.0 * np.arctan2(z, x) / (2 * np.pi) + 90.0 * y) > 0.35) & hair
    eye = np.hypot(side - 0.0235, (y - 0.212) * 1.6)
    lips = np.hypot(x / 0.018, (y - 0.1615) / 0.0065)
    brow = np.hypot((side - 0.025) / 0.016, (y - 0.2315 + 14.0 * (side - 0.022) ** 2) / 0.0035)
    cheek = np.hypot((side - 0.034) / 0.014, (y - 0.183) / 0.012)
    shirt = y < 0.098 - 0.35 * np.where(z > 0, np.maximum(0.055 - side, 0.0), 0.0)
    check = ((x + 0.8 * y) / 0.026 % 1.0 < 0.5) ^ ((x - 0.8 * y) / 0.026 % 1.0 < 0.5)
    hem = shirt & (y > 0.091 - 0.35 * np.where(z > 0, np.maximum(0.055 - side, 0.0), 0.0))
    layers: list[tuple[npt.NDArray[np.bool_], tuple[float, float, float]]] = [
        (y < 9.0, (0.80, 0.57, 0.45)),
        (front & (cheek < 1.0), (0.83, 0.49, 0.41)),
        (front & (lips < 1.0), (0.68, 0.29, 0.29)),
        (front & (eye < 0.0125), (0.84, 0.82, 0.78)),
        (front & (eye < 0.0070), (0.27, 0.46, 0.56)),
        (front & (eye < 0.0032), (0.25, 0.25, 0.26)),
        (front & (brow < 1.0), (0.34, 0.27, 0.25)),
        (hair, (0.42, 0.29, 0.25)),
        (strands, (0.58, 0.40, 0.28)),
        (shirt, (0.28, 0.52, 0.38)),
        (shirt & check, (0.80, 0.74, 0.40)),
        (hem, (0.52, 0.27, 0.42)),
    ]
    return _paint(layers, points)


def paint_solid(points: Floats) -> Rgb:
    """A solid pattern for a mesh that brings no colour: warped stripes of five colours, points in metres."""
    warped = points + 0.012 * np.sin(points[:, [1, 2, 0]] * 55.0 + 1.0)
    stripe = np.floor((0.6 * warped[:, 0] + warped[:, 1] - 0.4 * warped[:, 2]) / 0.02).astype(np.int64)
    colours = np.array(
        [(0.80, 0.73, 0.58), (0.70, 0.38, 0.30), (0.30, 0.52, 0.56), (0.82, 0.64, 0.30), (0.36, 0.36, 0.60)]
    )
    cells = np.sin(warped * (2.0 * np.pi / 0.06)).prod(axis=1)
    return np.asarray(colours[(stripe + (cells > 0.15) * 2) % len(colours)], dtype=np.float32)


def _paint(layers: list[tuple[npt.NDArray[np.bool_], tuple[float, float, float]]], points: Floats) -> Rgb:
    albedo = np.empty((len(points), 3), dtype=np.float32)
    for where, colour in layers:
        albedo[where] = colour
    # A slight unevenness, as of paint by hand, so that flat areas are not perfectly flat.
    uneven = 1.0 + 0.04 * np.sin(points @ np.array([310.0, 170.0, 230.0])) * np.sin(
        points @ np.array([90.0, -260.0, 140.0])
    )
    return np.asarray(np.clip(albedo * uneven[:, None], 0.25, 0.85), dtype=np.float32)


def _angles(columns: int) -> Floats:
    return np.linspace(0.0, 2.0 * np.pi, columns, endpoint=False)


def _tube(radius: Floats, height: Floats, angle: Floats, axis_x: float) -> Surface:
    """Triangles of a grid that closes round the axis, with its first and last rows closed by a point on the axis."""
    rows, columns = radius.shape
    grid = np.stack((axis_x + radius * np.cos(angle), height, radius * np.sin(angle)), axis=-1).reshape(-1, 3)
    ends = np.array([[axis_x, height[0, 0], 0.0], [axis_x, height[-1, 0], 0.0]])
    index = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    right = np.roll(index, -1, axis=1)
    a, b, c, d = index[:-1], right[:-1], index[1:], right[1:]
    sides = np.concatenate([np.stack((a, c, b), -1).reshape(-1, 3), np.stack((b, c, d), -1).reshape(-1, 3)])
    first, last = np.int32(rows * columns), np.int32(rows * columns + 1)
    bottom = np.stack((np.full(columns, first), index[0], right[0]), -1)
    top = np.stack((np.full(columns, last), right[-1], index[-1]), -1)
    faces = np.concatenate([sides, bottom, top]).astype(np.int32)
    return np.concatenate([grid, ends]), faces


def dot(a: Floats, b: Floats) -> Floats:
    """Products (...,) of vectors (..., 2 or 3). Adding up columns is several times as fast as numpy's sum over them."""
    total = a[..., 0] * b[..., 0]
    for axis in range(1, a.shape[-1]):
        total += a[..., axis] * b[..., axis]
    return np.asarray(total)


def length(vectors: Floats) -> Floats:
    """Lengths (...,) of vectors (..., 2 or 3)."""
    return np.asarray(np.sqrt(dot(vectors, vectors)))


def _crossing(distance: Callable[[Floats], Floats], inside: Floats, outside: Floats) -> Floats:
    """Where ``distance`` changes sign between the two, by bisection."""
    for _ in range(18):
        middle = 0.5 * (inside + outside)
        within = distance(middle) < 0.0
        inside, outside = np.where(within, middle, inside), np.where(within, outside, middle)
    return 0.5 * (inside + outside)


def _ellipsoid(x: Floats, y: Floats, z: Floats, centre: tuple[float, float, float], radii: tuple[float, ...]) -> Floats:
    scaled = np.sqrt(
        ((x - centre[0]) / radii[0]) ** 2 + ((y - centre[1]) / radii[1]) ** 2 + ((z - centre[2]) / radii[2]) ** 2
    )
    return np.asarray((scaled - 1.0) * min(radii))


def _blend(a: Floats, b: Floats, width: float) -> Floats:
    """Smooth union; with a negated operand, smooth difference."""
    h = np.clip(0.5 + 0.5 * (b - a) / width, 0.0, 1.0)
    return np.asarray(b * (1.0 - h) + a * h - width * h * (1.0 - h))


def _in_hair(x: Floats, y: Floats, z: Floats) -> npt.NDArray[np.bool_]:
    hairline = 0.250 - 0.9 * np.maximum(0.030 - z, 0.0) + 0.004 * np.sin(300.0 * x)
    return np.asarray((y > np.maximum(hairline, 0.150)) & (y > 0.14))


def _bust_distance(x: Floats, y: Floats, z: Floats) -> Floats:
    """Approximate signed distance to the bust, negative inside, metres."""
    side = np.abs(x)
    body = _blend(
        _ellipsoid(x, y, z, (0.0, 0.045, -0.005), (0.112, 0.056, 0.056)),
        _ellipsoid(x, y, z, (0.0, 0.000, 0.000), (0.088, 0.070, 0.064)),
        0.02,
    )
    neck = np.hypot(x, z + 0.008) - 0.034 + 0.4 * np.maximum(y - 0.17, 0.0) + 0.9 * np.maximum(0.09 - y, 0.0)
    head = _ellipsoid(x, y, z, (0.0, 0.222, -0.004), (0.058, 0.072, 0.070))
    jaw = _ellipsoid(x, y, z, (0.0, 0.176, 0.018), (0.043, 0.044, 0.044))
    head = _blend(head, jaw, 0.02)
    head = _blend(head, _ellipsoid(x, y, z, (0.0, 0.228, 0.052), (0.040, 0.008, 0.016)), 0.012)
    head = -_blend(-head, _ellipsoid(side, y, z, (0.0235, 0.212, 0.074), (0.016, 0.011, 0.018)), 0.010)
    head = _blend(head, _ellipsoid(side, y, z, (0.0235, 0.212, 0.047), (0.013, 0.012, 0.012)), 0.002)
    head = _blend(head, _ellipsoid(x, y, z, (0.0, 0.197, 0.066), (0.0095, 0.020, 0.016)), 0.008)
    head = _blend(head, _ellipsoid(x, y, z, (0.0, 0.189, 0.071), (0.0130, 0.008, 0.013)), 0.006)
    head = _blend(head, _ellipsoid(x, y, z, (0.0, 0.1645, 0.058), (0.0175, 0.0045, 0.010)), 0.004)
    head = _blend(head, _ellipsoid(x, y, z, (0.0, 0.1575, 0.057), (0.0150, 0.0050, 0.010)), 0.004)
    head = _blend(head, _ellipsoid(x, y, z, (0.0, 0.141, 0.049), (0.017, 0.012, 0.014)), 0.012)
    ears = _ellipsoid(side, y, z, (0.058, 0.205, -0.006), (0.011, 0.020, 0.013))
    head = _blend(head, ears, 0.006)
    waves = 0.0022 * np.sin(260.0 * np.arctan2(z, x) / (2 * np.pi) * 0.25 + 90.0 * y) + 0.004
    head = head - waves * _in_hair(x, y, z) * np.clip((y - 0.15) / 0.03, 0.0, 1.0)
    return _blend(_blend(head, neck, 0.012), body, 0.022)
