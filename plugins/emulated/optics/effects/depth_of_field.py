"""What the camera's lens does not show sharply: each distance is blurred by its circle of confusion (thin lens)."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

FloatImage = npt.NDArray[np.float32]
LARGEST_PX: Final = 24.0
STEP: Final = 1.25
"""Between the blurs of two layers; a pixel's light is divided between the two that are next to its own."""
SMALLEST_PX: Final = 0.3


def confusion_px(
    depth_m: npt.NDArray[np.float64], *, focal_px: float, pixel_m: float, aperture_f: float, focus_m: float
) -> npt.NDArray[np.float64]:
    """Standard deviation, along each axis, of the circle of confusion of points ``depth_m`` along the optical axis.

    Its diameter is f^2 / N |z - s| / (z (s - f)) for a lens of focal length f = ``focal_px`` x ``pixel_m`` focused
    at s; a disc's standard deviation is a quarter of its diameter.
    """
    focal = focal_px * pixel_m
    diameter = focal**2 / aperture_f * np.abs(depth_m - focus_m) / (depth_m * (focus_m - focal))
    return np.asarray(0.25 * diameter / pixel_m)


def defocused(image: FloatImage, sigma_px: FloatImage) -> FloatImage:
    """Each pixel's light (rows, columns, 3) spread by its own ``sigma_px`` (rows, columns)."""
    most = float(min(sigma_px.max(initial=0.0), LARGEST_PX))
    if most <= SMALLEST_PX:
        return image
    count = int(np.ceil(np.log(most / SMALLEST_PX) / np.log(STEP))) + 1
    blurs = np.concatenate([[0.0], SMALLEST_PX * STEP ** np.arange(count)])
    # Between two blurs the share is linear in the variance, so that each pixel's light has the variance asked for.
    variances = [_variance(float(blur)) for blur in blurs]
    at = np.interp(np.minimum(sigma_px, most) ** 2, variances, np.arange(len(blurs)))
    out = np.zeros_like(image)
    for n, sigma in enumerate(blurs):
        share = np.maximum(1.0 - np.abs(at - n), 0.0).astype(np.float32)
        if share.any():
            part = image * share[..., None]
            out += part if sigma == 0.0 else cv2.GaussianBlur(part, (0, 0), float(sigma))
    return out


def _variance(sigma: float) -> float:
    """Of OpenCV's kernel, which is narrower than its Gaussian where that is as narrow as a pixel."""
    if sigma == 0.0:
        return 0.0
    weights = cv2.getGaussianKernel(2 * round(4 * sigma) + 1, sigma)[:, 0]
    return float(weights @ (np.arange(len(weights)) - len(weights) // 2) ** 2)
