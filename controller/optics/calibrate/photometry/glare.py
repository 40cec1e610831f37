"""Veiling glare of the camera: stray light in its lens that lies over the whole picture.

It is part of the indirect light of white. Light by way of other surfaces is thrown back by the paint, so dark paint
shows little of it; a veil lies over dark and pale paint alike. Where paints of both kinds lie side by side, what a
paint that throws nothing back would show is the veil.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import cv2
import numpy as np

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask, summed
from controller.optics.calibrate.photometry.reflectance import own_reflectance, subset, subset_of
from controller.optics.calibrate.values import Calibration, Geometry

BLOCK_PX: Final = 24
"""Of the thinned picture."""
WHOLE: Final = 0.9
"""Of a block's pixels that must be known."""
LEAST_CONTRAST: Final = 0.25
"""Standard deviation of a block's reflectance over its mean; even paint says nothing of a veil."""
FEWEST: Final = 30
"""Blocks, each colour counted."""
WIDE: Final = 0.15
"""Standard deviation of what a lens spreads, in picture widths; the share depends little on it."""
COARSE_PX: Final = 96
"""Width of the picture in which that is calculated."""
NAMED: Final = 0.01
"""Of the light in the picture; stages without such glare had none that was believed."""
SURE: Final = 4.0
"""Standard errors of the median from which it is believed."""


def veiling_glare(calibration: Calibration, geometry: Geometry | None) -> float:
    """The share of the picture's light that lies as a veil over it; 0 where none is found or too little is known.

    It takes direct and indirect light, the ``geometry`` of these projectors, and dark paint beside pale.
    """
    parts = calibration.projectors
    if geometry is None or not parts or len(geometry.projectors) != len(parts):
        return 0.0
    thin = subset(calibration.object_mask)
    thrown = [part.indirect[thin] for part in parts if part.indirect is not None]
    if len(thrown) < len(parts):
        return 0.0
    few = replace(
        calibration,
        projectors=tuple(replace(part, white=part.white[thin]) for part in parts),
        black=calibration.black[thin],
        object_mask=calibration.object_mask[thin],
    )
    shape = subset_of(geometry, thin)
    paint, indirect = own_reflectance(few, shape), np.sum(thrown, axis=0)
    veil = spread_by_lens(indirect + summed([part.white for part in few.projectors]))
    known: Mask = np.asarray(few.object_mask & channels.finite(paint))
    shares = _shares(indirect, paint, veil, known)
    if shares.size < FEWEST:
        return 0.0
    middle = float(np.median(shares))
    error = 1.25 * 1.4826 * float(np.median(np.abs(shares - middle))) / np.sqrt(shares.size)
    return middle if middle > SURE * error else 0.0


def veiled(share: float) -> str | None:
    """What a technician should know of ``veiling_glare``; None where the lens is clear."""
    if share < NAMED:
        return None
    return (
        f"{100 * share:.1f} % of the light in the picture lies as a veil over all of it (glare in the camera's lens). "
        "Dark paint looks paler in photographs than it is. Clean the lens, use a hood, and cover what is bright beside "
        "the object. Then calibrate again."
    )


def spread_by_lens(light: FloatImage) -> FloatImage:
    """Light (rows, columns) or (rows, columns, 3) as a lens that veils would spread all of it."""
    rows, columns = light.shape[:2]
    coarse = cv2.resize(light, (COARSE_PX, max(1, round(COARSE_PX * rows / columns))), interpolation=cv2.INTER_AREA)
    wide = cv2.GaussianBlur(coarse, (0, 0), WIDE * COARSE_PX, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(cv2.resize(wide, (columns, rows), interpolation=cv2.INTER_LINEAR), np.float32)


def _shares(indirect: FloatImage, paint: FloatImage, veil: FloatImage, known: Mask) -> Float64:
    """Of each block and colour with paints of several kinds: what unpainted light there is, over ``veil``.

    The line through indirect light by reflectance is that of least squares; both are means over 3 x 3 pixels, so that
    noise of the reflectance does not make it flatter.
    """
    images = [cv2.blur(np.where(known[..., None], one, 0).astype(np.float32), (3, 3)) for one in (indirect, paint)]
    inside = cv2.erode(known.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    shares = []
    for row in range(0, known.shape[0] - BLOCK_PX + 1, BLOCK_PX):
        for column in range(0, known.shape[1] - BLOCK_PX + 1, BLOCK_PX):
            here = np.s_[row : row + BLOCK_PX, column : column + BLOCK_PX]
            use = inside[here]
            if use.mean() < WHOLE:
                continue
            light, reflectance = (image[here][use].astype(np.float64) for image in images)
            middle = reflectance.mean(axis=0)
            varied = reflectance - middle
            slope = np.sum(varied * light, axis=0) / np.maximum(np.sum(varied**2, axis=0), 1e-30)
            bare = light.mean(axis=0) - slope * middle
            contrast = varied.std(axis=0) > LEAST_CONTRAST * middle
            shares.append((bare / np.maximum(veil[here][use].mean(axis=0), 1e-30))[contrast])
    return np.concatenate(shares) if shares else np.zeros(0)
