"""What a paint changes of the colours that the local transport predicts, at each camera pixel."""

from __future__ import annotations

import numpy as np

from controller.core import channels
from controller.core.arrays import Float64, Mask, strips
from controller.optics.calibrate.photometry.paint_mixing import colour_of
from controller.optics.calibrate.values import Calibration, Radiometry
from controller.optics.transport.indirect.indirect_light import Colours


def paint_colours(calibration: Calibration, lit: Mask) -> Colours | None:
    """D (3, 3, rows, columns) of ``IndirectLight``; None where one mixing holds for all paints.

    One D stands for all projectors: their mean, weighted by their white light. Lamps of one kind have the same.

    Parameters
    ----------
    calibration : with ``Radiometry.paint`` of each projector, or of none
    lit : (rows, columns) camera pixels whose direct light the transport knows; D is 0 elsewhere
    """
    if any(part.radiometry.paint is None for part in calibration.projectors):
        return None
    found = np.zeros((3, 3, *lit.shape), np.float16)
    for rows in strips(len(lit)):
        light, total = np.zeros((3, 3, *lit[rows].shape)), np.full(lit[rows].shape, 1e-30)
        for part in calibration.projectors:
            white = np.maximum(part.white[rows], 0).astype(np.float64)
            strength = channels.total(white)
            light += strength * _deviation(part.radiometry, colour_of(white))
            total += strength
        found[:, :, rows] = np.where(lit[rows], light / total, 0)
    return found


def _deviation(radiometry: Radiometry, colour: Float64) -> Float64:
    """D (3, 3, rows, columns) of one projector; ``colour`` (rows, columns, 3, 3) of its white, as of ``colour_of``."""
    assert radiometry.paint is not None
    mixing = np.einsum("yxkj,kcj->yxkc", colour, radiometry.paint)
    # No colour takes light away: what says so is the error of B, on paints that are nearly black in one channel.
    mixing = np.maximum(mixing, 0.0)
    mixing /= mixing.sum(axis=-1, keepdims=True)
    relative = mixing @ np.linalg.inv(radiometry.mixing) - np.eye(3)
    return np.asarray(np.einsum("yxkm,yxmk->kmyx", relative, colour), np.float64)


__all__ = ["paint_colours"]
