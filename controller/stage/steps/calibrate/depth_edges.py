"""The steps of the automatic mode: dots only where one projector pixel falls on two surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from controller.optics.calibrate.metapixels.depth_edges import (
    EdgeShares,
    edge_frame,
    edge_patterns,
    edge_pixels,
    measure_shares,
)
from controller.optics.calibrate.metapixels.pixel_status import pixel_status, status_counts
from controller.optics.transport import build_transport
from controller.optics.transport.edge_terms import edge_term
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.artefacts.calibration import read_calibration, read_correspondence
from controller.stage.artefacts.depth_edges import EdgeDots, read_edges, write_edges, write_terms
from controller.stage.artefacts.kinds import StepKind, of_projectors
from controller.stage.artefacts.photographs import PhotographSet
from controller.stage.artefacts.projectors import Light
from controller.stage.rig.rig import Rig, RigProjector
from controller.stage.steps import costs
from controller.stage.steps.capture.dots import (
    check_disk,
    dot_exposure_s,
    of_sinusoids,
    planned,
    read_batches,
    spacing_of,
    take_in_batches,
)
from controller.stage.steps.modes import DotOptions

EXPECTED_SHOTS: Final = 36
TYPICAL: Final = 0.5
"""Share of pixels whose blur sets the spacing. No ellipse is fitted here, so a few touching dots matter less."""


def edge_steps(rig: Rig, projector: RigProjector, options: DotOptions, longest_exposure_s: float) -> list[Step]:
    """Photograph the pixels at depth edges of one projector, and store each one's camera values."""
    name, scale = projector.name, costs.scale([projector.size_px])
    own = of_projectors([name], StepKind.RADIOMETRY, StepKind.PIXELS, StepKind.EDGE_DOTS)
    return [
        Step(
            StepId(StepKind.EDGE_DOTS, name),
            partial(_photograph, rig, projector, options, longest_exposure_s),
            inputs={"longest_exposure_s": repr(longest_exposure_s), **options.inputs()},
            after=(StepId(StepKind.EXPOSURE), StepId(StepKind.PIXELS, name)),
            title=f"Photographing the depth edges of {name}",
            weight=costs.shot_s(scale) * EXPECTED_SHOTS,
        ),
        Step(
            StepId(StepKind.EDGES, name),
            partial(_measure, projector),
            inputs=options.inputs(),
            after=(StepId(StepKind.BLACK), *own),
            title=f"Measuring the depth edges of {name}",
            weight=costs.dots_s(scale, EXPECTED_SHOTS),
        ),
    ]


def _photograph(
    rig: Rig, projector: RigProjector, options: DotOptions, longest_s: float, context: Context
) -> Sequence[Path]:
    folder, name = context.folder, projector.name
    known = of_sinusoids(folder, name)
    spacing = spacing_of(options, known, share=TYPICAL)
    pattern = edge_patterns(edge_pixels(known, read_correspondence(folder, name)), spacing)
    count = int(pattern.max(initial=-1)) + 1
    into = PhotographSet(StepKind.EDGE_DOTS, name)
    check_disk(folder, into, count)
    exposure_s = dot_exposure_s(rig, folder, name, known, longest_s)
    plan = [
        planned(projector, f"{number:03d}", partial(edge_frame, pattern, number), exposure_s) for number in range(count)
    ]
    paths = take_in_batches(rig, context, plan, into=into)
    return [*EdgeDots(pattern, spacing, exposure_s, count).write(folder, name), *paths]


def _measure(projector: RigProjector, context: Context) -> Sequence[Path]:
    folder, name = context.folder, projector.name
    light, shown = Light.read(folder, name), EdgeDots.read(folder, name)
    position = read_correspondence(folder, name).projector_px
    count, reach = shown.photographs, (shown.spacing_px - 1) // 2
    parts = [(np.empty(0, np.int32), np.empty(0, np.int32), np.empty(0, np.float32))]
    for number, item in enumerate(read_batches(folder, PhotographSet(StepKind.EDGE_DOTS, name), count)):
        context.advance(number / count, item.name)
        lit = np.asarray(shown.pattern == number)
        parts.append(measure_shares(item.per_second(), light.black, light.white, position, lit, reach))
    camera, at, share = (np.concatenate(column) for column in zip(*parts, strict=True))
    why = pixel_status(of_sinusoids(folder, name), light.white)
    content = {
        **shown.notes,
        "edge_pixels": int(np.count_nonzero(shown.pattern >= 0)),
        "shares": int(share.size),
        "reasons": status_counts(why),
    }
    return write_edges(folder, name, EdgeShares(camera, at, share, shown.pattern), why, content)


def terms_step(rig: Rig) -> Step:
    """Compare the measurement with the transport's model once, so that no solve has to."""
    names = [projector.name for projector in rig.projectors]
    return Step(
        StepId(StepKind.EDGE_TERMS),
        partial(_compare, names),
        after=of_projectors(names, StepKind.RADIOMETRY, StepKind.PIXELS, StepKind.INDIRECT, StepKind.EDGES),
        title="Correcting the light transport at depth edges",
        weight=3 * costs.scale(projector.size_px for projector in rig.projectors),
    )


def _compare(names: Sequence[str], context: Context) -> Sequence[Path]:
    calibration = read_calibration(context.folder, names)
    model = build_transport(calibration)
    terms = []
    for n, (part, measured) in enumerate(zip(calibration.projectors, read_edges(context.folder, names), strict=True)):
        context.advance(n / len(names), part.name)
        terms.append(edge_term(model, n, measured, part.white))
    return [write_terms(context.folder, names, terms)]
