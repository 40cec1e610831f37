"""Photographs of a run: each taken once, journalled by itself, listed in an index that later steps read."""

from __future__ import annotations

import contextlib
import hashlib
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from controller.arrays import ByteImage, FloatImage
from controller.capture.acquire import Shot
from controller.capture.latency import (
    CHANGED_FRAMES,
    LONGEST_S,
    Thumbprint,
    changed_share,
    same_picture,
    thumbprint,
)
from controller.capture.profile import FILE_NAME, CameraProfile, load_profile
from controller.capture.raw import Photograph, read_photograph
from controller.session.camera_watch import CameraWatch
from controller.session.progress import Level
from controller.session.rig import Rig
from controller.session.runner import Context
from controller.storage import write_atomically
from hal.deadline import Cancelled, Deadline, in_seconds
from hal.errors import DeviceError

DELAY_FILE, RAISED = "delay.json", "delay-raised.json"
"""What the step ``delay`` measured, and what proved necessary later: that is no artefact of the step."""
MORE_DELAY_S = 0.1
LOOK_EVERY_S = 30.0
"""After so long the lamps are looked at between two photographs: so much work a lamp that dies costs, at most."""


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
    profile: CameraProfile | None = field(default=None, compare=False, repr=False)
    """What the run has measured of the camera, where it has."""

    def read(self) -> Photograph:
        return read_photograph(self.path, profile=self.profile)

    def per_second(self) -> FloatImage:
        """(rows, columns, 3) float32: full scales per second, NaN where saturated."""
        photograph = self.read()
        image = photograph.image
        image /= np.float32(self.exposure_s)
        image[photograph.saturated] = np.nan
        return image


def take_all(rig: Rig, context: Context, plan: Sequence[Planned], *, index: str) -> list[Path]:
    """Take what is not there yet; return the index file and the photographs.

    A photograph that the journal knows, taken of the same frames with the same exposure, is not taken again.
    """
    folder = context.folder / "captures"
    use_delay(rig, context.folder)
    before: _Before | None = None
    watch = CameraWatch(rig.camera)
    with kept_if_lit(rig, context) as row:
        for number, planned in enumerate(plan):
            context.advance(number / len(plan), planned.name)
            one, before = _take(rig, context, planned, folder, before)
            row.add(one)
            watch.look(context)
    path = context.folder / f"{index}.json"
    listed = [
        {"name": one.name, "path": str(one.path.relative_to(context.folder)), "exposure_s": one.exposure_s}
        for one in row.taken
    ]
    write_atomically(path, json.dumps(listed, indent=1).encode())
    return [path, *(one.path for one in row.taken)]


@dataclass(slots=True)
class Row:
    """Photographs that are taken one after the other, and how many of them have all lamps' light for certain."""

    rig: Rig
    context: Context
    taken: list[Taken] = field(default_factory=list)
    _sure: int = 0
    _looked_at_s: float = field(default_factory=time.monotonic)

    def add(self, one: Taken) -> None:
        """Raises as ``Rig.check_light``: now and then the lamps are looked at, so that none is missed for long."""
        self.taken.append(one)
        if time.monotonic() - self._looked_at_s >= LOOK_EVERY_S:
            self.look(self.context.deadline)

    def look(self, deadline: Deadline) -> None:
        """Look at the lamps; if one is not well, forget the photographs since the last look. Raises as it does."""
        if not any(one.fresh for one in self.taken[self._sure :]):
            return
        try:
            self.rig.check_light(deadline=deadline)
        except Cancelled:
            raise
        except DeviceError:
            for one in self.taken[self._sure :]:
                if one.fresh:
                    one.path.unlink(missing_ok=True)
            del self.taken[self._sure :]
            raise
        self._sure, self._looked_at_s = len(self.taken), time.monotonic()


@contextlib.contextmanager
def kept_if_lit(rig: Rig, context: Context) -> Iterator[Row]:
    """For a row of photographs, added to it as they are taken. If a lamp is not well at its end, those since it was
    last looked at are forgotten, because some may lack its light: also where the row did not end, which may have been
    stopped for that.

    Raises as ``Rig.check_light``. A run that goes on takes the forgotten ones again.
    """
    row = Row(rig, context)
    try:
        yield row
        row.look(context.deadline)
    except BaseException:
        # In a time of its own, and in silence: what ended the row is what the caller has to tell.
        with contextlib.suppress(DeviceError):
            row.look(in_seconds(sum(guard.answer_s for guard in rig.guards)))
        raise


