"""Gaussian blur that costs the same however wide it is, and the nearest pixels that are known."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64, FloatImage, Mask

FINEST_PX: Final = 4.0
"""Standard deviation in pixels of the smaller picture: so wide a Gaussian is not seen to have been sampled."""

REACH: Final = 3.0
"""Standard deviations beyond which nothing counts."""
LEAST_NEAR: Final = 1e-4
"""Share of a Gaussian that has to be in a mask for a mean over it."""


def masked_blur(image: FloatImage, mask: Mask, sigma_px: float) -> FloatImage:
    """Gaussian means of ``image`` (rows, columns, channels) over the pixels of ``mask`` alone; 0 where none is near."""
    total = gaussian_blur(np.where(mask[..., None], image, 0).astype(np.float32), sigma_px)
    near = gaussian_blur(mask.astype(np.float32), sigma_px)[..., None]
    return np.asarray(np.divide(total, near, out=np.zeros_like(total), where=near > LEAST_NEAR), np.float32)


def gaussian_blur(image: FloatImage, sigma_px: float) -> FloatImage:
    """``image`` (rows, columns[, channels]) float32 with a Gaussian of ``sigma_px`` > 0; mirrored at its edges.

    A wide one is computed on means of square blocks, within 1 % of what the Gaussian does to a step of 1.
    """
    block = int(sigma_px / FINEST_PX)
    if block < 2:
        return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), np.float32)
    rows, columns = image.shape[:2]
    # Whole blocks alone: others would be narrower than the rest. Mirrored first, for it is at the picture's own edge.
    beside = block * int(np.ceil(REACH * sigma_px / block))
    mirrored = cv2.copyMakeBorder(
        image, beside, beside - rows % -block, beside, beside - columns % -block, cv2.BORDER_REFLECT_101
    )
    small = cv2.resize(mirrored, None, fx=1 / block, fy=1 / block, interpolation=cv2.INTER_AREA)
    soft = cv2.GaussianBlur(small, (0, 0), sigma_px / block)
    wide = cv2.resize(soft, (mirrored.shape[1], mirrored.shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(wide[beside : beside + rows, beside : beside + columns], np.float32)


def nearest_known(known: Mask) -> tuple[Float64, tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]]:
    """How far each pixel is from the nearest one of ``known`` (rows, columns), and which that is, as an index."""
    from scipy.ndimage import distance_transform_edt

    distance_px, (rows, columns) = distance_transform_edt(~known, return_indices=True)
    return distance_px, (rows, columns)
