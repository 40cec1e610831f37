"""What light a stage can make at each camera pixel, and the exposure of a target that fits into it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from controller.arrays import FloatImage, Mask
from controller.errors import UsageError, WorkError
from controller.solve.bounded import check_target
from controller.transport import LightTransport


@dataclass(frozen=True, slots=True)
class Feasibility:
    """How a target radiance lies in the reachable range K to K + T 1.

    ``too_bright``, ``too_dark`` (rows, columns, 3) float32, >= 0: what is missing or too much, in camera units
    ``reachable`` (rows, columns) bool: on the object and within the range in all channels
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
    margin: float = 1e-3,
    reach: FloatImage | None = None,
) -> Feasibility:
    """Compare ``target`` (rows, columns, 3), linear radiance, with what the projectors can make.

    ``margin`` of the brightest reachable light is forgiven; ``reach`` is ``transport.reach()`` where already known.
    """
    check_target(transport, target)
    reach = transport.reach() if reach is None else reach
    slack = margin * float(reach.max(initial=0))
    bright = np.maximum(target - black - reach, 0)
    dark = np.maximum(black - target, 0)
    mask = transport.object_mask
    bright[~mask] = 0
    dark[~mask] = 0
    reachable = mask & (bright.max(axis=2) <= slack) & (dark.max(axis=2) <= slack)
    share = float(reachable[mask].mean()) if mask.any() else 0.0
    return Feasibility(bright, dark, reachable, share)


def choose_exposure(
    transport: LightTransport,
    target: FloatImage,
    black: FloatImage,
    *,
    share: float = 0.95,
    reach: FloatImage | None = None,
) -> float:
    """The largest exposure at which ``share`` of the object's pixels can be made as bright as exposure x target.

    ``target`` (rows, columns, 3): reflectance-like, 0 to 1. All three channels of a pixel must be within K + T 1;
    pixels that should be darker than the black image K do not bear on the exposure, they stay at K.

    Raises UsageError("share-out-of-range"), WorkError("no-light") when there is no light or the target is black.
    """
    check_target(transport, target)
    if not 0 < share <= 1:
        raise UsageError(
            "share-out-of-range",
            what=f"A share of {share} reachable pixels was asked for.",
            remedy="Ask for a share above 0 and up to 1, for example 0.95.",
        )
    reach = transport.reach() if reach is None else reach
    mask = transport.object_mask
    wanted = target[mask].astype(np.float64)
    range_end = reach[mask].astype(np.float64) + black[mask]
    largest = np.divide(range_end, wanted, out=np.full_like(wanted, np.inf), where=wanted > 0).min(axis=1)
    largest.sort()
    # The pixel that bounds the exposure: at most (1 - share) of all pixels may need less.
    bound = int(np.floor((1 - share) * largest.size))
    exposure = float(largest[min(bound, largest.size - 1)]) if largest.size else 0.0
    if not 0 < exposure < np.inf:
        raise WorkError(
            "no-light",
            what="No exposure fits this target: it is black, or the projectors bring no light to the object.",
            remedy="Check the target, and that the calibration saw the projectors' light on the object.",
        )
    return exposure


def target_radiance(target: FloatImage, black: FloatImage, exposure: float) -> FloatImage:
    """The camera image to aim at: exposure x target, raised to the black image where it is darker."""
    radiance: FloatImage = np.maximum(np.float32(exposure) * target, black).astype(np.float32, copy=False)
    return radiance
