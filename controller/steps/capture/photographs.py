"""Photographs of a run: each taken once, journalled by itself, listed in an index that later steps read."""

from __future__ import annotations

import contextlib
import hashlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from controller.artefacts.camera import longest_wait_s, raise_delay
from controller.artefacts.photographs import (
    PhotographSet,
    Taken,
    capture_name,
    captures_folder,
    read_exposure,
    write_exposure,
)
from controller.capture.acquire import Shot
from controller.capture.latency import (
    CHANGED_FRAMES,
    LONGEST_S,
    Thumbprint,
    changed_share,
    same_picture,
    thumbprint,
)
from controller.capture.profile import load_profile
from controller.core.arrays import ByteImage
from controller.rig.camera_watch import CameraWatch
from controller.rig.rig import Rig
from controller.run.progress import Level
from controller.run.runner import Context
from controller.run.step_id import ShotId
from hal.deadline import Cancelled, Deadline, in_seconds
from hal.errors import DeviceError

MORE_DELAY_S = 0.1
LOOK_EVERY_S = 30.0
"""After so long the lamps are looked at between two photographs: so much work a lamp that dies costs, at most."""


@dataclass(frozen=True, slots=True)
class Planned:
    """A photograph to be taken: ``frames`` by projector name, made when they are needed; the others are black.

    ``projector``: the one that shines alone, where the set is not already of one
    """

    name: str
    frames: Callable[[], Mapping[str, ByteImage]]
    exposure_s: float
    projector: str | None = None


def take_all(rig: Rig, context: Context, plan: Sequence[Planned], *, into: PhotographSet) -> list[Path]:
    """Take what is not there yet; return the index file and the photographs.

    A photograph that the journal knows, taken of the same frames with the same exposure, is not taken again.
    """
    use_delay(rig, context.folder)
    before: _Before | None = None
    watch = CameraWatch(rig.camera)
    with kept_if_lit(rig, context) as row:
        for number, planned in enumerate(plan):
            context.advance(number / len(plan), planned.name)
            one, before = _take(rig, context, planned, into.shot(planned.name, planned.projector), before)
            row.add(one)
            watch.look(context)
    return [into.write(context.folder, row.taken), *(one.path for one in row.taken)]


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
    wait_s = longest_wait_s(folder)
    if wait_s is not None:
        rig.acquirer.set_delay(wait_s)


@dataclass(frozen=True, slots=True)
class _Before:
    """The photograph that was taken last: what it should show, and what it shows."""

    frames: Mapping[str, ByteImage]
    shows: Thumbprint


def _take(
    rig: Rig, context: Context, planned: Planned, identity: ShotId, before: _Before | None
) -> tuple[Taken, _Before | None]:
    frames = rig.on_outputs(planned.frames())
    settings = {"exposure_s": repr(planned.exposure_s), "frames": _digest(frames)}
    known = context.journal.shot(identity, settings)
    if known is not None:
        return _taken(identity, known.path, read_exposure(known.path)), None
    shot = Shot(capture_name(identity), frames, planned.exposure_s)
    # Each photograph is compared with the one before, so the first of a row has to be right for certain.
    wait_s = max(LONGEST_S, rig.acquirer.wait_s) if rig.acquirer.protected and before is None else None
    file, exposure_s = rig.acquirer.take(
        shot, captures_folder(context.folder, identity), deadline=context.deadline, wait_s=wait_s
    )
    path, shows = file.path, None
    if rig.acquirer.protected:
        shows = thumbprint(path, exposure_s)
        if before is not None and changed_share(before.frames, frames) > CHANGED_FRAMES:
            first = (path, exposure_s, shows)
            path, exposure_s, shows = _not_the_one_before(rig, context, identity, shot, first, before.shows)
    taken = _journalled(context, identity, settings, path, exposure_s)
    return taken, _Before(frames, shows) if shows is not None else None


def _not_the_one_before(
    rig: Rig, context: Context, identity: ShotId, shot: Shot, first: tuple[Path, float, Thumbprint], before: Thumbprint
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
        raise_delay(context.folder, longer_s)
        context.reporter.say(
            f"Photograph {identity} showed the picture before it and was taken again; from now on "
            f"{longer_s:.2f} s are waited for each picture.",
            Level.WARNING,
        )
    return file.path, exposure_s, again


def take_photograph(
    rig: Rig, context: Context, identity: ShotId, exposure_s: float, *, shown_at_s: float, of: Mapping[str, str]
) -> Taken:
    """Photograph what is shown since ``shown_at_s``; ``of`` says what that is, for the journal."""
    use_delay(rig, context.folder)
    profile = load_profile(context.folder)
    settings = {"exposure_s": repr(exposure_s), **of}
    known = context.journal.shot(identity, settings)
    if known is not None:
        return replace(_taken(identity, known.path, read_exposure(known.path)), profile=profile)
    file, confirmed_s = rig.acquirer.photograph(
        capture_name(identity),
        exposure_s,
        captures_folder(context.folder, identity),
        shown_at_s=shown_at_s,
        deadline=context.deadline,
    )
    return replace(_journalled(context, identity, settings, file.path, confirmed_s), profile=profile)


def _taken(identity: ShotId, path: Path, exposure_s: float) -> Taken:
    return Taken(identity.name, path, exposure_s, projector=identity.projector)


def _journalled(
    context: Context, identity: ShotId, settings: Mapping[str, str], path: Path, exposure_s: float
) -> Taken:
    write_exposure(path, exposure_s)
    artefact = context.journal.record_shot(identity, settings, path)
    return replace(_taken(identity, artefact.path, exposure_s), fresh=True)


def _digest(frames: Mapping[str, ByteImage]) -> str:
    digest = hashlib.sha256()
    for output in sorted(frames):
        digest.update(f"{output} {frames[output].shape} ".encode())
        digest.update(np.ascontiguousarray(frames[output]).tobytes())
    return digest.hexdigest()
