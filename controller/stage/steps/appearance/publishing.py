"""The step from solved frames to a signed, installed bundle, with a small picture of each appearance."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from controller.bundle.describe import png
from controller.bundle.format import Index, PlaylistEntry
from controller.bundle.install import current, install, revision_floor
from controller.bundle.reader import Bundle
from controller.bundle.signing import ANY_SIGNER, Trust, load_signing_key, unsigned_warning
from controller.bundle.writer import NewAppearance, NewBundle, write_bundle
from controller.config import load_stage
from controller.config.loader import FILE
from controller.core.arrays import ByteImage, Float64, FloatImage
from controller.core.colour import linear_to_srgb
from controller.core.errors import BundleError
from controller.core.storage import sha256_of
from controller.run.progress import Reporter
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.projectors import Light
from controller.stage.artefacts.published import BUNDLE, BundleFigures, read_thumbnail, write_thumbnail
from controller.stage.artefacts.solved import is_solved, read_solved
from hal.notices import Level

METADATA = ("title", "exposure", "reachable_share")
"""Figures of the solve that a bundle contains; all are the same in a repeated solve."""
SHOWN_MS = (15_000, 1_000)
"""Show and fade times in the bundle's playlist for appearances without times in stage.toml."""


Outputs = Mapping[str, tuple[str, tuple[int, int]]]
"""Output name and (width, height) by projector name."""


@dataclass(frozen=True, slots=True)
class BundleTarget:
    """For which stage a bundle of solved appearances is, how it is signed, and where it is installed.

    Parameters
    ----------
    folder : the stage's folder
    stage, calibration : names of the stage, and of the run with its calibration
    outputs : by projector, its output and the size
    key : the signing key's file (its public half beside it), or None for an unsigned bundle
    trust : which installed bundles count for the revision
    """

    folder: Path
    stage: str
    calibration: str
    outputs: Outputs
    key: Path | None
    trust: Trust = ANY_SIGNER

    @property
    def slots(self) -> Path:
        """The stage's folder of installed bundles."""
        return self.folder / "bundles"


def publish_step(
    target: BundleTarget, names: Sequence[str], *, after: Sequence[StepId] = (), calibrated: Calibrated | None = None
) -> Step:
    """Write, sign and install the bundle of these appearances; the artefacts are the bundle and its figures.

    The bundle also holds other appearances solved on the calibration: see ``kept_names``. Publishing is cheap, and the
    content depends on more than its own steps, so every run repeats it; unchanged content gives the same bytes.

    ``after``: the steps of this run that make the frames; ``calibrated``: what reads the run, where the caller needs it
    too
    """
    return Step(
        StepId(StepKind.PUBLISH),
        partial(_publish, target, tuple(names), calibrated),
        inputs={"names": " ".join(names), "key": "" if target.key is None else sha256_of(target.key)},
        after=tuple(after),
        title="Publishing the signed bundle",
        weight=1,
        always=True,
    )


def _publish(
    target: BundleTarget, names: Sequence[str], calibrated: Calibrated | None, context: Context
) -> Sequence[Path]:
    built = context.folder / BUNDLE
    names = kept_names(target.folder, context.folder, names)
    _report_dropped(target.slots, names, context.reporter)
    trusted = () if target.key is None else (bytes(load_signing_key(target.key).verify_key),)
    if (warning := unsigned_warning(trusted[0] if trusted else None, Trust(trusted, not trusted))) is not None:
        context.reporter.say(f"{warning.what} {warning.remedy}", Level.WARNING)
    index = publish_solved(built, context.folder, target, names, live=_holds_live(target.slots), calibrated=calibrated)
    installed = install(built, target.slots, trusted=trusted, allow_unsigned=target.key is None)
    raw = sum(3 * width * height for _, (width, height) in target.outputs.values()) * len(names)
    stored = sum(
        blob.length for appearance in index.appearances for blobs in appearance.bands.values() for blob in blobs
    )
    figures = BundleFigures(built.stat().st_size, raw / stored, installed.name, names)
    return [figures.write(context.folder), built]


def _report_dropped(slots: Path, names: Sequence[str], reporter: Reporter) -> None:
    """Report appearances of the installed bundle that the new one lacks, because they have another calibration."""
    dropped = [
        appearance.name
        for index in _installed(slots)
        for appearance in index.appearances
        if appearance.name not in names
    ]
    if dropped:
        several = len(dropped) > 1
        reporter.say(
            f"The bundle no longer holds {', '.join(dropped)}: {'they were' if several else 'it was'} made for an"
            f" earlier calibration. `velatura appearance STAGE` makes {'them' if several else 'it'} again.",
            Level.WARNING,
        )


def kept_names(stage_folder: Path, run: Path, names: Sequence[str]) -> tuple[str, ...]:
    """``names``, and other appearances solved in ``run`` that stage.toml or the installed bundle names.

    In stage.toml's order, then as installed, then as given. Appearances of another calibration are dropped: their
    frames do not fit.
    """
    listed = []
    if (stage_folder / FILE).exists():
        listed += [table.name for table in load_stage(stage_folder).tables.appearances]
    listed += [appearance.name for index in _installed(stage_folder / "bundles") for appearance in index.appearances]
    solved = [name for name in listed if name in names or is_solved(run, name)]
    return tuple(dict.fromkeys([*solved, *names]))


def hints_ms(stage_folder: Path) -> dict[str, tuple[int, int]]:
    """(shown, fade) in milliseconds of each appearance of the stage.toml in this folder; empty if there is none."""
    if not (stage_folder / FILE).exists():
        return {}
    return {table.name: table.hint_ms for table in load_stage(stage_folder).tables.appearances}


