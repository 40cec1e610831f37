"""What light a stage can make at each camera pixel, and the exposure of a target that fits into it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from controller.core.arrays import FloatImage, Mask
from controller.core.channels import largest
from controller.core.errors import UsageError, WorkError
from controller.solve.bounded.solver import check_target
from controller.solve.drive_levels import DriveLevels
from controller.transport import LightTransport

FORGIVEN_DRIVE: Final = 2e-3
"""So much drive beyond black and white still counts as in reach."""


@dataclass(frozen=True, slots=True)
class Feasibility:
    """Which part of a target radiance the projectors can make.

    ``too_bright``, ``too_dark`` (rows, columns, 3) float32, >= 0: by how much the channels of the projectors would have
    to be driven above white, or below black; 1 is all of a channel's light
    ``reachable`` (rows, columns) bool: on the object, and neither too bright, too dark nor too saturated
    ``share``: the part of the object's pixels that is reachable
    """

    too_bright: FloatImage
    too_dark: FloatImage
    reachable: Mask
    share: float


def feasibility(
    transport: LightTransport,
    target: FloatImage,
    black: FloatImage,
    *,
    margin: float = FORGIVEN_DRIVE,
    drive: DriveLevels | None = None,
) -> Feasibility:
    """Compare ``target`` (rows, columns, 3), linear radiance, with the light that the projectors can make.

    ``margin``: so much drive beyond [0, 1] is forgiven; ``drive`` of this transport, where already known.
    """
    check_target(transport, target)
    drive = DriveLevels(transport) if drive is None else drive
    needed = drive.of(target - black)
    bright, dark = np.maximum(needed - 1, 0), np.maximum(-needed, 0)
    mask = drive.mask
    reachable: Mask = mask & (largest(bright) <= margin) & (largest(dark) <= margin)
    share = float(reachable[mask].mean()) if mask.any() else 0.0
    return Feasibility(bright, dark, reachable, share)


def choose_exposure(
    transport: LightTransport,
    target: FloatImage,
    black: FloatImage,
    *,
    share: float = 0.95,
    drive: DriveLevels | None = None,
) -> float:
    """The largest exposure at which ``share`` of the object's pixels can be made as bright as exposure x target.

    ``target`` (rows, columns, 3): reflectance-like, 0 to 1. No channel of a pixel may need more than all its light;
    pixels too dark or too saturated for the stage do not affect the exposure: another one would not help them.

    Raises UsageError("share-out-of-range"), WorkError("no-light") when there is no light or the target is black.
    """
    check_target(transport, target)
    if not 0 < share <= 1:
        raise UsageError(
            "share-out-of-range",
            what=f"A share of {share} reachable pixels is not possible.",
            remedy="Give a share above 0 and up to 1, for example 0.95.",
        )
    drive = DriveLevels(transport) if drive is None else drive
    mask = drive.mask
    per_exposure, at_none = drive.of(target)[mask].astype(np.float64), drive.of(-black)[mask].astype(np.float64)
    possible = np.isfinite(per_exposure).all(axis=1) & np.isfinite(at_none).all(axis=1)
    per_exposure, at_none = per_exposure[possible], at_none[possible]
    room = np.full_like(per_exposure, np.inf)
    # less than this needs no light worth counting, and its quotient would only overflow
    largest = np.divide(1 - at_none, per_exposure, out=room, where=per_exposure > 1e-12).min(axis=1)
    largest.sort()
    # The pixel that bounds the exposure: at most (1 - share) of all pixels may need less.
    bound = int(np.floor((1 - share) * largest.size))
    exposure = float(largest[min(bound, largest.size - 1)]) if largest.size else 0.0
    if not 0 < exposure < np.inf:
        raise WorkError(
            "no-light",
            what="No exposure fits this target: it is black, or no projector lights the object.",
            remedy="Check the target. Check that the projectors lit the object during the calibration.",
        )
    return exposure


def target_radiance(target: FloatImage, black: FloatImage, exposure: float) -> FloatImage:
    """The camera image to aim at: exposure x target, raised to the black image where it is darker."""
    radiance: FloatImage = np.maximum(np.float32(exposure) * target, black).astype(np.float32, copy=False)
    return radiance
