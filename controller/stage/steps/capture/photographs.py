"""Photographs of a run: each is taken once, has its own journal entry, and is listed in an index for later steps."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from controller.core.arrays import ByteImage
from controller.optics.capture.acquire import LastShown, Shot
from controller.optics.capture.latency import CHANGED_FRAMES, LONGEST_S, changed_share, fingerprint, same_picture
from controller.optics.capture.profile import CameraProfile, load_profile, true_exposure
from controller.run.runner import Context
from controller.run.step_id import ShotId
from controller.stage.artefacts.camera import longest_wait_s, raise_delay
from controller.stage.artefacts.photographs import (
    PhotographSet,
    TakenPhotograph,
    capture_name,
    captures_folder,
    delete_photograph,
    read_exposure,
    write_exposure,
)
from controller.stage.rig.rig import Rig
from controller.stage.rig.shared_display import frames_digest
from hal.deadline import Cancelled, Deadline, in_seconds
from hal.errors import DeviceError
from hal.interfaces import Camera, WatchedCamera
from hal.notices import Level

MORE_DELAY_S = 0.1
CHECK_LAMPS_EVERY_S = 30.0
"""Time between two checks of the lamps: at most this much work is lost when a lamp fails."""
LAST_CHECK_S: Final = 3.0
"""For the last check of the lamps where a series ends early. One that is lit answers at once. A dead one holds nothing
up: what is not confirmed is only photographed again."""


@dataclass(frozen=True, slots=True)
class Planned:
    """A photograph to take: ``frames`` by projector name, made when needed; the others are black.

    ``projector``: the only one lit, if the set is not for a single projector already
    """

    name: str
    frames: Callable[[], Mapping[str, ByteImage]]
    exposure_s: float
    projector: str | None = None


def take_all(rig: Rig, context: Context, plan: Sequence[Planned], *, into: PhotographSet) -> list[Path]:
    """Take the missing photographs; return the index file and all photographs.

    A photograph in the journal with the same frames and the same exposure is not taken again.
    """
    use_delay(rig, context.folder)
    watch = CameraWatch(rig.camera)
    with photograph_series(rig, context) as series:
        for number, planned in enumerate(plan):
            context.advance(number / len(plan), planned.name)
            series.add(_take(rig, context, planned, into.shot(planned.name, planned.projector)))
            watch.check(context)
    return [into.write(context.folder, series.taken), *(photograph.path for photograph in series.taken)]


@dataclass(slots=True)
class PhotographSeries:
    """Photographs of one step, and how many of them certainly have the light of all lamps."""

    rig: Rig
    context: Context
    taken: list[TakenPhotograph] = field(default_factory=list)
    _confirmed: int = 0
    _checked_at_s: float = field(default_factory=time.monotonic)

    def add(self, photograph: TakenPhotograph) -> None:
        """Check the lamps every CHECK_LAMPS_EVERY_S. Raises as ``Rig.check_light``."""
        self.taken.append(photograph)
        if time.monotonic() - self._checked_at_s >= CHECK_LAMPS_EVERY_S:
            self.check_lamps(self.context.deadline)

    def check_lamps(self, deadline: Deadline) -> None:
        """Check the lamps; if one fails, discard the photographs since the last check. Raises as ``check_light``."""
        if not any(photograph.fresh for photograph in self.taken[self._confirmed :]):
            return
        try:
            self.rig.check_light(deadline=deadline)
        except Cancelled:
            raise
        except DeviceError:
            for photograph in self.taken[self._confirmed :]:
                if photograph.fresh:
                    delete_photograph(photograph.path)
            del self.taken[self._confirmed :]
            raise
        self._confirmed, self._checked_at_s = len(self.taken), time.monotonic()


@contextlib.contextmanager
def photograph_series(rig: Rig, context: Context) -> Iterator[PhotographSeries]:
    """A series to which photographs are added as they are taken. If a lamp has failed at its end, or when it is
    stopped, the photographs since the last check are discarded, because some may lack its light.

    Raises as ``Rig.check_light``. A continued run takes the discarded ones again.
    """
    series = PhotographSeries(rig, context)
    try:
        yield series
        series.check_lamps(context.deadline)
    except BaseException:
        # With its own time limit, and without an error: the caller reports the error that ended the series.
        with contextlib.suppress(DeviceError):
            series.check_lamps(in_seconds(LAST_CHECK_S))
        raise


def use_delay(rig: Rig, folder: Path) -> None:
    """Set the acquirer's waiting time to the one measured in ``folder``, if any."""
    wait_s = longest_wait_s(folder)
    if wait_s is not None:
        rig.acquirer.set_delay(wait_s)


def _take(rig: Rig, context: Context, planned: Planned, identity: ShotId) -> TakenPhotograph:
    acquirer = rig.acquirer
    frames = rig.on_outputs(planned.frames())
    settings = {"exposure_s": repr(planned.exposure_s), "frames": frames_digest(frames)}
    known = context.journal.shot(identity, settings)
    if known is not None:
        return _taken(identity, known.path, read_exposure(known.path))
    shot = Shot(capture_name(identity), frames, planned.exposure_s)
    folder = captures_folder(context.folder, identity)
    presented = acquirer.present_for(shot, deadline=context.deadline)
    # What the display showed before is known where nothing was shown in between.
    before = acquirer.last if acquirer.last and acquirer.last.sequence == presented.sequence - 1 else None
    acquirer.last = None
    # Each photograph is compared with the previous one; where that is not known, this one must be right for certain.
    wait_s = max(LONGEST_S, acquirer.wait_s) if acquirer.protected and before is None else None
    file, exposure_s = acquirer.photograph(
        shot.name, shot.exposure_s, folder, shown_at_s=presented.at_s, deadline=context.deadline, wait_s=wait_s
    )
    path = file.path
    if acquirer.protected:
        last = LastShown(frames, fingerprint(path, exposure_s), presented.sequence)
        if before is not None and changed_share(before.frames, frames) > CHANGED_FRAMES:
            path, exposure_s, last = _changed_photograph(rig, context, identity, shot, (path, exposure_s, last), before)
        acquirer.last = last
    return _journalled(context, identity, settings, path, exposure_s)


