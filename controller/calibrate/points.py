"""The object at every camera pixel, in metres, once the poses are known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from controller.arrays import Float64, FloatImage
from controller.calibrate import bundle_adjustment as ba
from controller.calibrate.triangulation import fit_planes, inverse_depth_map
from controller.calibrate.values import Correspondence, Geometry, Pinhole
from controller.errors import CalibrationError


def object_points(
    state: ba.State,
    noise_px: float,
    correspondences: Sequence[Correspondence],
    camera_size: tuple[int, int],
    projector_sizes: Sequence[tuple[int, int]],
    distance_m: float | None,
    smoothing_px: int,
) -> tuple[Geometry, float]:
    """Triangulate every camera pixel and set the scale; returns the geometry and metres per unit of ``state``.

    Without ``distance_m`` the median object point is put at 1 m. Pixels whose projectors disagree, and pixels off the
    surface around them, stay unknown. ``reprojection_rms_px`` is over all others.
    """
    rays = _ray_map(state.camera, camera_size)
    seen = np.stack([c.valid & np.isfinite(c.projector_px).all(axis=2) for c in correspondences])
    observed = np.stack([c.projector_px for c in correspondences])
    intrinsics = np.concatenate([np.exp(state.intrinsics[:, :1]), state.intrinsics[:, 1:]], axis=1)
    raw, residual = inverse_depth_map(
        rays, observed, seen, intrinsics, np.ascontiguousarray(state.rotations), state.centres, noise_px
    )
    raw = np.where(raw > 0, raw, np.float32(np.nan))
    smooth, normals = fit_planes(raw, rays, smoothing_px)
    known = np.isfinite(smooth)
    if not known.any():
        raise CalibrationError(
            "geometry-uncertain",
            what="No camera pixel lies on a smooth surface that the projectors agree on.",
            remedy="Check focus and exposure of the pattern pictures, then capture again.",
        )
    directions = np.concatenate([rays, np.ones((*rays.shape[:2], 1), dtype=np.float32)], axis=2)
    points = directions / np.where(known, smooth, np.float32(np.nan))[..., None]
    median = float(np.median(np.linalg.norm(points[known], axis=1)))
    unit_m = (1.0 if distance_m is None else distance_m) / median
    geometry = Geometry(
        camera=_pinhole(state.camera[:3], float(state.camera[3]), np.eye(3), np.zeros(3), camera_size),
        projectors=tuple(
            _pinhole(state.intrinsics[n], 0.0, state.rotations[n], state.centres[n] * unit_m, size)
            for n, size in enumerate(projector_sizes)
        ),
        points_m=(points * unit_m).astype(np.float32),
        normals=normals,
        reprojection_rms_px=float(np.sqrt(np.mean(residual[known].astype(np.float64) ** 2))),
        scale_known=distance_m is not None,
    )
    return geometry, unit_m


def _ray_map(camera: Float64, size: tuple[int, int]) -> FloatImage:
    """(rows, columns, 2) float32 undistorted x, y at depth 1 of every camera pixel."""
    width, height = size
    focal, k1 = np.exp(camera[0]), camera[3]
    x, y = (np.arange(width) - camera[1]) / focal, (np.arange(height) - camera[2]) / focal
    distorted = np.stack(np.broadcast_arrays(x[None, :], y[:, None]), axis=2)
    xy = distorted
    for _ in range(8):
        xy = distorted / (1.0 + k1 * np.sum(xy * xy, axis=2, keepdims=True))
    return np.ascontiguousarray(xy, dtype=np.float32)


def _pinhole(intrinsics: Float64, k1: float, rotation: Float64, centre_m: Float64, size: tuple[int, int]) -> Pinhole:
    focal = float(np.exp(intrinsics[0]))
    matrix = np.array([[focal, 0.0, intrinsics[1]], [0.0, focal, intrinsics[2]], [0.0, 0.0, 1.0]])
    return Pinhole(matrix, np.array([k1, 0.0]), rotation.copy(), -rotation @ centre_m, size)