def _installed(slots: Path) -> list[Index]:
    """The names in the current bundle of the folder ``slots``; empty if none can be read."""
    file = current(slots)
    with contextlib.suppress(BundleError):
        if file is not None:
            with Bundle.open_trusted(file, ANY_SIGNER) as bundle:
                return [bundle.index]
    return []


def _holds_live(slots: Path) -> bool:
    return any(index.live is not None for index in _installed(slots))


def publish_solved(
    path: Path,
    run: Path,
    target: BundleTarget,
    names: Sequence[str],
    *,
    live: bool = False,
    check: Callable[[], None] = lambda: None,
    calibrated: Calibrated | None = None,
) -> Index:
    """Write the solved appearances of the folder ``run`` to a bundle at ``path``, signed with the target's key.

    If the stage has the same bundle installed, the file is identical to it. Otherwise its revision is one above those
    installed bundles that ``target.trust`` accepts. ``live``: include the live-mode data.
    ``check`` is called before each appearance and may raise to stop the work. ``calibrated``: what reads ``run``, else
    it is read here where a thumbnail is missing.
    Raises WorkError("appearance-not-solved") and what ``write_bundle`` raises; ``path`` is then unchanged or intact.
    """
    from controller.stage.steps.appearance.live_parts import live_arrays

    outputs, hints = target.outputs, hints_ms(target.folder)
    new = NewBundle(
        target.stage,
        target.calibration,
        created_unix_s(run),
        [(output, *size) for output, size in outputs.values()],
        schedule=[PlaylistEntry(name, *hints.get(name, SHOWN_MS)) for name in names],
        live=live_arrays(run, outputs) if live else None,
    )

    def write(revision: int) -> Index:
        return write_bundle(
            path,
            replace(new, revision=revision),
            _appearances(calibrated or Calibrated(run, tuple(outputs)), outputs, names, check),
            key=None if target.key is None else load_signing_key(target.key),
        )

    floor = revision_floor(target.slots, target.trust)
    if floor >= 0:
        index = write(floor)
        if (target.slots / f"{sha256_of(path)}.vel").exists():
            return index
    return write(floor + 1)


def _appearances(
    calibrated: Calibrated, outputs: Outputs, names: Sequence[str], check: Callable[[], None]
) -> Iterator[NewAppearance]:

    thumbnails = Thumbnails(calibrated)
    for name in names:
        check()
        solved = read_solved(calibrated.folder, name, tuple(outputs))
        frames = {outputs[projector][0]: frame for projector, frame in solved.frames.items()}
        metadata = {key: solved.figures[key] for key in METADATA if key in solved.figures}
        yield NewAppearance(name, frames, thumbnails.of(name), metadata)


def created_unix_s(run: Path) -> int:
    """Start time of the calibration in the folder ``run``, so that publishing again gives the same bytes.

    The environment's SOURCE_DATE_EPOCH takes precedence; 0 if neither is known.
    """
    given = os.environ.get("SOURCE_DATE_EPOCH", "")
    if given.isascii() and given.isdigit() and int(given) <= 2**53:
        return int(given)
    try:
        return max(0, int(time.mktime(time.strptime(run.name[:15], "%Y%m%d-%H%M%S"))))
    except (ValueError, OverflowError):
        return 0


LONGEST_PX: Final = 160
_XYZ_TO_SRGB: Final = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
"""IEC 61966-2-1, linear part."""


class Thumbnails:
    """Makes the thumbnails of a run's appearances, and keeps them in the run's folder until they are solved again.

    The first thumbnail that is not stored yet needs the light transport of ``calibrated``, whose run it is.
    """

    def __init__(self, calibrated: Calibrated) -> None:
        self._calibrated = calibrated
        self._folder, self._projectors = calibrated.folder, calibrated.projectors

    def of(self, name: str) -> bytes | None:
        """The PNG file of a solved appearance of the run; None if its calibration is not in the run."""
        if (kept := read_thumbnail(self._folder, name)) is not None:
            return kept
        if not all(Light.path(self._folder, projector).exists() for projector in self._projectors):
            return None
        data = self._made(name)
        write_thumbnail(self._folder, name, data)
        return data

    def _made(self, name: str) -> bytes:
        calibration = self._calibrated.calibration
        solved = read_solved(self._folder, name, self._projectors)
        seen = self._calibrated.predicted_light([solved.linear[projector] for projector in self._projectors])
        return png(thumbnail(seen + calibration.black, calibration.camera_to_xyz, white=solved.exposure))


def thumbnail(picture: FloatImage, camera_to_xyz: Float64, *, white: float) -> ByteImage:
    """A linear camera picture (rows, columns, 3) as sRGB of at most ``LONGEST_PX`` per side.

    ``white``: the camera value for the screen's white; ``camera_to_xyz`` (3, 3): equal values are D65 grey.
    """
    rows, columns = picture.shape[:2]
    part = min(1.0, LONGEST_PX / max(rows, columns))
    size = max(1, round(columns * part)), max(1, round(rows * part))
    small = np.asarray(cv2.resize(np.nan_to_num(picture), size, interpolation=cv2.INTER_AREA), np.float32)
    matrix = _XYZ_TO_SRGB @ camera_to_xyz
    matrix = (matrix / matrix.sum(axis=1, keepdims=True)).astype(np.float32)
    return np.asarray(np.rint(255 * linear_to_srgb(small @ matrix.T / np.float32(white))), np.uint8)
