"""What a plan predicted at camera pixels, and what a calibration measured there."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from controller.core.arrays import Float64, FloatImage, Mask
from controller.optics.calibrate.values import Geometry, ProjectorCalibration
from controller.optics.plan.optics import lit_by, pixels_of
from controller.optics.plan.target_object import AFTER_M, TargetObject
from controller.optics.plan.values import Placement, Surface

STEP_PX: Final = 4
"""Camera pixels to each side over which a pixel's size is measured."""
LARGEST_JUMP_M: Final = 0.02
LEAST_POINTS: Final = 100
MOST_POINTS: Final = 20_000
"""Of the calibrated shape, by which it is laid on the mesh."""
ROUNDS: Final = 40


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


def seen_by_camera(geometry: Geometry, first: Points, target_object: TargetObject) -> Points:
    """Surface points by the camera: its rays, sent out from where it stands in the plan's room.

    Where it stands follows from the object: the calibrated shape is laid on the mesh, whatever its scale. So points do
    not depend on where any projector stands. ``first``: points that are roughly right; there the fit begins.

    Raises ValueError if fewer than ``LEAST_POINTS`` points are known.
    """
    known = np.isfinite(geometry.points_m).all(axis=2)
    both = known & np.isfinite(first.points_m).all(axis=2)
    if both.sum() < LEAST_POINTS:
        raise ValueError(f"{both.sum()} points are too few to lay the calibrated shape on the mesh")
    own = geometry.points_m[known].astype(np.float64)
    scale, rotation, at_m = _similarity(geometry.points_m[both].astype(np.float64), first.points_m[both])
    scale, rotation, at_m = _laid_on(own[:: max(1, len(own) // MOST_POINTS)], (scale, rotation, at_m), target_object)
    ray = own / np.linalg.norm(own, axis=1, keepdims=True) @ rotation.T
    distance, normals = target_object.hit(at_m, ray)
    hit = distance < AFTER_M
    at_hits = np.flatnonzero(known.ravel())[hit]
    points, facing = np.full((*known.shape, 3), np.nan), np.full((*known.shape, 3), np.nan)
    points.reshape(-1, 3)[at_hits] = at_m + distance[hit, None] * ray[hit]
    facing.reshape(-1, 3)[at_hits] = normals[hit] * -np.sign(np.sum(normals[hit] * ray[hit], axis=1))[:, None]
    return Points(points, facing)


Similarity = tuple[float, Float64, Float64]
"""Scale, rotation (3, 3) and translation (3,): scale * rotation @ x + translation."""


def _similarity(a: Float64, b: Float64) -> Similarity:
    """The best from points ``a`` (N, 3) to ``b`` (N, 3) (Umeyama 1991)."""
    middle_a, middle_b = a.mean(axis=0), b.mean(axis=0)
    u, strength, vt = np.linalg.svd((b - middle_b).T @ (a - middle_a) / len(a))
    mirror = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u @ np.diag(mirror) @ vt
    scale = float((strength * mirror).sum() / ((a - middle_a) ** 2).sum(axis=1).mean())
    return scale, rotation, middle_b - scale * rotation @ middle_a


def _laid_on(points: Float64, start: Similarity, target_object: TargetObject) -> Similarity:
    """The similarity that lays ``points`` (N, 3) on the mesh: least squares of the distances to it, outliers left out.

    Nearest vertices and their tangent planes, which is exact enough for meshes much finer than their bends.
    """
    vertices, normals = target_object.vertices_m, _vertex_normals(target_object)
    nearest = cKDTree(vertices)
    scale, rotation, at_m = start
    for _ in range(ROUNDS):
        placed = scale * points @ rotation.T + at_m
        vertex = nearest.query(placed)[1]
        normal = normals[vertex]
        off = np.sum(normal * (placed - vertices[vertex]), axis=1)
        use = np.abs(off) <= 3 * np.median(np.abs(off)) + 1e-9
        middle = placed.mean(axis=0)
        arm = placed - middle
        parts = np.concatenate([np.cross(arm, normal), normal, np.sum(normal * arm, axis=1)[:, None]], axis=1)
        step = np.linalg.lstsq(parts[use], -off[use], rcond=None)[0]
        turn, grown = Rotation.from_rotvec(step[:3]).as_matrix(), 1 + float(step[6])
        at_m = grown * turn @ (at_m - middle) + middle + step[3:6]
        scale, rotation = grown * scale, turn @ rotation
    return scale, rotation, at_m


def _vertex_normals(target_object: TargetObject) -> Float64:
    """(V, 3) unit, of all faces round each vertex."""
    corners = target_object.vertices_m[target_object.faces]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(target_object.vertices_m)
    for corner in range(3):
        np.add.at(total, target_object.faces[:, corner], face)
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300))


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
