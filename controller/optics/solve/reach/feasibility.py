"""What light a stage can make at each camera pixel, and the exposure of a target that fits into it.

Direct and indirect light count together (``expose_target``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from controller.core.arrays import FloatImage, Mask, strips
from controller.core.channels import finite, largest, smallest
from controller.core.errors import UsageError, WorkError
from controller.optics.solve.bounded.solver import check_target
from controller.optics.solve.reach.drive_levels import DriveLevels
from controller.optics.solve.targets.values import Target
from controller.optics.transport.indirect.indirect_light import ReflectedLight

FORGIVEN_DRIVE: Final = 2e-3
"""So much drive beyond black and white still counts as in reach."""
SMALL_PART: Final = 0.1
"""Of the object: a part so small that decides how bright all is, is named."""
HELD_BACK: Final = 1.05
"""From so many times as bright on, as all could be without that part."""


@dataclass(frozen=True, slots=True)
class Feasibility:
    """Which part of a target radiance the projectors can make.

    ``too_bright``, ``too_dark`` (rows, columns) bool: a channel would have to be driven above white, below black
    ``reachable`` (rows, columns) bool: on the object, and neither too bright, too dark nor too saturated
    ``share``: the part of the object's pixels that is reachable
    """

    too_bright: Mask
    too_dark: Mask
    reachable: Mask
    share: float


def feasibility(
    drive: DriveLevels, target: FloatImage, black: FloatImage, *, margin: float = FORGIVEN_DRIVE
) -> Feasibility:
    """Compare ``target`` (rows, columns, 3), linear radiance, with the light that the projectors can make.

    ``margin``: so much drive beyond [0, 1] is forgiven
    """
    mask = drive.mask
    check_target(mask.shape, target)
    bright, dark = np.empty(mask.shape, np.bool_), np.empty(mask.shape, np.bool_)
    for rows in strips(len(target)):
        needed = drive.of(target[rows] - black[rows], rows)
        # asked so that what is no number counts as too bright
        bright[rows], dark[rows] = ~(largest(needed) <= 1 + margin), smallest(needed) < -margin
    reachable = mask & ~bright & ~dark
    share = float(reachable[mask].mean()) if mask.any() else 0.0
    return Feasibility(bright, dark, reachable, share)


def exposures(
    drive: DriveLevels,
    picture: FloatImage,
    black: FloatImage,
    share: float = 0.95,
    *,
    indirect: ReflectedLight | None = None,
) -> tuple[float, float]:
    """The largest exposure at which ``share`` of the object's pixels can be made as bright as exposure x picture.

    The second one is that at which ``SMALL_PART`` less of the object could be as bright.

    ``picture`` (rows, columns, 3): reflectance-like, 0 to 1. No channel of a pixel may need more than all its light;
    pixels too dark or too saturated for the stage do not affect the exposure: another one would not help them.
    ``indirect``: a part of the picture's light comes by way of other surfaces

    Raises UsageError("share-out-of-range"), WorkError("no-light") when there is no light or the picture is black.
    """
    check_target(drive.mask.shape, picture)
    if not 0 < share <= 1:
        raise UsageError(
            "share-out-of-range",
            what=f"A share of {share} reachable pixels is not possible.",
            remedy="Give a share above 0 and up to 1, for example 0.95.",
        )
    if indirect is not None:
        # while none of it is out of reach, direct light is in proportion to the picture
        picture = indirect.direct_target(picture)
        np.maximum(picture, 0, out=picture)
    most = np.concatenate([_most(drive, picture[rows], black[rows], rows) for rows in strips(len(picture))])
    most.sort()
    # The pixel that bounds the exposure: at most (1 - share) of all pixels may need less.
    bounds = (int(np.floor((1 - one) * most.size)) for one in (share, share - SMALL_PART))
    exposure, following = (float(most[min(bound, most.size - 1)]) if most.size else 0.0 for bound in bounds)
    if not 0 < exposure < np.inf:
        raise WorkError(
            "no-light",
            what="No exposure fits this target: it is black, or no projector lights the object.",
            remedy="Check the target. Check that the projectors lit the object during the calibration.",
        )
    return exposure, following


def _most(drive: DriveLevels, target: FloatImage, black: FloatImage, rows: slice) -> FloatImage:
    """(pixels,): the largest exposure of each pixel of the object in some rows of the picture."""
    per_exposure, at_none = (drive.of(light, rows) for light in (target, -black))
    room = np.full_like(per_exposure, np.inf)
    # less than this needs no light worth counting, and its quotient would only overflow
    np.divide(1 - at_none, per_exposure, out=room, where=(per_exposure > 1e-12) & (per_exposure < np.inf))
    return smallest(room)[drive.mask[rows] & finite(per_exposure) & finite(at_none)]


def target_radiance(target: FloatImage, black: FloatImage, exposure: float) -> FloatImage:
    """The camera image to aim at: exposure x target, raised to the black image where it is darker."""
    radiance: FloatImage = np.maximum(np.float32(exposure) * target, black).astype(np.float32, copy=False)
    return radiance


@dataclass(frozen=True, slots=True)
class ExposedTarget:
    """A target at its exposure, (rows, columns, 3) radiance.

    ``wanted``: the whole picture; ``needed``: what of it has to come from the projectors directly, with the black
    image; ``possible``: how that lies in what they can make; ``held_back``: how many times as bright all could be if
    ``SMALL_PART`` less of the object had to be
    """

    exposure: float
    wanted: FloatImage
    needed: FloatImage
    possible: Feasibility
    held_back: float


def expose_target(
    drive: DriveLevels,
    picture: FloatImage,
    black: FloatImage,
    *,
    share: float,
    indirect: ReflectedLight | None = None,
    asked: float | None = None,
) -> ExposedTarget:
    """Expose ``picture`` (rows, columns, 3), reflectance-like, so that ``share`` of the object can be that bright.

    ``asked``: the exposure, instead of that by ``share``.

    With ``indirect`` light a pixel is too dark, too, where more of it falls than is wanted. Raises what
    ``exposures`` raises.
    """
    found = following = asked or 0.0
    if asked is None:
        found, following = exposures(drive, picture, black, share, indirect=indirect)
    wanted = np.float32(found) * picture
    needed = direct_part(drive.reach, wanted, black, indirect)
    possible = feasibility(drive, needed, black)
    return ExposedTarget(found, wanted, needed, possible, following / found)


HARDLY_ANY: Final = 0.99


def with_less_light(
    drive: DriveLevels, target: Target, black: FloatImage, *, exposure: float, indirect: ReflectedLight | None = None
) -> tuple[float, float, float]:
    """Whether more of a target is in reach with less light than its ``exposure``.

    Gives the share of its pixels in reach at its light; the share of this light at which hardly any is too bright, 1
    where none is; and the share of its pixels in reach then. Raises what ``exposures`` raises.
    """
    asked = drive.mask & target.mask
    # the share is one of all of the object's pixels
    share = float(1 - (1 - HARDLY_ANY) * asked.sum() / max(1, drive.mask.sum()))
    most = exposures(drive, target.image, black, share, indirect=indirect)[0]
    shares = []
    for level in (exposure, min(most, exposure)):
        direct = direct_part(drive.reach, np.float32(level) * target.image, black, indirect)
        reachable = feasibility(drive, direct, black).reachable
        shares.append(float(reachable[asked].mean()) if asked.any() else 0.0)
    return shares[0], min(most / exposure, 1.0), shares[1]


def direct_part(
    reach: FloatImage, wanted: FloatImage, black: FloatImage, indirect: ReflectedLight | None
) -> FloatImage:
    """What the projectors' direct light, up to ``reach``, and the black image are to make of ``wanted``.

    All (rows, columns, 3)
    """
    if indirect is None:
        return wanted
    return black + indirect.direct_target(wanted - black, reach=reach)
