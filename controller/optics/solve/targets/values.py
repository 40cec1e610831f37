"""A target picture, and the sRGB curve between picture files and linear light (IEC 61966-2-1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage, Mask
from controller.core.blur import masked_blur


@dataclass(frozen=True, slots=True)
class Target:
    """An appearance as seen from the camera.

    ``image`` (rows, columns, 3) float32, linear, finite, >= 0: 1 is a white object in uniform light; 0 outside ``mask``
    ``mask`` (rows, columns) bool: valid pixels of the target
    ``softened``: what made it softer than it was asked for, in words; empty where nothing did
    """

    image: FloatImage
    mask: Mask
    softened: str = ""


def srgb_to_linear(values: npt.NDArray[Any]) -> FloatImage:
    """Linear light of sRGB values: floats in [0, 1], or integers over their type's whole range."""
    encoded = _as_unit(values)
    low = encoded / np.float32(12.92)
    high = ((np.maximum(encoded, 0) + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4)
    return np.where(encoded <= 0.04045, low, high).astype(np.float32)


def linear_to_srgb(light: FloatImage) -> FloatImage:
    """sRGB values in [0, 1] of linear light, clipped to [0, 1]."""
    clipped = np.clip(light, 0, 1).astype(np.float32)
    high = np.float32(1.055) * clipped ** np.float32(1 / 2.4) - np.float32(0.055)
    return np.where(clipped <= 0.0031308, np.float32(12.92) * clipped, high).astype(np.float32)


def _as_unit(values: npt.NDArray[Any]) -> FloatImage:
    if np.issubdtype(values.dtype, np.integer):
        return values.astype(np.float32) / np.float32(np.iinfo(values.dtype).max)
    return values.astype(np.float32)


CAMERA_FILTER_PX = 0.7
"""Minimum blur of the camera's optics and colour interpolation (``capture.raw.CAMERA_BLUR_PX``)."""


def through_camera(target: Target, *, sigma_px: float = CAMERA_FILTER_PX) -> Target:
    """A computed picture as the camera would see it, so that it asks for no edge that no photograph can show.

    The blur (a Gaussian of ``sigma_px``) is over the mask alone: nothing bleeds in from outside, or out.
    """
    image = np.where(target.mask[..., None], masked_blur(target.image, target.mask, sigma_px), 0)
    return Target(np.asarray(image, np.float32), target.mask, f"by the camera's own blur, {sigma_px:g} px")