def use_delay(rig: Rig, folder: Path) -> None:
    """Let the acquirer wait as long as the run in ``folder`` has found necessary; nothing before it has."""
    waits = [json.loads(path.read_text())["wait_s"] for path in (folder / DELAY_FILE, folder / RAISED) if path.exists()]
    if waits:
        rig.acquirer.set_delay(max(map(float, waits)))


def inherit_camera(calibrated: Path, folder: Path) -> None:
    """Give the run in ``folder`` what the one in ``calibrated`` measured of its camera and of the stage's delay.

    What the run has measured itself stays.
    """
    for name in (FILE_NAME, DELAY_FILE, RAISED):
        if (calibrated / name).exists() and not (folder / name).exists():
            write_atomically(folder / name, (calibrated / name).read_bytes())


@dataclass(frozen=True, slots=True)
class _Before:
    """The photograph that was taken last: what it should show, and what it shows."""

    frames: Mapping[str, ByteImage]
    shows: Thumbprint


def _take(
    rig: Rig, context: Context, planned: Planned, folder: Path, before: _Before | None
) -> tuple[Taken, _Before | None]:
    frames = rig.on_outputs(planned.frames())
    settings = {"exposure_s": repr(planned.exposure_s), "frames": _digest(frames)}
    known = context.journal.shot(planned.name, settings)
    if known is not None:
        return Taken(planned.name, known.path, confirmed_exposure(known.path)), None
    shot = Shot(planned.name, frames, planned.exposure_s)
    # Each photograph is compared with the one before, so the first of a row has to be right for certain.
    wait_s = max(LONGEST_S, rig.acquirer.wait_s) if rig.acquirer.protected and before is None else None
    file, exposure_s = rig.acquirer.take(shot, folder, deadline=context.deadline, wait_s=wait_s)
    path, shows = file.path, None
    if rig.acquirer.protected:
        shows = thumbprint(path, exposure_s)
        if before is not None and changed_share(before.frames, frames) > CHANGED_FRAMES:
            path, exposure_s, shows = _not_the_one_before(rig, context, shot, (path, exposure_s, shows), before.shows)
    taken = _journalled(context, planned.name, settings, path, exposure_s)
    return taken, _Before(frames, shows) if shows is not None else None


def _not_the_one_before(
    rig: Rig, context: Context, shot: Shot, first: tuple[Path, float, Thumbprint], before: Thumbprint
) -> tuple[Path, float, Thumbprint]:
    """The photograph as it is where it differs from the one before; else one taken long after.

    Where that one differs at last, the pictures have become later than was measured, and from now on more is waited.
    Where it does not, the two pictures look alike to the camera.
    """
    if not same_picture(first[2], before):
        return first
    first[0].unlink()
    file, exposure_s = rig.acquirer.take(
        shot, first[0].parent, deadline=context.deadline, wait_s=max(LONGEST_S, 2 * rig.acquirer.wait_s)
    )
    again = thumbprint(file.path, exposure_s)
    if not same_picture(again, before):
        longer_s = min(rig.acquirer.wait_s + MORE_DELAY_S, LONGEST_S)
        rig.acquirer.set_delay(longer_s)
        write_atomically(context.folder / RAISED, json.dumps({"wait_s": longer_s}).encode())
        context.reporter.say(
            f"Photograph {shot.name} showed the picture before it and was taken again; from now on "
            f"{longer_s:.2f} s are waited for each picture.",
            Level.WARNING,
        )
    return file.path, exposure_s, again


def take_photograph(
    rig: Rig, context: Context, name: str, exposure_s: float, *, shown_at_s: float, of: Mapping[str, str]
) -> Taken:
    """Photograph what is shown since ``shown_at_s``; ``of`` says what that is, for the journal."""
    use_delay(rig, context.folder)
    profile = load_profile(context.folder)
    settings = {"exposure_s": repr(exposure_s), **of}
    known = context.journal.shot(name, settings)
    if known is not None:
        return Taken(name, known.path, confirmed_exposure(known.path), profile=profile)
    file, confirmed_s = rig.acquirer.photograph(
        name, exposure_s, context.folder / "captures", shown_at_s=shown_at_s, deadline=context.deadline
    )
    return replace(_journalled(context, name, settings, file.path, confirmed_s), profile=profile)


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
    profile = load_profile(folder)

    def taken(row: dict[str, Any]) -> Taken:
        told_s = float(row["exposure_s"])
        exposure_s = told_s if profile is None else profile.true_exposure(told_s)
        return Taken(row["name"], folder / row["path"], exposure_s, profile=profile)

    return {row["name"]: taken(row) for row in rows}


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
