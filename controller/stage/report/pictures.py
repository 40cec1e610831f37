"""Pictures of a report: linear light to what a screen shows, error maps with one fixed scale, embedding in the page."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from controller.core.arrays import ByteImage, Float64, FloatImage, Mask

XYZ_TO_SRGB = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
"""IEC 61966-2-1, linear part."""

ERROR_SCALE_DELTA_E = 12.0
"""The colour difference of the brightest colour in an error map; the same in every report, so that they can be
compared."""

OUTSIDE = (38, 40, 44)
"""The grey of maps where nothing is known."""


@dataclass(frozen=True, slots=True)
class Crop:
    """The part of the camera image that the pictures show: the object with a margin."""

    rows: slice
    columns: slice


def read_picture(path: Path) -> ByteImage | None:
    """(rows, columns, 3) uint8 RGB of a picture of a run; None if it is missing or damaged."""
    # not by cv2.imread, which ends the program where a folder's name is not UTF-8
    data = np.frombuffer(path.read_bytes(), np.uint8) if path.exists() else np.zeros(0, np.uint8)
    decoded: Any = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB) if data.size else None
    return None if decoded is None else np.asarray(decoded, np.uint8)


def crop_around(mask: Mask, *, margin: float = 0.04) -> Crop:
    """The box around ``mask`` (rows, columns), widened by ``margin`` of its size; the whole image if it is empty."""
    height, width = mask.shape
    if not mask.any():
        return Crop(slice(0, height), slice(0, width))
    rows = np.flatnonzero(mask.any(axis=1))
    columns = np.flatnonzero(mask.any(axis=0))
    pad = int(margin * max(rows[-1] - rows[0], columns[-1] - columns[0]))
    return Crop(
        slice(max(0, int(rows[0]) - pad), min(height, int(rows[-1]) + pad + 1)),
        slice(max(0, int(columns[0]) - pad), min(width, int(columns[-1]) + pad + 1)),
    )


def to_screen(image: FloatImage, camera_to_xyz: Float64, *, white: float) -> ByteImage:
    """Linear camera RGB to 8-bit sRGB, ``white`` (camera units) becoming the screen's white.

    ``image`` (rows, columns, 3) float32; ``camera_to_xyz`` (3, 3), scaled so that equal camera values are D65 grey.
    """
    matrix = XYZ_TO_SRGB @ camera_to_xyz
    matrix = matrix / matrix.sum(axis=1, keepdims=True)
    linear = np.clip(np.nan_to_num(image) @ matrix.T.astype(np.float32) / white, 0, 1)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(encoded * 255), dtype=np.uint8)


def error_picture(delta_e: FloatImage, mask: Mask) -> ByteImage:
    """Colour differences (rows, columns) as a picture: black none, bright ``ERROR_SCALE_DELTA_E``; grey outside."""
    level = np.clip(np.nan_to_num(delta_e) / ERROR_SCALE_DELTA_E, 0, 1)
    coloured = cv2.applyColorMap(np.asarray(np.rint(level * 255), dtype=np.uint8), cv2.COLORMAP_INFERNO)
    rgb = np.asarray(coloured[..., ::-1], dtype=np.uint8).copy()
    rgb[~mask] = OUTSIDE
    return rgb


def sharpness_picture(local: FloatImage, window_px: int, shape: tuple[int, int], mask: Mask) -> ByteImage:
    """Local sharpness by windows, 0 to 1 with NaN where nothing can be judged, as a picture of ``shape``.

    Dark violet none of the target's edges, yellow all of them; grey outside the mask and where there are too few.
    """
    whole = np.kron(local, np.ones((window_px, window_px), np.float32))[: shape[0], : shape[1]]
    level = np.asarray(np.rint(np.clip(np.nan_to_num(whole), 0, 1) * 255), dtype=np.uint8)
    rgb = np.asarray(cv2.applyColorMap(level, cv2.COLORMAP_VIRIDIS)[..., ::-1], dtype=np.uint8).copy()
    rgb[~mask | np.isnan(whole)] = OUTSIDE
    return rgb


def scale_bar() -> ByteImage:
    """The colours of ``error_picture`` from 0 to ``ERROR_SCALE_DELTA_E``, (12, 256, 3) uint8."""
    ramp = np.repeat(np.arange(256, dtype=np.uint8)[None], 12, axis=0)
    return np.asarray(cv2.applyColorMap(ramp, cv2.COLORMAP_INFERNO)[..., ::-1], dtype=np.uint8)


def fitted(image: ByteImage, *, longest_px: int) -> ByteImage:
    """Shrink so that the longer side has at most ``longest_px`` (area average); never enlarges."""
    height, width = image.shape[:2]
    factor = longest_px / max(height, width)
    if factor >= 1:
        return image
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def encoded(image: npt.NDArray[np.uint8], *, quality: int = 92) -> bytes:
    """RGB (rows, columns, 3) as JPEG bytes."""
    bgr = np.ascontiguousarray(image[..., ::-1])
    ok, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not ok:
        raise ValueError(f"a picture of shape {image.shape} cannot be encoded")
    return bytes(data.tobytes())


def data_uri(image: ByteImage, *, longest_px: int = 720) -> str:
    """An RGB picture as a ``data:`` address, so that the report is one file."""
    return "data:image/jpeg;base64," + base64.b64encode(encoded(fitted(image, longest_px=longest_px))).decode()
