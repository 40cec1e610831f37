"""Photographs of a run: each taken once, journalled by itself, listed in an index that later steps read."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from controller.arrays import ByteImage, FloatImage
from controller.capture.acquire import Shot
from controller.capture.raw import Photograph, read_photograph
from controller.session.rig import Rig
from controller.session.runner import Context
from controller.storage import write_atomically
from hal.deadline import Cancelled
from hal.errors import DeviceError


@dataclass(frozen=True, slots=True)
class Planned:
    """A photograph to be taken: ``frames`` by projector name, made when they are needed; the others are black."""

    name: str
    frames: Callable[[], Mapping[str, ByteImage]]
    exposure_s: float


@dataclass(frozen=True, slots=True)
class Taken:
    """A photograph on disk, with the exposure that the camera confirmed.

    ``fresh``: it was taken just now, not by an earlier run.
    """

    name: str
    path: Path
    exposure_s: float
    fresh: bool = False

    def read(self) -> Photograph:
        return read_photograph(self.path)

    def per_second(self) -> FloatImage:
        """(rows, columns, 3) float32: full scales per second, NaN where saturated."""
        image: FloatImage = self.read().measured() / np.float32(self.exposure_s)
        return image


def take_all(rig: Rig, context: Context, plan: Sequence[Planned], *, index: str) -> list[Path]:
    """Take what is not there yet; return the index file and the photographs.

    A photograph that the journal knows, taken of the same frames with the same exposure, is not taken again.
    """
    folder = context.folder / "captures"
    taken = []
    for number, planned in enumerate(plan):
        context.advance(number / len(plan), planned.name)
        taken.append(_take(rig, context, planned, folder))
    keep_if_lit(rig, context, taken)
    path = context.folder / f"{index}.json"
    rows = [
        {"name": t.name, "path": str(t.path.relative_to(context.folder)), "exposure_s": t.exposure_s} for t in taken
    ]
    write_atomically(path, json.dumps(rows, indent=1).encode())
    return [path, *(t.path for t in taken)]


def keep_if_lit(rig: Rig, context: Context, taken: Sequence[Taken]) -> None:
    """Look at the lamps after photographs were taken; if one is not well, forget them: some may lack its light.

    Raises as ``Rig.check_light``. A run that goes on takes the forgotten ones again.
    """
    fresh = [one.path for one in taken if one.fresh]
    if not fresh:
        return
    try:
        rig.check_light(deadline=context.deadline)
    except Cancelled:
        raise
    except DeviceError:
        for path in fresh:
            path.unlink(missing_ok=True)
        raise


def _take(rig: Rig, context: Context, planned: Planned, folder: Path) -> Taken:
    frames = rig.on_outputs(planned.frames())
    settings = {"exposure_s": repr(planned.exposure_s), "frames": _digest(frames)}
    known = context.journal.shot(planned.name, settings)
    if known is not None:
        return Taken(planned.name, known.path, confirmed_exposure(known.path))
    shot = Shot(planned.name, frames, planned.exposure_s)
    file, exposure_s = rig.acquirer.take(shot, folder, deadline=context.deadline)
    return _journalled(context, planned.name, settings, file.path, exposure_s)


def take_photograph(
    rig: Rig, context: Context, name: str, exposure_s: float, *, shown_at_s: float, of: Mapping[str, str]
) -> Taken:
    """Photograph what is shown since ``shown_at_s``; ``of`` says what that is, for the journal."""
    settings = {"exposure_s": repr(exposure_s), **of}
    known = context.journal.shot(name, settings)
    if known is not None:
        return Taken(name, known.path, confirmed_exposure(known.path))
    file, confirmed_s = rig.acquirer.photograph(
        name, exposure_s, context.folder / "captures", shown_at_s=shown_at_s, deadline=context.deadline
    )
    return _journalled(context, name, settings, file.path, confirmed_s)


def _journalled(context: Context, name: str, settings: Mapping[str, str], path: Path, exposure_s: float) -> Taken:
    write_atomically(_note_of(path), json.dumps({"exposure_s": exposure_s}).encode())
    artefact = context.journal.record_shot(name, settings, path)
    return Taken(name, artefact.path, exposure_s, fresh=True)


def _note_of(photograph: Path) -> Path:
    return photograph.with_suffix(".json")


def confirmed_exposure(photograph: Path) -> float:
    """The exposure that the camera confirmed for a photograph, from the note beside it, in seconds."""
    return float(json.loads(_note_of(photograph).read_text())["exposure_s"])


def _digest(frames: Mapping[str, ByteImage]) -> str:
    digest = hashlib.sha256()
    for output in sorted(frames):
        digest.update(f"{output} {frames[output].shape} ".encode())
        digest.update(np.ascontiguousarray(frames[output]).tobytes())
    return digest.hexdigest()


def read_index(folder: Path, index: str) -> dict[str, Taken]:
    """The photographs that ``take_all`` listed, by name, in the order in which they were taken."""
    rows = json.loads((folder / f"{index}.json").read_text())
    return {row["name"]: Taken(row["name"], folder / row["path"], float(row["exposure_s"])) for row in rows}


class Developed(Mapping[str, FloatImage]):
    """Photographs by pattern name, in full scales per second, read each time they are asked for.

    ``ready`` holds images that are there already (HDR black and white) and go before the photographs.
    """

    def __init__(self, taken: Mapping[str, Taken], ready: Mapping[str, FloatImage]) -> None:
        self._taken = taken
        self._ready = ready

    def __getitem__(self, name: str) -> FloatImage:
        if name in self._ready:
            return self._ready[name]
        return self._taken[name].per_second()

    def __iter__(self) -> Iterator[str]:
        yield from self._ready
        yield from (name for name in self._taken if name not in self._ready)

    def __len__(self) -> int:
        return sum(1 for _ in self)
