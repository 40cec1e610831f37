"""The steps of the automatic mode: dots only where one projector pixel falls on two surfaces."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from controller.arrays import load_arrays, save_arrays
from controller.calibrate.edges import EdgeShares, edge_frame, edge_patterns, edge_pixels, measure_shares
from controller.calibrate.masks import reasons, summary
from controller.session import costs
from controller.session.calibrating import read_calibration, read_correspondence
from controller.session.dot_shots import (
    check_disk,
    dot_exposure_s,
    of_sinusoids,
    planned,
    read_batches,
    spacing_of,
    take_in_batches,
)
from controller.session.modes import DotOptions, mode_of
from controller.session.rig import Rig, RigProjector
from controller.session.runner import Context, Step
from controller.storage import write_atomically
from controller.transport import LightTransport
from controller.transport.edge_terms import edge_term, term_arrays, terms_from, with_terms

TERMS: Final = "edge-terms.npz"
EXPECTED_SHOTS: Final = 36
TYPICAL: Final = 0.5
"""Of the pixels whose blur sets the spacing: no ellipse is fitted here, so a few dots that meet do less harm."""


def edge_steps(rig: Rig, projector: RigProjector, options: DotOptions, longest_exposure_s: float) -> list[Step]:
    """Photograph the pixels at depth edges of one projector, and keep what the camera pixels saw of each."""
    name, scale = projector.name, costs.scale([projector.size_px])
    return [
        Step(
            f"edge-dots-{name}",
            partial(_photograph, rig, projector, options, longest_exposure_s),
            inputs={"longest_exposure_s": repr(longest_exposure_s), **options.inputs()},
            after=("exposure", f"pixels-{name}"),
            title=f"Photographing the depth edges of {name}",
            weight=costs.shot_s(scale) * EXPECTED_SHOTS,
        ),
        Step(
            f"edges-{name}",
            partial(_measure, projector),
            inputs=options.inputs(),
            after=("black", f"radiometry-{name}", f"pixels-{name}", f"edge-dots-{name}"),
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
    check_disk(folder, projector, count)
    exposure_s = dot_exposure_s(rig, folder, name, known, longest_s)
    plan = [
        planned(projector, f"edge-dot-{number:03d}", partial(edge_frame, pattern, number), exposure_s)
        for number in range(count)
    ]
    paths = take_in_batches(rig, context, plan, index=f"edge-dots-{name}")
    shown, notes = folder / f"edge-dots-{name}.npz", folder / f"edge-dots-{name}.json"
    save_arrays(shown, {"pattern": pattern})
    content = {"spacing_px": spacing, "exposure_s": exposure_s, "photographs": count}
    write_atomically(notes, json.dumps(content, indent=1).encode())
    return [shown, notes, *paths]


def _measure(projector: RigProjector, context: Context) -> Sequence[Path]:
    folder, name = context.folder, projector.name
    light = load_arrays(folder / f"radiometry-{name}.npz")
    pattern = load_arrays(folder / f"edge-dots-{name}.npz")["pattern"]
    notes = json.loads((folder / f"edge-dots-{name}.json").read_text())
    position = read_correspondence(folder, name).projector_px
    count, reach = int(notes["photographs"]), (int(notes["spacing_px"]) - 1) // 2
    parts = [(np.empty(0, np.int32), np.empty(0, np.int32), np.empty(0, np.float32))]
    for number, item in enumerate(read_batches(folder, f"edge-dots-{name}", count)):
        context.advance(number / count, item.name)
        lit = np.asarray(pattern == number)
        parts.append(measure_shares(item.per_second(), light["black"], light["white"], position, lit, reach))
    camera, at, share = (np.concatenate(column) for column in zip(*parts, strict=True))
    why = reasons(of_sinusoids(folder, name), light["white"])
    path, figures = folder / f"edges-{name}.npz", folder / f"edges-{name}.json"
    save_arrays(path, {"camera": camera, "projector": at, "share": share, "pattern": pattern, "reason": why})
    content = {
        **notes,
        "edge_pixels": int(np.count_nonzero(pattern >= 0)),
        "shares": int(share.size),
        "reasons": summary(why),
    }
    write_atomically(figures, json.dumps(content, indent=1).encode())
    return [path, figures]


def terms_step(rig: Rig) -> Step:
    """Compare what was measured with what the transport's model says, once, so that no solve has to."""
    names = [projector.name for projector in rig.projectors]
    return Step(
        "edge-terms",
        partial(_compare, names),
        after=tuple(f"{step}-{name}" for name in names for step in ("radiometry", "pixels", "edges")),
        title="Correcting the light transport at depth edges",
        weight=3 * costs.scale(projector.size_px for projector in rig.projectors),
    )


def _compare(names: Sequence[str], context: Context) -> Sequence[Path]:
    calibration = read_calibration(context.folder, names)
    model = LightTransport.build(calibration)
    terms = []
    for n, (part, measured) in enumerate(zip(calibration.projectors, read_edges(context.folder, names), strict=True)):
        context.advance(n / len(names), part.name)
        terms.append(edge_term(model, n, measured, part.white))
    path = context.folder / TERMS
    save_arrays(path, term_arrays(terms))
    return [path]


def edged(model: LightTransport, folder: Path) -> LightTransport:
    """The run's transport: ``model``, with what dots say at depth edges where the automatic mode has measured them."""
    if mode_of(folder) != "auto" or not (folder / TERMS).exists():
        return model
    return with_terms(model, terms_from(load_arrays(folder / TERMS), model.sizes))


def read_edges(folder: Path, projectors: Sequence[str]) -> tuple[EdgeShares, ...]:
    """What the steps ``edges-NAME`` measured at the depth edges of each projector."""
    found = []
    for name in projectors:
        arrays = load_arrays(folder / f"edges-{name}.npz")
        found.append(EdgeShares(arrays["camera"], arrays["projector"], arrays["share"], arrays["pattern"]))
    return tuple(found)
