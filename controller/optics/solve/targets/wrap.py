"""The object's own coordinates, and pictures wrapped around it without aliasing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

import cv2
import numpy as np

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.blur import nearest_known
from controller.core.errors import UsageError, WorkError
from controller.optics.calibrate.values import Geometry
from controller.optics.solve.targets.values import Target

Mapping: TypeAlias = Literal["cylinder", "plane"]
Pattern: TypeAlias = Callable[[FloatImage, FloatImage], FloatImage]
"""Reflectance (pixels, 3) in [0, 1] at positions across and up the object, both (pixels,) metres."""

UPRIGHT = (0.0, -1.0, 0.0)
"""Up in the camera's frame, for a camera held level."""
FURTHEST_FILL_PX = 8.0
_SUBPIXELS = 4
_ROUNDEST = 4.0


@dataclass(frozen=True, slots=True)
class ObjectSpace:
    """The position of each camera pixel on the object, in metres along its surface.

    ``across_m`` (rows, columns) float32: along the circumference to the right, 0 facing the camera
    ``up_m`` (rows, columns) float32: height above the object's middle; both finite inside ``mask``, 0 outside
    ``mask`` (rows, columns): the wanted pixels whose position is known, or was within 8 pixels of a known one
    ``radius_m`` of the object at its middle; infinite when mapped as a plane
    """

    across_m: FloatImage
    up_m: FloatImage
    mask: Mask
    radius_m: float


def object_space(
    geometry: Geometry, mask: Mask, *, mapping: Mapping = "cylinder", up: tuple[float, float, float] = UPRIGHT
) -> ObjectSpace:
    """Coordinates around the object's own vertical axis, found where the surface normals point away from.

    An object too flat to have an axis is mapped as a plane. ``up``: direction in the camera's frame.
    Raises WorkError("target-no-geometry") when no pixel of ``mask`` has a known position.
    """
    known = channels.finite(geometry.points_m) & channels.finite(geometry.normals)
    wanted = known & mask
    if not wanted.any():
        raise WorkError(
            "target-no-geometry",
            what="No camera pixel of the object has a known 3D position, so nothing can be wrapped on it.",
            remedy="Calibrate with the geometry step, and check that the object mask covers the object.",
        )
    frame = _upright_frame(geometry.points_m[wanted], up)
    local = (geometry.points_m[wanted] @ frame.T).astype(np.float64)
    right, height, near = local.T
    middle = (float(np.median(right)), float(np.median(height)))
    across, radius = right - middle[0], float("inf")
    if mapping == "cylinder":
        axis = _axis(local, (geometry.normals[wanted] @ frame.T).astype(np.float64))
        if axis is not None:
            angle = np.arctan2(right - axis[0], near - axis[1])
            radius = float(np.median(np.hypot(right - axis[0], near - axis[1])))
            across = radius * angle
    distance, nearest = nearest_known(wanted)
    filled = mask & (distance <= FURTHEST_FILL_PX)
    maps = []
    for values in (across, height - middle[1]):
        full = np.zeros(mask.shape, dtype=np.float32)
        full[wanted] = values
        maps.append(np.where(filled, full[nearest], np.float32(0)))
    return ObjectSpace(maps[0], maps[1], filled, radius)


def painted(space: ObjectSpace, pattern: Pattern, *, gain: FloatImage | None = None) -> Target:
    """Evaluate ``pattern`` at 4x4 positions in every camera pixel and average: soft edges, no aliasing.

    ``gain`` (rows, columns): multiplied in, e.g. shading.
    """
    mask = space.mask
    across, up = space.across_m[mask], space.up_m[mask]
    slopes = [_slope(values, mask, axis)[mask] for values in (space.across_m, space.up_m) for axis in (1, 0)]
    total = np.zeros((len(across), 3), dtype=np.float32)
    offsets = (np.arange(_SUBPIXELS, dtype=np.float32) + np.float32(0.5)) / _SUBPIXELS - np.float32(0.5)
    for dy in offsets:
        for dx in offsets:
            total += pattern(across + dx * slopes[0] + dy * slopes[1], up + dx * slopes[2] + dy * slopes[3])
    image = np.zeros((*mask.shape, 3), dtype=np.float32)
    image[mask] = total / _SUBPIXELS**2
    if gain is not None:
        image *= gain[..., None]
    return Target(np.clip(image, 0, 1), mask)


@dataclass(frozen=True, slots=True)
class PrintLook:
    """Settings of a print on the object; those of stage.toml have the same names.

    ``shading``: 0 flat, as printed on the object; up to 1: darkened where the surface turns away from the camera
    ``ink``, ``paper``: what the print's black and white reflect, 0 <= ink < paper <= 1. A print of density 1.5 has
    0.03; no projector makes the black of a screen on a pale object in another projector's stray light
    """

    mapping: Mapping = "cylinder"
    up: tuple[float, float, float] = UPRIGHT
    shading: float = 0.0
    ink: float = 0.03
    paper: float = 0.9


FLAT_PRINT: Final = PrintLook()


