"""What a plan predicted at camera pixels, and what a calibration measured there."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Final

import numpy as np

from controller.calibrate.values import ProjectorCalibration
from controller.core.arrays import Float64, FloatImage, Mask
from controller.plan.optics import lit_by, pixels_of
from controller.plan.target_object import AFTER_M, TargetObject
from controller.plan.values import Placement, Surface

STEP_PX: Final = 4
"""Camera pixels to each side over which a pixel's size is measured."""
LARGEST_JUMP_M: Final = 0.02


@dataclass(frozen=True, slots=True)
class PlacementComparison:
    """One projector's figures at camera pixels (predicted, measured); NaN where there is nothing to compare.

    ``off_px``: from where a surface point was predicted in its picture to where it was measured; ``size_mm``: longer
    side of a pixel; ``light``: by one factor for all projectors; ``blur_px``
    """

    off_px: Float64
    iou: float
    size_mm: tuple[Float64, Float64]
    light: tuple[Float64, Float64]
    blur_px: tuple[Float64, Float64]


def _map_px(part: ProjectorCalibration) -> FloatImage:
    assert part.phase_map is not None
    return part.phase_map.projector_px


@dataclass(frozen=True, slots=True)
class Points:
    """Where camera pixels look, in the plan's room: (rows, columns, 3) each, NaN where unknown."""

    points_m: Float64
    normals: Float64


def seen_by(at: Placement, part: ProjectorCalibration, lit: Mask, target_object: TargetObject) -> Points:
    """Surface points by the light of a projector: its measured pixel, sent out from where it was planned to stand."""
    measured = _map_px(part).astype(np.float64)
    known = np.isfinite(measured[..., 0]) & lit
    flat = (measured[known] - at.centre_px) / at.focal_px
    ray = np.concatenate((flat, np.ones((len(flat), 1))), axis=1) @ at.rotation
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    distance, normals = target_object.hit(at.position_m, ray)
    hit = distance < AFTER_M
    points, facing = np.full((*known.shape, 3), np.nan), np.full((*known.shape, 3), np.nan)
    at_hits = np.flatnonzero(known.ravel())[hit]
    points.reshape(-1, 3)[at_hits] = at.position_m + distance[hit, None] * ray[hit]
    towards = -np.sign(np.sum(normals[hit] * ray[hit], axis=1))[:, None]
    facing.reshape(-1, 3)[at_hits] = normals[hit] * towards
    return Points(points, facing)


def compare_placement(
    at: Placement,
    part: ProjectorCalibration,
    lit: Mask,
    points: Points,
    target_object: TargetObject,
    steepest_degrees: float,
) -> PlacementComparison:
    """What is flatter than ``steepest_degrees`` counts for whether it is lit, and for nothing else."""
    known = np.isfinite(points.points_m[..., 0])
    surface = Surface(points.points_m[known], points.normals[known], np.ones(int(known.sum())))
    predicted = lit_by(at, surface, target_object)
    both = known.copy()
    both[known] = predicted.reached
    iou = float((both & lit & known).sum() / max(1, ((both | lit) & known).sum()))
    both &= lit & np.isfinite(_map_px(part)[..., 0])
    both[known] &= predicted.useful(steepest_degrees)
    of_points = both[known]
    spread = functools.partial(_spread, both)
    expected_px, _ = pixels_of(at, surface.points_m[of_points])
    off = np.linalg.norm(_map_px(part)[both] - expected_px, axis=1)
    measured_blur = _blur_of(part, both)
    return PlacementComparison(
        off_px=spread(off),
        iou=iou,
        size_mm=(spread(predicted.pixel_mm[of_points, 0]), np.where(both, _measured_mm(part, points), np.nan)),
        light=(spread(predicted.lux[of_points]), np.where(both, part.white.mean(axis=2), np.nan)),
        blur_px=(spread(np.sqrt(predicted.blur_px[of_points] ** 2 + 1 / 12)), measured_blur),
    )


def _spread(mask: Mask, values: Float64) -> Float64:
    picture = np.full(mask.shape, np.nan)
    picture[mask] = values
    return picture


def _measured_mm(part: ProjectorCalibration, points: Points) -> Float64:
    """Longer side of a projector pixel at each camera pixel, from neighbours' points and measured pixels."""
    along, across = (_slope(points.points_m, axis) for axis in (0, 1))
    first, second = (_slope(_map_px(part).astype(np.float64), axis) for axis in (0, 1))
    far = np.maximum(np.linalg.norm(along, axis=2), np.linalg.norm(across, axis=2)) * 2 * STEP_PX > LARGEST_JUMP_M
    usable = ~far & np.isfinite(along + across).all(axis=2) & np.isfinite(first + second).all(axis=2)
    basis = np.stack((along[usable], across[usable]), axis=2)  # (N, 3, 2): metres by camera pixel
    # In an orthonormal basis of the plane that the two directions span, so that lengths are lengths.
    upper = np.linalg.qr(basis, mode="r")
    pixels = np.stack((first[usable], second[usable]), axis=2)
    sound = np.abs(np.linalg.det(upper)) > 1e-12
    jacobian = pixels[sound] @ np.linalg.inv(upper[sound])
    size = np.full(usable.shape, np.nan)
    size.reshape(-1)[np.flatnonzero(usable.ravel())[sound]] = 1e3 / np.linalg.svd(jacobian, compute_uv=False)[:, 1]
    return size


def _slope(values: Float64, axis: int) -> Float64:
    """Central differences (rows, columns, k) by camera pixel over STEP_PX to each side; NaN at the edges."""
    out = np.full(values.shape, np.nan)
    inner = tuple(slice(STEP_PX, -STEP_PX) if a == axis else slice(None) for a in range(2))
    later = tuple(slice(2 * STEP_PX, None) if a == axis else slice(None) for a in range(2))
    before = tuple(slice(None, -2 * STEP_PX) if a == axis else slice(None) for a in range(2))
    out[inner] = (values[later] - values[before]) / (2 * STEP_PX)
    return out


def _blur_of(part: ProjectorCalibration, where: Mask) -> Float64:
    """Measured standard deviation of a pixel's light in projector pixels, its square included; (rows, columns)."""
    assert part.phase_map is not None
    at = np.rint(_map_px(part)[where]).astype(int)
    rows, columns = part.phase_map.spread_px2.shape[:2]
    inside = np.all((at >= 0) & (at < (columns, rows)), axis=1)
    sigma = np.full(len(at), np.nan)
    spread = part.phase_map.spread_px2[at[inside, 1], at[inside, 0]].astype(np.float64)
    sigma[inside] = np.sqrt(0.5 * (spread[:, 0] + spread[:, 2]))
    return _spread(where, sigma)
