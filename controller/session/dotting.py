"""The steps of the paper's mode: photographs of dots, and the metapixels that they give (paper 4.1, 4.2)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Final

from controller.arrays import FloatImage, load_arrays, save_arrays
from controller.calibrate.dots import DotReport, fit_dots
from controller.calibrate.guess import guess_metapixels, modelled_correspondence, where_missing
from controller.calibrate.masks import reasons, summary
from controller.calibrate.regularize import regularize
from controller.calibrate.values import Metapixels
from controller.capture.dots import dot_frame, dot_patterns
from controller.session import costs
from controller.session.calibrating import read_correspondence, read_geometry
from controller.session.dot_shots import (
    check_disk,
    dot_exposure_s,
    of_sinusoids,
    planned,
    read_batches,
    spacing_of,
    take_in_batches,
)
from controller.session.edging import edge_steps, terms_step
from controller.session.modes import DotOptions, mode_step
from controller.session.rig import Rig, RigProjector
from controller.session.runner import Context, Step
from controller.session.shots import Developed
from controller.storage import write_atomically

CLEAR_GAIN: Final = 0.2
"""Of regularity, for which a fitted centre is moved; below it, folds and noise are moved and centres get worse."""
EXPECTED_SPACING_PX: Final = 7
"""For the time left, before the blur is measured."""


def dot_steps(rig: Rig, options: DotOptions, *, longest_exposure_s: float) -> list[Step]:
    """What a mode adds to ``calibration_steps``; for "fast" only the note of the mode."""
    steps: list[Step] = []
    for number, projector in enumerate(rig.projectors):
        if options.mode == "auto":
            steps += edge_steps(rig, projector, options, longest_exposure_s)
        if options.mode == "paper":
            steps.append(capture_step(rig, projector, options, longest_exposure_s))
            steps.append(_fit_step(projector, number, options))
    steps.append(mode_step(options, [step.name for step in steps]))
    return [*steps, terms_step(rig)] if options.mode == "auto" else steps


def capture_step(
    rig: Rig, projector: RigProjector, options: DotOptions, longest_s: float, *, name: str = "dots"
) -> Step:
    """Photograph a projector's dots; ``name``, with the projector's, is that of the step, of its index and its note."""
    return Step(
        f"{name}-{projector.name}",
        partial(_photograph, rig, projector, options, longest_s, f"{name}-{projector.name}"),
        inputs={"longest_exposure_s": repr(longest_s), **options.inputs()},
        after=("exposure", f"pixels-{projector.name}"),
        title=f"Photographing the dots of {projector.name}",
        weight=costs.shot_s(costs.scale([projector.size_px])) * _expected_shots(projector, options),
    )


def _fit_step(projector: RigProjector, number: int, options: DotOptions) -> Step:
    name = projector.name
    return Step(
        f"metapixels-{name}",
        partial(_fit, projector, number),
        inputs=options.inputs(),
        after=("black", f"radiometry-{name}", f"pixels-{name}", "geometry", f"dots-{name}"),
        title=f"Fitting the metapixels of {name} to its dots",
        weight=costs.dots_s(costs.scale([projector.size_px]), _expected_shots(projector, options)),
    )


def _expected_shots(projector: RigProjector, options: DotOptions) -> int:
    return len(dot_patterns(projector.size_px, options.spacing_px or EXPECTED_SPACING_PX))


def _photograph(
    rig: Rig, projector: RigProjector, options: DotOptions, longest_s: float, index: str, context: Context
) -> Sequence[Path]:
    known = of_sinusoids(context.folder, projector.name)
    spacing = spacing_of(options, known)
    patterns = dot_patterns(projector.size_px, spacing)
    check_disk(context.folder, projector, len(patterns))
    exposure_s = dot_exposure_s(rig, context.folder, projector.name, known, longest_s)
    plan = [
        planned(projector, f"{spacing:02d}-{pattern.name}", partial(dot_frame, pattern, projector.size_px), exposure_s)
        for pattern in patterns
    ]
    paths = take_in_batches(rig, context, plan, index=index)
    notes = context.folder / f"{index}.json"
    write_atomically(notes, json.dumps({"spacing_px": spacing, "exposure_s": exposure_s}, indent=1).encode())
    return [notes, *paths]


def _fit(projector: RigProjector, number: int, context: Context) -> Sequence[Path]:
    folder, name = context.folder, projector.name
    light = load_arrays(folder / f"radiometry-{name}.npz")
    spacing = int(json.loads((folder / f"dots-{name}.json").read_text())["spacing_px"])
    patterns = dot_patterns(projector.size_px, spacing)
    listed = read_batches(folder, f"dots-{name}", len(patterns))
    taken = {item.name.removeprefix(f"{name}-{spacing:02d}-"): item for item in listed}
    model = guess_metapixels(modelled_correspondence(read_geometry(folder), number), projector.size_px)
    start = where_missing(guess_metapixels(read_correspondence(folder, name), projector.size_px), model)
    fitted, report = fit_dots(
        Developed(taken, {"black": light["black"]}),
        light["white"],
        start,
        spacing,
        fallback=model,
        progress=lambda share: context.advance(0.95 * share, "dots"),
    )
    found, moves = regularize(fitted, least_gain=CLEAR_GAIN)
    return _save(folder, name, found, report, light["white"], {"spacing_px": spacing, "moved": moves})


def _save(
    folder: Path, name: str, found: Metapixels, report: DotReport, white: FloatImage, figures: Mapping[str, object]
) -> list[Path]:
    why = reasons(found, white)
    path, notes = folder / f"dots-{name}.npz", folder / f"metapixels-{name}.json"
    save_arrays(
        path,
        {
            "centre_px": found.centre_px,
            "covariance_px2": found.covariance_px2,
            "valid": found.valid,
            "reason": why,
        },
    )
    content = {**figures, **asdict(report), "reasons": summary(why)}
    write_atomically(notes, json.dumps(content, indent=1).encode())
    return [path, notes]
