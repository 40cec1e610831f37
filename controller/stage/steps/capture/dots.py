"""Photographs of dots for the paper's mode: exposure, batches, disk space."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from controller.core.arrays import ByteImage
from controller.core.errors import WorkError
from controller.optics.calibrate.metapixels.from_dots import largest_sigma_px, peak_share
from controller.optics.calibrate.values import Metapixels
from controller.optics.capture.patterns import PAPER_SPACING_PX, dot_spacing
from controller.run.runner import Context
from controller.stage.artefacts.camera import Exposures
from controller.stage.artefacts.photographs import PhotographSet, TakenPhotograph, captured, codes_of
from controller.stage.artefacts.projectors import Pixels
from controller.stage.rig.rig import Rig, RigProjector
from controller.stage.steps.capture.exposure import bracket
from controller.stage.steps.capture.photographs import Planned, take_all
from controller.stage.steps.modes import DotOptions

BATCH: Final = 16
"""Photographs between two checks of the lamps: so many are lost if one went off."""
SPARE_BYTES: Final = 500_000_000
MOST_LIGHT: Final = 0.8
"""Peak of a sharp dot, relative to well-exposed white."""
LONGEST_GAIN: Final = 16.0


def of_sinusoids(folder: Path, projector: str) -> Metapixels:
    """The metapixels of a projector from its sinusoids."""
    return Pixels.read(folder, projector).metapixels


def spacing_of(options: DotOptions, known: Metapixels) -> int:
    """The dots' spacing: as given, or r >= 6.5 sigma for the blur of 95 % of the pixels, at most 16."""
    return options.spacing_px or min(dot_spacing(largest_sigma_px(known)), PAPER_SPACING_PX)


def dot_exposure_s(rig: Rig, folder: Path, projector: str, known: Metapixels, longest_s: float) -> float:
    """Exposure for dots: longer than for white, because a dot is fainter."""
    gain = float(np.clip(MOST_LIGHT / peak_share(known), 1.0, LONGEST_GAIN))
    base_s = Exposures.read(folder)[projector].base_s
    return bracket(base_s, (gain,), rig.acquirer.exposures_s(), longest_s)[0]


def planned(projector: RigProjector, name: str, frame: Callable[[], ByteImage], exposure_s: float) -> Planned:
    """A photograph of one projector alone."""
    return Planned(name, lambda: {projector.name: frame()}, exposure_s)


def take_in_batches(rig: Rig, context: Context, plan: Sequence[Planned], *, into: PhotographSet) -> list[Path]:
    """``take_all`` with a check of the lamps every few photographs, in batches of the set."""
    paths: list[Path] = []
    for number, start in enumerate(range(0, len(plan), BATCH)):
        batch = plan[start : start + BATCH]
        part = partial(_part, context, start / len(plan), len(batch) / len(plan))
        inner = dataclasses.replace(context, _advance=part)
        paths += take_all(rig, inner, batch, into=dataclasses.replace(into, batch=number))
    return paths


def _part(context: Context, start: float, share: float, fraction: float, note: str) -> None:
    context.advance(start + share * fraction, note)


def read_batches(folder: Path, of: PhotographSet, photographs: int) -> Iterator[TakenPhotograph]:
    """The photographs that ``take_in_batches`` listed, in order."""
    for number in range(-(-photographs // BATCH)):
        yield from dataclasses.replace(of, batch=number).read(folder)


def check_disk(folder: Path, into: PhotographSet, photographs: int) -> None:
    """Raise WorkError("no-space") before the first of hundreds of photographs of a projector."""
    assert into.projector is not None
    first = codes_of(into.projector).read(folder)[0]
    bytes_each = first.path.stat().st_size
    needed = max(photographs - captured(folder, into), 0) * bytes_each + SPARE_BYTES
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise WorkError(
            "no-space",
            what=f"{photographs} photographs of dots need {needed / 1e9:.1f} GB; {free / 1e9:.1f} GB are free.",
            remedy="Remove old runs of the stage, or calibrate with --dot-spacing auto or --mode fast.",
        )
