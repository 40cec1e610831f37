"""Where metapixels are likely to be before any dot is fitted (paper 4.2.2): by correspondences, or by the 3D model."""

from __future__ import annotations

from typing import Final

import numpy as np

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.optics.calibrate.correspondence.inverse_map import invert_map
from controller.optics.calibrate.metapixels.from_phase import carry_covariance
from controller.optics.calibrate.values import Correspondence, Geometry, Metapixels, Pinhole

PIXEL_SIGMA_PX: Final = 0.4
"""Of a projector pixel in focus, in projector pixels."""
CAMERA_SIGMA_PX: Final = 0.6
"""Of the camera's optics, its own pixel and its colour pattern, in camera pixels."""
SHADOW_DEPTH: Final = 0.01
"""A surface point this much farther from a projector, relatively, than another in the same pixel is in its shadow."""
GRAZING: Final = 0.1
"""Cosine between normal and projector below which its light carries no information."""


def initial_metapixels(
    correspondence: Correspondence,
    size_px: tuple[int, int],
    *,
    pixel_sigma_px: float = PIXEL_SIGMA_PX,
    camera_sigma_px: float = CAMERA_SIGMA_PX,
) -> Metapixels:
    """Centres from the inverse of the map, sizes from its slope and an assumed blur.

    ``size_px`` (width, height) of the projector; ``pixel_sigma_px`` in projector, ``camera_sigma_px`` in camera pixels.
    """
    inverse = invert_map(correspondence, size_px)
    round_px2 = np.array([1, 0, 1], np.float32)
    blur = np.broadcast_to(np.float32(pixel_sigma_px**2) * round_px2, (*inverse.valid.shape, 3))
    covariance = carry_covariance(inverse.jacobian, blur) + np.float32(camera_sigma_px**2) * round_px2
    return Metapixels(inverse.centre_px, covariance, inverse.valid)


def where_missing(metapixels: Metapixels, other: Metapixels) -> Metapixels:
    """``metapixels``, and those of ``other`` where they are not valid."""
    take = (~metapixels.valid & other.valid)[..., None]
    return Metapixels(
        np.where(take, other.centre_px, metapixels.centre_px),
        np.where(take, other.covariance_px2, metapixels.covariance_px2),
        metapixels.valid | other.valid,
    )


def modelled_correspondence(geometry: Geometry, n: int) -> Correspondence:
    """Where each camera pixel's point lies in projector ``n``'s image, by the reconstructed object and pose.

    Points that face away from the projector or lie in its shadow are not valid. ``modulation`` is 1 where valid.
    """
    projector = geometry.projectors[n]
    points = geometry.points_m.astype(np.float64)
    px, depth = project(projector, points)
    ray = points - (-projector.rotation.T @ projector.translation_m)
    with np.errstate(invalid="ignore", divide="ignore"):
        facing = -channels.total(geometry.normals * ray) / channels.length(ray) > GRAZING
        width, height = projector.size_px
        inside = channels.every(px > -0.5) & (px[..., 0] < width - 0.5) & (px[..., 1] < height - 0.5) & (depth > 0)
    valid = inside & facing
    valid &= ~_in_shadow(px, depth, valid, projector.size_px)
    position: FloatImage = np.where(valid[..., None], px, np.nan).astype(np.float32)
    return Correspondence(position, valid.astype(np.float32), valid)


def project(pinhole: Pinhole, points_m: Float64) -> tuple[Float64, Float64]:
    """(..., 2) image position and (...) depth of (..., 3) world points; NaN points give NaN."""
    local = points_m @ pinhole.rotation.T + pinhole.translation_m
    depth = local[..., 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        xy = local[..., :2] / depth[..., None]
    r2 = np.sum(xy * xy, axis=-1, keepdims=True)
    xy = xy * (1 + pinhole.distortion[0] * r2 + pinhole.distortion[1] * r2 * r2)
    return xy @ pinhole.matrix[:2, :2].T + pinhole.matrix[:2, 2], depth


def _in_shadow(px: FloatImage | Float64, depth: Float64, valid: Mask, size_px: tuple[int, int]) -> Mask:
    width, height = size_px
    at = np.where(valid[..., None], np.round(px), 0).astype(np.int64)
    cell = np.clip(at[..., 1], 0, height - 1) * width + np.clip(at[..., 0], 0, width - 1)
    nearest = np.full(width * height, np.inf)
    np.minimum.at(nearest, cell[valid], depth[valid])
    return np.asarray(depth > nearest[cell] * (1 + SHADOW_DEPTH))
