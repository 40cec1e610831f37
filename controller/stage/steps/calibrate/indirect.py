"""The step that tells direct from indirect light, and measures the response once more in direct light alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from controller.core.arrays import FloatImage
from controller.core.errors import TroubleCode
from controller.optics.calibrate.correspondence.captures import completed
from controller.optics.calibrate.photometry.colour_tiles import tile_code
from controller.optics.calibrate.photometry.radiometry import SinusoidLight, TilePhotographs, painted, tell_direct_light
from controller.optics.calibrate.photometry.separation import (
    indirect_figures,
    lamp_flicker,
    sinusoid_contrast,
    unsteady,
)
from controller.optics.calibrate.photometry.waveform import Wave, coarse_waves
from controller.optics.transport.indirect.stripes import dark_light
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.artefacts.calibration import read_captures
from controller.stage.artefacts.kinds import StepKind, of_projectors
from controller.stage.artefacts.pattern_plans import PlanUsed
from controller.stage.artefacts.photographs import Developed, noise_of
from controller.stage.artefacts.projectors import Indirect, IndirectFigures, Light, Pixels, drawn_by
from controller.stage.rig.rig import RigProjector
from controller.stage.steps import costs
from controller.stage.steps.troubles import tell

GAIN_LIMITS: Final = 0.5, 2.0
"""Noise changes no white image by more, where it says anything."""
TOLD_AT: Final = 64
"""Device value at which the change of the response is reported."""


def indirect_step(projector: RigProjector) -> Step:
    """After the projector's pixels are known."""
    return Step(
        StepId(StepKind.INDIRECT, projector.name),
        lambda context: _separate(projector, context),
        after=(StepId(StepKind.BLACK), *of_projectors([projector.name], StepKind.RADIOMETRY, StepKind.PIXELS)),
        title=f"Telling direct from indirect light of {projector.name}",
        weight=costs.INDIRECT_S * costs.scale([projector.size_px]),
        calculates=True,
    )


def _separate(projector: RigProjector, context: Context) -> Sequence[Path]:
    folder, name = context.folder, projector.name
    used = PlanUsed.read(folder, name)
    plan = used.plan(projector.size_px)
    light, pixels = Light.read(folder, name), Pixels.read(folder, name)
    if not pixels.seen.any():
        nothing = Indirect(np.zeros_like(light.white), light.response, light.mixing, light.segment, paint=light.paint)
        return [nothing.write(folder, name), IndirectFigures(0.0, 0.0, (0.0, 0.0, 0.0)).write(folder, name)]
    taken = read_captures(folder, name)
    captures = completed(Developed(taken, {"black": light.black, "white": light.white + light.black}), plan)
    noise = noise_of(taken[plan.sinusoids("phase-x")[0].name])
    known_px = used.known_px(folder, name)
    seen = sinusoid_contrast(captures, plan, light.white, noise=noise)
    white = seen.white
    code = tile_code(captures, plan, light.black, light.white, known_px=known_px, noise=noise)
    phase_map = pixels.phase_map
    waves: tuple[Wave, ...] = ()
    if phase_map is not None:
        waves = coarse_waves(captures, plan, light.white, phase_map, pixels.seen, drawn_by(folder, name))
    sinusoids = SinusoidLight(seen, waves, pixels.projector_px, pixels.surface_spread)
    tiles = TilePhotographs(captures, plan, code)
    share, radiometry, report = tell_direct_light(tiles, sinusoids, white, light.radiometry, advance=context.advance)
    median, p95 = indirect_figures(share, white)
    change = radiometry.response[:, TOLD_AT] / np.maximum(light.response[:, TOLD_AT], 1e-9) - 1
    flicker = lamp_flicker(seen.strengths)
    figures = IndirectFigures(median, p95, tuple(float(value) for value in change), flicker)
    segment = np.array([radiometry.segment]) if radiometry.segment else None
    stripes = None if phase_map is None else dark_light(captures, plan, phase_map.projector_px)
    gain = _gain(white, light.white)
    found = Indirect(share, radiometry.response, radiometry.mixing, segment, stripes, gain, radiometry.paint)
    troubles = {
        TroubleCode.UNSTEADY_LAMP: unsteady(name, flicker, seen.sigma),
        # In direct light alone tiles differ less, so that paint is seen where it was not before.
        TroubleCode.PAINT_COLOURS: painted(name, report.paint),
    }
    said = tell(context, StepId(StepKind.INDIRECT, name), troubles)
    return [found.write(folder, name), figures.write(folder, name), said]


def _gain(white: FloatImage, photographed: FloatImage) -> FloatImage | None:
    """``white`` over that ``photographed``, 1 where one of them is not known; None where they are the same."""
    if white is photographed:
        return None
    gain = np.divide(white, photographed, out=np.ones_like(white), where=photographed > 0)
    return np.asarray(np.clip(np.nan_to_num(gain, nan=1.0), *GAIN_LIMITS), np.float32)


__all__ = ["indirect_step"]
