"""Names projectors whose lens veils their picture, from the code's coarse stripes, once the surface is known."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import cv2
import numpy as np

from controller.core.arrays import FloatImage
from controller.core.errors import TroubleCode
from controller.optics.calibrate.photometry.glare import spread_by_lens
from controller.optics.calibrate.photometry.projector_glare import DarkPart, lens_veils, projector_glare
from controller.optics.calibrate.values import Geometry
from controller.optics.capture.pattern_frames import frame
from controller.optics.transport.indirect.stripes import stride_of, stripe_parts, thinned
from controller.run.runner import Context
from controller.stage.artefacts.calibration import read_captures
from controller.stage.artefacts.pattern_plans import PlanUsed
from controller.stage.artefacts.photographs import Developed
from controller.stage.artefacts.projectors import Light, Pixels
from controller.stage.rig.rig import RigProjector
from hal.notices import Notice

COARSE_BITS: Final = 4
"""Of each axis of the code; finer stripes leave few places dark."""


def lens_troubles(context: Context, projectors: Sequence[RigProjector], geometry: Geometry) -> list[Notice]:
    """A trouble for each projector that has a veil; none where the code was shown in colours, or not at all."""
    stride = stride_of(geometry.points_m.shape)
    lights = [Light.read(context.folder, projector.name) for projector in projectors]
    whites = [thinned(light.white, stride) for light in lights]
    depth_m = np.ascontiguousarray(geometry.points_m[::stride, ::stride, 2])
    found = []
    for n, projector in enumerate(projectors):
        parts = list(_dark_parts(context, projector, thinned(lights[n].black, stride), stride))
        glare = projector_glare(whites, n, parts, depth_m)
        if (said := lens_veils(projector.name, glare.sure)) is not None:
            found.append(Notice.warning(TroubleCode.PROJECTOR_GLARE, said, about=projector.name))
    return found


def _dark_parts(context: Context, projector: RigProjector, black: FloatImage, stride: int) -> Iterator[DarkPart]:
    known = Pixels.read(context.folder, projector.name).phase_map
    plan = PlanUsed.read(context.folder, projector.name).plan(projector.size_px)
    stripes = [pattern for axis in (0, 1) for pattern in plan.gray(axis)[:COARSE_BITS]]
    if known is None or not stripes:
        return
    captures = Developed(read_captures(context.folder, projector.name), {})
    position_px = thinned(known.projector_px, stride)
    at = np.nan_to_num(position_px, nan=-1e4)
    for pattern in stripes:
        dark = stripe_parts(pattern, plan.size_px, position_px)[1]
        spread = spread_by_lens(np.asarray(frame(pattern, plan.size_px), np.float32))
        veil = cv2.remap(spread, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        light = thinned(captures[pattern.name], stride) - black
        yield DarkPart(light, dark, np.asarray(veil, np.float32))


__all__ = ["lens_troubles"]
