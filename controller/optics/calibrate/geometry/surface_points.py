"""The object at every camera pixel, in metres, once the poses are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from controller.core import channels
from controller.core.arrays import Float64, FloatImage
from controller.core.errors import CalibrationError
from controller.optics.calibrate.geometry import bundle_adjustment as ba
from controller.optics.calibrate.geometry.metric_scale import metres_per_unit
from controller.optics.calibrate.geometry.surface_fit import fit_patches, whole_pixels
from controller.optics.calibrate.geometry.triangulation import fit_planes, inverse_depth_map, projector_rays
from controller.optics.calibrate.geometry.values import CameraPrior
from controller.optics.calibrate.values import Correspondence, Geometry, Pinhole

LEAST_NOISE_PX: Final = 0.03
"""Projectors that disagree by less than a few times this still agree, however good the rest of the fit is."""


@dataclass(frozen=True, slots=True)
class ObjectPoints:
    """The object, metres per unit of the adjusted state with its relative deviation, and how sure each point is.

    ``sigma_m`` (rows, columns) float32: standard deviation of a point along the camera's ray, NaN where unknown
    """

    geometry: Geometry
    unit_m: float
    unit_rel_sigma: float
    sigma_m: FloatImage


def object_points(
    state: ba.AdjustmentState,
    noise_px: float,
    shape_rel_sigma: float,
    correspondences: Sequence[Correspondence],
    camera_size: tuple[int, int],
    projector_sizes: Sequence[tuple[int, int]],
    prior: CameraPrior,
    smoothing_px: int,
) -> ObjectPoints:
    """Triangulate every camera pixel and set the scale by what ``prior`` says was measured.

    Without a measured distance the nearest object point is put at 1 m. Pixels whose projectors disagree, and pixels
    off the surface around them, stay unknown. ``reprojection_rms_px`` is over all others. ``sigma_m`` holds the noise
    of the correspondences, not lessened by smoothing, since neighbours err together, and the parameters' part.

    Raises CalibrationError as ``scale.metres_per_unit``, and "geometry-uncertain".
    """
    rays = _ray_map(state.camera, camera_size)
    seen = np.stack([c.valid & channels.finite(c.projector_px) for c in correspondences])
    slopes = projector_rays(np.stack([c.projector_px for c in correspondences]), np.ascontiguousarray(state.intrinsics))
    noise_px = max(noise_px, LEAST_NOISE_PX)
    raw, residual, leverage = inverse_depth_map(
        rays,
        slopes,
        seen,
        np.exp(state.intrinsics[:, 0]),
        np.ascontiguousarray(state.rotations),
        state.centres,
        noise_px,
    )
    raw = np.where(raw > 0, raw, np.float32(np.nan))
    smooth, normals = _surface(raw, rays, float(np.exp(state.camera[0])), smoothing_px)
    known = np.isfinite(smooth)
    if not known.any():
        raise CalibrationError(
            "geometry-uncertain",
            what="No camera pixel lies on a smooth surface on which the projectors agree.",
            remedy="Check focus and exposure of the pattern pictures, then capture again.",
        )
    directions = np.concatenate([rays, np.ones((*rays.shape[:2], 1), dtype=np.float32)], axis=2)
    points: FloatImage = (directions / smooth[..., None]).astype(np.float32)
    unit_m, unit_rel_sigma = metres_per_unit(points, prior.distance_m, prior.distance_rel_sigma, prior.distances)
    relative = np.hypot(np.maximum(residual, noise_px) * leverage / smooth, np.float32(shape_rel_sigma))
    geometry = Geometry(
        camera=_pinhole(state.camera, np.eye(3), np.zeros(3), camera_size),
        projectors=tuple(
            _pinhole(state.intrinsics[n], state.rotations[n], state.centres[n] * unit_m, size)
            for n, size in enumerate(projector_sizes)
        ),
        points_m=(points * unit_m).astype(np.float32),
        normals=normals,
        reprojection_rms_px=float(np.sqrt(np.mean(residual[known].astype(np.float64) ** 2))),
        scale_known=prior.distance_m is not None or bool(prior.distances),
    )
    sigma_m = (relative * channels.length(points) * unit_m).astype(np.float32)
    return ObjectPoints(geometry, unit_m, unit_rel_sigma, sigma_m)


def _surface(raw: FloatImage, rays: FloatImage, focal_px: float, smoothing_px: int) -> tuple[FloatImage, FloatImage]:
    """Inverse depths from curved patches, and normals from planes one pixel wider; NaN unless both are known."""
    whole = whole_pixels(raw, focal_px)
    smooth = fit_patches(raw, whole, smoothing_px)
    _, normals = fit_planes(smooth, rays, smoothing_px + 1)
    smooth[~np.isfinite(normals[..., 0])] = np.nan
    return smooth, normals


def _ray_map(camera: Float64, size: tuple[int, int]) -> FloatImage:
    """(rows, columns, 2) float32 undistorted x, y at depth 1 of every camera pixel."""
    width, height = size
    focal, k1 = np.exp(camera[0]), camera[3]
    distorted_x, distorted_y = (np.arange(width) - camera[1]) / focal, (np.arange(height)[:, None] - camera[2]) / focal
    x, y = distorted_x, distorted_y
    for _ in range(8):
        bent = 1.0 + k1 * (x * x + y * y)
        x, y = distorted_x / bent, distorted_y / bent
    return np.stack([x, y], axis=2, dtype=np.float32, casting="same_kind")


def _pinhole(lens: Float64, rotation: Float64, centre_m: Float64, size: tuple[int, int]) -> Pinhole:
    focal = float(np.exp(lens[0]))
    matrix = np.array([[focal, 0.0, lens[1]], [0.0, focal, lens[2]], [0.0, 0.0, 1.0]])
    return Pinhole(matrix, np.array([float(lens[3]), 0.0]), rotation.copy(), -rotation @ centre_m, size)
