"""Figures that no stage reports: structural similarity, FLIP, and colours as CIE L*a*b*."""

from __future__ import annotations

from typing import Final

import numpy as np

from controller.core.arrays import ByteImage, Float64, FloatImage, Mask
from controller.stage.report.pictures import Crop

SSIM_SIGMA_PX: Final = 1.5
SSIM_RADIUS_PX: Final = 5


def lab_of(rgb: FloatImage, camera_to_xyz: Float64, white: float) -> Float64:
    """CIE L*a*b* of linear camera values (..., 3); camera RGB (white, white, white) is L* = 100 and neutral."""
    reference = camera_to_xyz @ np.full(3, white)
    t = np.maximum(rgb.astype(np.float64) @ camera_to_xyz.T / reference, 0)
    delta = 6 / 29
    f = np.where(t > delta**3, np.cbrt(t), t / (3 * delta**2) + 4 / 29)
    return np.stack([116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], -1)


def structural_similarity(one: FloatImage, other: FloatImage) -> FloatImage:
    """SSIM at each pixel of two pictures (rows, columns, channels) float32 in [0, 1], each channel by itself.

    Wang, Bovik, Sheikh and Simoncelli, "Image quality assessment: from error visibility to structural similarity",
    IEEE Transactions on Image Processing 13(4), 2004: a Gaussian window of 1.5 px, 11 px wide; K1 = 0.01, K2 = 0.03.
    """
    from scipy.ndimage import gaussian_filter

    def local_mean(picture: FloatImage) -> FloatImage:
        return np.asarray(gaussian_filter(picture, SSIM_SIGMA_PX, radius=SSIM_RADIUS_PX, axes=(0, 1)), np.float32)

    c1, c2 = np.float32(0.01**2), np.float32(0.03**2)
    mean_one, mean_other = local_mean(one), local_mean(other)
    variances = local_mean(one * one) - mean_one**2 + local_mean(other * other) - mean_other**2
    covariance = local_mean(one * other) - mean_one * mean_other
    likeness = (2 * mean_one * mean_other + c1) * (2 * covariance + c2)
    return np.asarray(likeness / ((mean_one**2 + mean_other**2 + c1) * (variances + c2)), np.float32)


def flip_of(reference: ByteImage, picture: ByteImage, mask: Mask, crop: Crop) -> float | None:
    """Mean of FLIP (Andersson et al. 2020) over a mask, of 8-bit pictures (rows, columns, 3); None if not installed."""
    try:
        import flip_evaluator
    except ImportError:
        return None
    pictures = [np.ascontiguousarray(one / np.float32(255), np.float32) for one in (reference, picture)]
    found = np.asarray(flip_evaluator.evaluate(*pictures, "LDR", applyMagma=False)[0])
    return float(found.reshape(*found.shape[:2], -1).mean(axis=2)[mask[crop.rows, crop.columns]].mean())
