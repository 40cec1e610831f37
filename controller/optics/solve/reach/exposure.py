"""The exposure of a target and what of it is in reach, direct and indirect light together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from controller.core.arrays import FloatImage
from controller.optics.solve.bounded.solver import check_target
from controller.optics.solve.reach.drive_levels import DriveLevels
from controller.optics.solve.reach.feasibility import Feasibility, choose_exposure, feasibility
from controller.optics.transport import LightTransport
from controller.optics.transport.indirect.indirect_light import IndirectLight


@dataclass(frozen=True, slots=True)
class ExposedTarget:
    """A target at its exposure, (rows, columns, 3) radiance.

    ``wanted``: the whole picture; ``needed``: what of it has to come from the projectors directly, with the black
    image; ``possible``: how that lies in what they can make
    """

    exposure: float
    wanted: FloatImage
    needed: FloatImage
    possible: Feasibility


def expose_target(
    transport: LightTransport,
    picture: FloatImage,
    black: FloatImage,
    *,
    share: float,
    drive: DriveLevels | None = None,
    indirect: IndirectLight | None = None,
) -> ExposedTarget:
    """Expose ``picture`` (rows, columns, 3), reflectance-like, so that ``share`` of the object can be that bright.

    With ``indirect`` light a pixel is too dark, too, where more of it falls than is wanted. Raises what
    ``choose_exposure`` raises.
    """
    drive = DriveLevels(transport) if drive is None else drive
    found = exposure(transport, picture, black, share=share, drive=drive, indirect=indirect)
    wanted = np.float32(found) * picture
    needed = direct_part(transport, wanted, black, indirect)
    return ExposedTarget(found, wanted, needed, feasibility(transport, needed, black, drive=drive))


def direct_part(
    transport: LightTransport, wanted: FloatImage, black: FloatImage, indirect: IndirectLight | None
) -> FloatImage:
    """What the projectors' direct light and the black image are to make of ``wanted`` (rows, columns, 3)."""
    if indirect is None:
        return wanted
    return black + indirect.direct_target(wanted - black, reach=transport.reach())


def exposure(
    transport: LightTransport,
    picture: FloatImage,
    black: FloatImage,
    *,
    share: float,
    drive: DriveLevels,
    indirect: IndirectLight | None = None,
) -> float:
    """As ``choose_exposure``, where a part of the picture's light comes by way of other surfaces.

    As direct light is linear in the picture while none of it is out of reach, both are taken apart once.
    """
    first = choose_exposure(transport, picture, black, share=share, drive=drive)
    if indirect is None:
        return first
    check_target(transport, picture)
    direct = indirect.direct_target(np.float32(first) * picture) / np.float32(first)
    needed = np.where(transport.object_mask[..., None], np.maximum(direct, 0), picture).astype(np.float32)
    return choose_exposure(transport, needed, black, share=share, drive=drive)