def wrap_photograph(photo_linear: FloatImage, geometry: Geometry, mask: Mask, look: PrintLook = FLAT_PRINT) -> Target:
    """A photograph printed and wrapped on the object, large enough to cover its visible part.

    ``photo_linear`` (rows, columns, 3) float32: linear, in [0, 1]. Raises UsageError("print-range-invalid").
    """
    ink, paper = look.ink, look.paper
    if not 0 <= ink < paper <= 1:
        raise UsageError(
            "print-range-invalid",
            what=f"A print can't reflect from {ink} to {paper}.",
            remedy="Give 0 <= ink < paper <= 1, for example 0.03 and 0.9.",
        )
    space = object_space(geometry, mask, mapping=look.mapping, up=look.up)
    low, high = (np.percentile([space.across_m[space.mask], space.up_m[space.mask]], q, axis=1) for q in (0.5, 99.5))
    height, width = photo_linear.shape[:2]
    metres = float(max((high[0] - low[0]) / width, (high[1] - low[1]) / height, 1e-9))
    photo_linear = for_painting(photo_linear, max(_pixel_m(space), 1e-12) / metres)
    metres *= width / photo_linear.shape[1]
    height, width = photo_linear.shape[:2]
    middle = (low + high) / 2

    def pattern(across: FloatImage, above: FloatImage) -> FloatImage:
        x = (across - np.float32(middle[0])) / np.float32(metres) + np.float32((width - 1) / 2)
        y = (np.float32(middle[1]) - above) / np.float32(metres) + np.float32((height - 1) / 2)
        return np.float32(ink) + np.float32(paper - ink) * sampled(photo_linear, x, y)

    return painted(space, pattern, gain=facing(geometry, mask, look.shading) if look.shading else None)


def for_painting(photo: FloatImage, pixels: float) -> FloatImage:
    """``photo``, smaller where it has so many ``pixels`` to one of the camera's that those between its 4x4 positions
    would be left out.
    """
    by = _SUBPIXELS / pixels
    if by >= 1:
        return photo
    small = (max(2, round(photo.shape[1] * by)), max(2, round(photo.shape[0] * by)))
    return np.asarray(cv2.resize(photo, small, interpolation=cv2.INTER_AREA), np.float32)


def facing(geometry: Geometry, mask: Mask, shading: float) -> FloatImage:
    """(rows, columns) 1 - shading (1 - cos) of the angle between surface and view; 1 where the normal is unknown."""
    points = np.nan_to_num(geometry.points_m)
    view = points / np.maximum(np.linalg.norm(points, axis=2, keepdims=True), 1e-9)
    cosine = np.clip(-channels.total(np.nan_to_num(geometry.normals) * view), 0, 1)
    known = mask & channels.finite(geometry.normals)
    return np.where(known, 1 - np.float32(shading) * (1 - cosine), 1).astype(np.float32)


def _upright_frame(points: FloatImage, up: tuple[float, float, float]) -> Float64:
    """Rows: right, up, towards the camera, for an object at ``points`` seen from the origin."""
    above = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    towards = -np.median(points, axis=0).astype(np.float64)
    towards -= above * (above @ towards)
    towards /= np.linalg.norm(towards)
    return np.stack([np.cross(above, towards), above, towards])


def _axis(local: Float64, normals: Float64) -> tuple[float, float] | None:
    """(right, near) of the vertical line that the normals point away from; None for an object that is nearly flat."""
    a, b = normals[:, 0], normals[:, 2]
    # the line through a point along its normal passes the axis: b (cx - x) - a (cz - z) = 0
    left, right = np.stack([b, -a], axis=1), b * local[:, 0] - a * local[:, 2]
    x, z = np.linalg.lstsq(left, right, rcond=None)[0]
    off = np.hypot(local[:, 0] - x, local[:, 2] - z)
    extent = float(np.ptp(np.percentile(local[:, 0], [1, 99])))
    behind = float(np.mean((local[:, 0] - x) * a + (local[:, 2] - z) * b > 0))
    if not np.median(off) < _ROUNDEST * extent or behind < 0.7 or not np.median(local[:, 2]) > z:
        return None
    return float(x), float(z)


def _slope(values: FloatImage, mask: Mask, axis: int) -> FloatImage:
    """Change a pixel along ``axis``: the smaller of both sides' differences, so that depth steps do not smear."""
    step = np.diff(values, axis=axis)
    inside = np.logical_and(*(np.take(mask, np.arange(k, mask.shape[axis] - 1 + k), axis=axis) for k in (0, 1)))
    pad = [(0, 0), (0, 0)]
    sides = []
    for side in ((1, 0), (0, 1)):
        pad[axis] = side
        sides.append((np.pad(step, pad), np.pad(inside, pad)))
    (before, has_before), (after, has_after) = sides
    smaller = np.where(np.abs(before) < np.abs(after), before, after)
    one = np.where(has_before, before, np.where(has_after, after, 0))
    return np.where(has_before & has_after, smaller, one).astype(np.float32)


def _pixel_m(space: ObjectSpace) -> float:
    """Typical size of a camera pixel on the object."""
    across = _slope(space.across_m, space.mask, 1)[space.mask]
    return float(np.median(np.abs(across)))


def sampled(photo: FloatImage, x: FloatImage, y: FloatImage, *, border: int = cv2.BORDER_REPLICATE) -> FloatImage:
    """Bilinear samples (pixels, channels) of a picture at (pixels,) positions, its edge repeated outside.

    ``border``: OpenCV's name for another picture outside
    """
    # remap takes at most 32767 columns, so the list is folded into rows
    width = 4096
    padded = -(-len(x) // width) * width
    maps = [np.pad(v, (0, padded - len(v))).reshape(-1, width).astype(np.float32) for v in (x, y)]
    out = np.empty((padded, photo.shape[2]), dtype=np.float32)
    for start in range(0, len(maps[0]), 32000):
        part = slice(start, start + 32000)
        rows = cv2.remap(photo, maps[0][part], maps[1][part], cv2.INTER_LINEAR, borderMode=border)
        out[start * width : start * width + rows.shape[0] * width] = rows.reshape(-1, photo.shape[2])
    return out[: len(x)]