def _changed_photograph(
    rig: Rig, context: Context, identity: ShotId, shot: Shot, first: tuple[Path, float, LastShown], before: LastShown
) -> tuple[Path, float, LastShown]:
    """The photograph if it differs from the previous one; otherwise one taken much later.

    If the later one differs, the display's delay has grown, and the waiting time becomes longer from now on.
    If not, the two pictures look the same to the camera.
    """
    if not same_picture(first[2].shows, before.shows):
        return first
    first[0].unlink()
    acquirer = rig.acquirer
    presented = acquirer.present_for(shot, deadline=context.deadline)
    file, exposure_s = acquirer.photograph(
        shot.name, shot.exposure_s, first[0].parent, shown_at_s=presented.at_s, deadline=context.deadline,
        wait_s=max(LONGEST_S, 2 * acquirer.wait_s),
    )  # fmt: skip
    again = LastShown(shot.frames, fingerprint(file.path, exposure_s), presented.sequence)
    if not same_picture(again.shows, before.shows):
        longer_s = min(acquirer.wait_s + MORE_DELAY_S, LONGEST_S)
        acquirer.set_delay(longer_s)
        raise_delay(context.folder, longer_s)
        context.reporter.say(
            f"Photograph {identity} showed the picture before it and was taken again; from now on "
            f"{longer_s:.2f} s are waited for each picture.",
            Level.WARNING,
        )
    return file.path, exposure_s, again


def take_photograph(
    rig: Rig, context: Context, identity: ShotId, exposure_s: float, *, shown_at_s: float, of: Mapping[str, str]
) -> TakenPhotograph:
    """Photograph the picture shown since ``shown_at_s``; ``of`` names it for the journal."""
    use_delay(rig, context.folder)
    profile = load_profile(context.folder)
    settings = {"exposure_s": repr(exposure_s), **of}
    known = context.journal.shot(identity, settings)
    if known is not None:
        return _as_measured(_taken(identity, known.path, read_exposure(known.path)), profile)
    file, confirmed_s = rig.acquirer.photograph(
        capture_name(identity),
        exposure_s,
        captures_folder(context.folder, identity),
        shown_at_s=shown_at_s,
        deadline=context.deadline,
    )
    return _as_measured(_journalled(context, identity, settings, file.path, confirmed_s), profile)


def _as_measured(taken: TakenPhotograph, profile: CameraProfile | None) -> TakenPhotograph:
    """With what is known of the camera: its true exposure, if that differs from what it says."""
    return replace(taken, profile=profile, exposure_s=true_exposure(profile, taken.exposure_s))


def _taken(identity: ShotId, path: Path, exposure_s: float) -> TakenPhotograph:
    return TakenPhotograph(identity.name, path, exposure_s, projector=identity.projector)


def _journalled(
    context: Context, identity: ShotId, settings: Mapping[str, str], path: Path, exposure_s: float
) -> TakenPhotograph:
    write_exposure(path, exposure_s)
    artefact = context.journal.record_shot(identity, settings, path)
    return replace(_taken(identity, artefact.path, exposure_s), fresh=True)


EVERY_S: Final = 60.0
"""Time between two queries of the camera's battery and card."""
_ASK_S: Final = 5.0
_SAID: Final[Mapping[str, str]] = {
    "battery-low": "The camera's battery is low: connect its power supply.",
    "card-nearly-full": "The camera's card is nearly full: replace or empty it.",
    "card-unusable": "The camera can't write to its card: check the card's lock, or replace the card.",
    "autofocus-on": "The camera's lens is on autofocus: set it to manual focus, or photographs may be blurred or fail.",
    "mode-dial": "The camera's mode dial is not on M: turn it to M, or exposures may be wrong.",
    "target-changed": "The camera stored a picture at the wrong place. The setting was sent again.",
}


class CameraWatch:
    """Asks ``camera`` for corrected faults and its state, if its driver supports it; never raises for it."""

    def __init__(self, camera: Camera, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._camera = camera if isinstance(camera, WatchedCamera) else None
        self._clock = clock
        self._next_s = clock()

    def check(self, context: Context) -> None:
        """After a photograph: journal corrected faults; once a minute, ask for the camera's state."""
        if self._camera is None:
            return
        for notice in self._camera.notices():
            context.journal.record(notice.code, notice.what, Level.WARNING)
        if self._clock() < self._next_s:
            return
        self._next_s = self._clock() + EVERY_S
        try:
            status = self._camera.status(deadline=context.deadline.within(_ASK_S))
        except Cancelled:
            raise
        except DeviceError as error:
            # The next photograph will show whether the camera is gone; a failed query alone must not fail the run.
            context.journal.record(error.code, error.what, Level.WARNING)
            return
        known = {event.code for event in context.journal.events()} if status.warnings else set()
        for warning in status.warnings:
            if f"camera-{warning}" not in known:
                sentence = _SAID.get(warning, f"The camera warns: {warning}.")
                context.journal.record(f"camera-{warning}", sentence, Level.WARNING)
                context.reporter.say(sentence, Level.WARNING)
