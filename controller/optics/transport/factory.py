"""Which light transport a calibration gets.

Where the phase map is known, each camera sample has its own shares (``windows``, docs/decisions/0006). Where only
metapixels are, the shares are their Gaussians (``gaussians``). Projector pixels that light the room beside the object,
and not the object, are left out (docs/decisions/0011).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import FloatImage, Mask
from controller.core.errors import UsageError
from controller.optics.calibrate.values import Calibration, Metapixels, PhaseMap
from controller.optics.transport.gaussians.patches import Patches
from controller.optics.transport.gaussians.transport import PatchTransport
from controller.optics.transport.operator import LightTransport
from controller.optics.transport.windows.transport import WindowTransport

BORDER_PX: Final = 2
"""Camera pixels so near to the object's border see both, and say nothing."""
MOST_BESIDE: Final = 3.0
"""Times its light on the object that a projector pixel may have beside it."""
FAINTEST: Final = 0.01
"""Share of a projector's white, below which a camera pixel is not lit by it."""
NEIGHBOURS_PX: Final = 3
"""Light is summed over so many projector pixels each way: a camera may see few of them more than once."""
RIM_PX: Final = 7
"""Width of the square around a projector pixel in which there has to be light on the object: some of the wall is hidden
from the camera, but for a line at the object's border."""
LEAST_IN_RIM: Final = 0.05
"""Of the median of such squares that have light on the object: less are a few camera pixels with wrong places."""
LEAST_ROOM: Final = 0.05
"""Light beside the object, in that on it, from which a projector lights a room that the camera sees: the camera's blur
makes less of it in the dark."""


def build_transport(calibration: Calibration, *, patches: Patches | None = None) -> LightTransport:
    """Build T from a calibration.

    Camera pixels outside ``object_mask``, or not lit by a projector, have no shares of it. Shares come from the
    phase maps where every projector has one, else from the metapixels; of these, those that are not valid, not
    finite, or larger than 255 camera pixels light nothing. ``patches`` take the place of both, for another model of
    a projector pixel (``custom_weights``).

    Raises UsageError("calibration-inconsistent") when sizes differ or an image is not finite.
    """
    check_calibration(calibration)
    if patches is None and all(part.phase_map is not None for part in calibration.projectors):
        made: LightTransport = WindowTransport.from_calibration(calibration)
    else:
        made = PatchTransport.from_calibration(calibration, patches)
    segments = tuple(part.radiometry.segment for part in calibration.projectors)
    made = dataclasses.replace(made, segments=segments if any(segments) else ())
    beside = beside_object(calibration)
    if beside is None:
        return made
    # A camera pixel that sees the room by any projector's light is none of the object's.
    return dataclasses.replace(made, lit=made.lit & ~beside.camera.any(axis=0), beside=beside.pixels)


def check_calibration(calibration: Calibration) -> None:
    """Raise UsageError("calibration-inconsistent") when sizes differ or an image is not finite."""
    shape = (*calibration.object_mask.shape, 3)
    problem = None
    if not calibration.projectors:
        problem = "it has no projector"
    elif calibration.black.shape != shape or not np.isfinite(calibration.black).all():
        problem = "its black image has another size than the camera's, or is not finite"
    for projector in calibration.projectors:
        white, metapixels = projector.white, projector.metapixels
        if white.shape != shape or not np.isfinite(white).all() or white.min(initial=0) < 0:
            problem = (
                f"the white image of {projector.name} has another size than the camera's, is not finite or negative"
            )
        elif not _consistent(metapixels):
            problem = f"the metapixels of {projector.name} differ in size"
        elif projector.phase_map is not None and not (
            projector.phase_map.projector_px.shape == (*shape[:2], 2)
            and projector.phase_map.spread_px2.shape == (*metapixels.valid.shape, 3)
        ):
            problem = f"the phase map of {projector.name} has another size than its pictures"
    if problem is not None:
        raise UsageError(
            "calibration-inconsistent",
            what=f"The calibration can't be used: {problem}.",
            remedy="Calibrate the stage again.",
        )


def _consistent(metapixels: Metapixels) -> bool:
    shape = metapixels.valid.shape
    return metapixels.centre_px.shape == (*shape, 2) and metapixels.covariance_px2.shape == (*shape, 3)


@dataclass(frozen=True, slots=True)
class OffObject:
    """``pixels`` (pixels of all projectors) bool: the camera sees their light mostly beside the object.

    ``camera`` (projectors, camera rows, columns) bool: camera pixels that see such light of a projector
    """

    pixels: Mask
    camera: Mask


def beside_object(calibration: Calibration) -> OffObject | None:
    """None if no projector pixel is beside the object: as in a dark room, where the camera sees nothing there."""
    mask = calibration.object_mask.astype(np.uint8)
    around = np.ones((2 * BORDER_PX + 1,) * 2, np.uint8)
    inside, outside = cv2.erode(mask, around) > 0, cv2.dilate(mask, around) == 0
    pixels, camera = [], np.zeros((len(calibration.projectors), *mask.shape), np.bool_)
    for n, part in enumerate(calibration.projectors):
        found = np.zeros(part.metapixels.valid.shape, np.bool_)
        if part.phase_map is not None:
            brightest = channels.largest(part.white)
            seen, cells = _cells(brightest, part.phase_map, found.shape)
            on, off = (_light(brightest, seen & where, cells, found.shape) for where in (inside, outside))
            if off.sum() > LEAST_ROOM * on.sum():
                found = _beside(on, off)
                camera[n][seen] = found.ravel()[cells[seen]]
        pixels.append(found.ravel())
    every = np.concatenate(pixels)
    return OffObject(every, camera) if every.any() else None


def _beside(on: FloatImage, off: FloatImage) -> Mask:
    """(rows, columns) from the light on the object and beside it."""
    rim = _sum(on, RIM_PX)
    least = LEAST_IN_RIM * float(np.median(rim[rim > 0])) if (rim > 0).any() else 0.0
    return np.asarray((_sum(off, NEIGHBOURS_PX) > MOST_BESIDE * _sum(on, NEIGHBOURS_PX)) | (rim <= least))


def _cells(brightest: FloatImage, phase_map: PhaseMap, shape: tuple[int, ...]) -> tuple[Mask, npt.NDArray[np.int32]]:
    """Camera pixels (rows, columns) that a projector lights, and the number of the projector pixel that does."""
    rows, columns = shape
    known = channels.finite(phase_map.projector_px)
    places = np.where(known[..., None], phase_map.projector_px, -1)
    x, y = np.moveaxis(np.rint(np.clip(places, -1, max(rows, columns))).astype(np.int32), 2, 0)
    within = (x >= 0) & (y >= 0) & (x < columns) & (y < rows)
    lit = brightest > FAINTEST * brightest.max(initial=0)
    return np.asarray(known & within & lit), np.where(within, y * columns + x, 0).astype(np.int32)


def _light(brightest: FloatImage, seen: Mask, cells: npt.NDArray[np.int32], shape: tuple[int, ...]) -> FloatImage:
    """(rows, columns): light that camera pixels see of each projector pixel."""
    light = np.bincount(cells[seen], weights=brightest[seen], minlength=shape[0] * shape[1])
    return light.reshape(shape).astype(np.float32)


def _sum(light: FloatImage, side: int) -> FloatImage:
    """The sum over a square around each pixel; exactly 0 where there is no light in it."""
    around = cv2.boxFilter(light.astype(np.float64), -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
    some = cv2.dilate((light > 0).astype(np.uint8), np.ones((side, side), np.uint8)) > 0
    return np.where(some, around, 0).astype(np.float32)
