"""The steps of the paper's mode: photographs of dots, and the metapixels that they give (paper 4.1, 4.2)."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from controller.arrays import ByteImage, FloatImage, load_arrays, save_arrays
from controller.calibrate.dots import DotReport, fit_dots, largest_sigma_px, peak_share
from controller.calibrate.guess import guess_metapixels, modelled_correspondence, where_missing
from controller.calibrate.masks import reasons, summary
from controller.calibrate.regularize import regularize
from controller.calibrate.values import Metapixels
from controller.capture.dots import PAPER_SPACING_PX, DotPattern, dot_frame, dot_patterns, dot_spacing
from controller.errors import WorkError
from controller.session import costs
from controller.session.calibrating import read_correspondence, read_geometry
from controller.session.capturing import bracket, exposures_of
from controller.session.modes import DotOptions, mode_step
from controller.session.rig import Rig, RigProjector
from controller.session.runner import Context, Step
from controller.session.shots import Developed, Planned, Taken, read_index, take_all
from controller.storage import write_atomically

BATCH: Final = 16
"""Photographs between two looks at the lamps: so many are lost when one went off."""
SPARE_BYTES: Final = 500_000_000
EXPECTED_SPACING_PX: Final = 7
"""For the time left, before the blur is measured."""
MOST_LIGHT: Final = 0.8
"""Of full scale, where a sharp dot is brightest."""
LONGEST_GAIN: Final = 16.0


def dot_steps(rig: Rig, options: DotOptions, *, longest_exposure_s: float) -> list[Step]:
    """What a mode adds to ``calibration_steps``; for "fast" only the note of the mode."""
    steps: list[Step] = []
    if options.mode == "paper":
        for number, projector in enumerate(rig.projectors):
            steps.append(_capture_step(rig, projector, options, longest_exposure_s))
            steps.append(_fit_step(rig, projector, number, options))
    return [*steps, mode_step(options, [step.name for step in steps])]


def _capture_step(rig: Rig, projector: RigProjector, options: DotOptions, longest_s: float) -> Step:
    spacing = options.spacing_px or EXPECTED_SPACING_PX
    shots = len(dot_patterns(projector.size_px, spacing))
    return Step(
        f"dots-{projector.name}",
        partial(_photograph, rig, projector, options, longest_s),
        inputs={"longest_exposure_s": repr(longest_s), **options.inputs()},
        after=("exposure", f"pixels-{projector.name}"),
        title=f"Photographing the dots of {projector.name}",
        weight=costs.shot_s(costs.scale([projector.size_px])) * shots,
    )


def _fit_step(rig: Rig, projector: RigProjector, number: int, options: DotOptions) -> Step:
    scale = costs.scale([projector.size_px])
    shots = len(dot_patterns(projector.size_px, options.spacing_px or EXPECTED_SPACING_PX))
    return Step(
        f"metapixels-{projector.name}",
        partial(_fit, projector, number),
        inputs=options.inputs(),
        after=(
            "black",
            f"radiometry-{projector.name}",
            f"pixels-{projector.name}",
            "geometry",
            f"dots-{projector.name}",
        ),
        title=f"Fitting the metapixels of {projector.name} to its dots",
        weight=costs.dots_s(scale, shots),
    )


def _photograph(
    rig: Rig, projector: RigProjector, options: DotOptions, longest_s: float, context: Context
) -> Sequence[Path]:
    known = _of_sinusoids(context.folder, projector.name)
    spacing = options.spacing_px or min(dot_spacing(largest_sigma_px(known)), PAPER_SPACING_PX)
    patterns = dot_patterns(projector.size_px, spacing)
    _check_disk(context.folder, projector, len(patterns))
    base_s = exposures_of(context.folder)[projector.name].base_s
    gain = float(np.clip(MOST_LIGHT / peak_share(known), 1.0, LONGEST_GAIN))
    exposure_s = bracket(base_s, (gain,), rig.acquirer.exposures_s(), longest_s)[0]
    planned = [_planned(projector, pattern, exposure_s) for pattern in patterns]
    paths = take_in_batches(rig, context, planned, index=f"dots-{projector.name}")
    plan = context.folder / f"dots-{projector.name}.json"
    write_atomically(plan, json.dumps({"spacing_px": spacing, "exposure_s": exposure_s}, indent=1).encode())
    return [plan, *paths]


def _planned(projector: RigProjector, pattern: DotPattern, exposure_s: float) -> Planned:
    def frames() -> Mapping[str, ByteImage]:
        return {projector.name: dot_frame(pattern, projector.size_px)}

    return Planned(f"{projector.name}-{pattern.spacing_px:02d}-{pattern.name}", frames, exposure_s)


def take_in_batches(rig: Rig, context: Context, planned: Sequence[Planned], *, index: str) -> list[Path]:
    """``take_all`` with a look at the lamps every few photographs; the indices are named ``INDEX-000``.. ."""
    paths: list[Path] = []
    for number, start in enumerate(range(0, len(planned), BATCH)):
        batch = planned[start : start + BATCH]
        part = partial(_part, context, start / len(planned), len(batch) / len(planned))
        inner = dataclasses.replace(context, _advance=part)
        paths += take_all(rig, inner, batch, index=f"{index}-{number:03d}")
    return paths


def _part(context: Context, start: float, share: float, fraction: float, note: str) -> None:
    context.advance(start + share * fraction, note)


def read_batches(folder: Path, index: str, photographs: int) -> Iterator[Taken]:
    """The photographs that ``take_in_batches`` listed, in order."""
    for number in range(-(-photographs // BATCH)):
        yield from read_index(folder, f"{index}-{number:03d}").values()


def _check_disk(folder: Path, projector: RigProjector, photographs: int) -> None:
    """Raise WorkError("no-space") before the first of hundreds of photographs, not at the last."""
    first = next(iter(read_index(folder, f"codes-{projector.name}").values()))
    needed, free = photographs * first.path.stat().st_size + SPARE_BYTES, shutil.disk_usage(folder).free
    taken = sum(1 for _ in (folder / "captures").glob(f"{projector.name}-*-dot-*"))
    if free + taken * first.path.stat().st_size < needed:
        raise WorkError(
            "no-space",
            what=f"{photographs} photographs of dots need {needed / 1e9:.1f} GB; {free / 1e9:.1f} GB are free.",
            remedy="Remove old runs of the stage, or calibrate with --dot-spacing auto or --mode fast.",
        )


def _of_sinusoids(folder: Path, projector: str) -> Metapixels:
    arrays = load_arrays(folder / f"pixels-{projector}.npz")
    return Metapixels(arrays["centre_px"], arrays["covariance_px2"], arrays["valid"])


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
    found, moves = regularize(fitted)
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
