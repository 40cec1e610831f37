"""The share of indirect light, and the response in direct light alone: each follows from the other."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from controller.core.arrays import Float64, FloatImage
from controller.optics.calibrate.correspondence.captures import Captures
from controller.optics.calibrate.correspondence.gray_code import Cells
from controller.optics.calibrate.photometry.colour_tiles import KnownIndirect
from controller.optics.calibrate.photometry.radiometry import RadiometryReport, measure_radiometry
from controller.optics.calibrate.photometry.separation import SinusoidContrast, indirect_share, shown_contrast
from controller.optics.calibrate.photometry.waveform import Wave, held_to
from controller.optics.calibrate.values import Radiometry, SurfaceSpread
from controller.optics.capture.patterns import PatternPlan
from controller.optics.capture.profile import CameraNoise

PASSES: Final = 2


def tell_direct_light(
    captures: Captures,
    plan: PatternPlan,
    seen: SinusoidContrast,
    waves: tuple[Wave, ...],
    *,
    start: Radiometry,
    shown_with: Float64,
    white: FloatImage,
    projector_px: FloatImage,
    spread: SurfaceSpread | None = None,
    noise: CameraNoise | None = None,
    code: tuple[Cells, Cells] | None = None,
    advance: Callable[[float], None] = lambda share: None,
) -> tuple[FloatImage, Radiometry, RadiometryReport]:
    """The share (rows, columns, 3) of a projector's white that is indirect, 0 to 1, its response and mixing in direct
    light, and a report on their measurement.

    Parameters
    ----------
    captures, noise, code : as for ``measure_radiometry``
    seen, waves : what the sinusoids show, of ``sinusoid_contrast`` and ``coarse_waves``
    start : response and mixing in direct and indirect light together
    shown_with : (3, 256) the response by which the sinusoids were encoded
    white, projector_px, spread : as for ``indirect_share``
    advance : told what part of the work is done, 0 to 1

    Raises what ``measure_radiometry`` raises.
    """
    radiometry = start
    near: Float64 | None = None
    for number in range(PASSES):
        advance(number / PASSES)
        linearity = shown_contrast(radiometry, shown_with)
        share = indirect_share(seen, white, projector_px, linearity=linearity, spread=spread)
        known = KnownIndirect(share * white, radiometry)
        tiles, report = measure_radiometry(captures, plan, indirect=known, noise=noise, code=code)
        radiometry = held_to(waves, tiles, shown_with, share, white, near)
        near = radiometry.response
    return share, radiometry, report


__all__ = ["tell_direct_light"]
