"""Photographs of dots, as the paper's mode and the automatic one take them: long enough, in batches, where they fit."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from controller.arrays import ByteImage, load_arrays
from controller.calibrate.dots import largest_sigma_px, peak_share
from controller.calibrate.values import Metapixels
from controller.capture.dots import PAPER_SPACING_PX, dot_spacing
from controller.errors import WorkError
from controller.session.capturing import bracket, exposures_of
from controller.session.modes import DotOptions
from controller.session.rig import Rig, RigProjector
from controller.session.runner import Context
from controller.session.shots import Planned, Taken, read_index, take_all

BATCH: Final = 16
"""Photographs between two looks at the lamps: so many are lost when one went off."""
SPARE_BYTES: Final = 500_000_000
MOST_LIGHT: Final = 0.8
"""Of the light at which white is well exposed, where a sharp dot is brightest."""
LONGEST_GAIN: Final = 16.0


def of_sinusoids(folder: Path, projector: str) -> Metapixels:
    """The metapixels that the step ``pixels-NAME`` left."""
    arrays = load_arrays(folder / f"pixels-{projector}.npz")
    return Metapixels(arrays["centre_px"], arrays["covariance_px2"], arrays["valid"])


def spacing_of(options: DotOptions, known: Metapixels, *, share: float = 0.95) -> int:
    """The dots' spacing: as asked for, or r >= 6.5 sigma by the blur of a ``share`` of pixels, at most 16."""
    return options.spacing_px or min(dot_spacing(largest_sigma_px(known, share)), PAPER_SPACING_PX)


def dot_exposure_s(rig: Rig, folder: Path, projector: str, known: Metapixels, longest_s: float) -> float:
    """As much longer than for white as a dot is fainter, so that its light does not drown in noise."""
    gain = float(np.clip(MOST_LIGHT / peak_share(known), 1.0, LONGEST_GAIN))
    base_s = exposures_of(folder)[projector].base_s
    return bracket(base_s, (gain,), rig.acquirer.exposures_s(), longest_s)[0]


def planned(projector: RigProjector, name: str, frame: Callable[[], ByteImage], exposure_s: float) -> Planned:
    """A photograph of one projector alone."""
    return Planned(f"{projector.name}-{name}", lambda: {projector.name: frame()}, exposure_s)


def take_in_batches(rig: Rig, context: Context, plan: Sequence[Planned], *, index: str) -> list[Path]:
    """``take_all`` with a look at the lamps every few photographs; the indices are named ``INDEX-000``.. ."""
    paths: list[Path] = []
    for number, start in enumerate(range(0, len(plan), BATCH)):
        batch = plan[start : start + BATCH]
        part = partial(_part, context, start / len(plan), len(batch) / len(plan))
        inner = dataclasses.replace(context, _advance=part)
        paths += take_all(rig, inner, batch, index=f"{index}-{number:03d}")
    return paths


def _part(context: Context, start: float, share: float, fraction: float, note: str) -> None:
    context.advance(start + share * fraction, note)


def read_batches(folder: Path, index: str, photographs: int) -> Iterator[Taken]:
    """The photographs that ``take_in_batches`` listed, in order."""
    for number in range(-(-photographs // BATCH)):
        yield from read_index(folder, f"{index}-{number:03d}").values()


def check_disk(folder: Path, projector: RigProjector, photographs: int) -> None:
    """Raise WorkError("no-space") before the first of hundreds of photographs, not at the last."""
    first = next(iter(read_index(folder, f"codes-{projector.name}").values()))
    bytes_each = first.path.stat().st_size
    there = sum(1 for path in (folder / "captures").glob(f"{projector.name}-*dot-*") if path.suffix != ".json")
    needed = max(photographs - there, 0) * bytes_each + SPARE_BYTES
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise WorkError(
            "no-space",
            what=f"{photographs} photographs of dots need {needed / 1e9:.1f} GB; {free / 1e9:.1f} GB are free.",
            remedy="Remove old runs of the stage, or calibrate with --dot-spacing auto or --mode fast.",
        )
