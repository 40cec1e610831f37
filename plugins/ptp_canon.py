"""Canon EOS bodies, old (910F, such as the EOS 400D) and new (9128/9129): chosen by what the body lists, not by model.

Sequences as libgphoto2 documents them from traces; see ``hal.ptp_eos`` for the bytes.
"""

from __future__ import annotations

import time
from typing import Final

from hal.deadline import Deadline, in_seconds
from hal.errors import DeviceRefused, DeviceTimeout
from hal.ptp import Operation
from hal.ptp_eos import (
    Destination,
    EosProperty,
    ImageFormat,
    aperture_of,
    exposure_of,
    iso_of,
    pack_setting,
    parse_records,
)
from hal.values import CameraCapabilities, ExposureSettings
from plugins.ptp_body import Channel, Picture, Shot, nearest, no_such_file, still_waiting
from plugins.ptp_canon_state import EosState
from plugins.ptp_files import PendingFile, kind_of
from plugins.ptp_link import Reply, camera_busy, refused

_BLOCK: Final = 1 << 20
"""Some bodies stop answering when asked for more at once."""
_HOST_SPACE: Final = (0x0FFF_FFFF, 0x1000, 1)
"""What 911A tells the body of this computer's free space, so that it does not refuse to expose."""
_MOST_DRAINS: Final = 200
_HALF, _FULL = 1, 2
_LET_GO_S: Final = 2.0
_RELEASE_ERRORS: Final = {
    1: ("camera-autofocus", "its autofocus found nothing", "Switch the lens to manual focus, then try again."),
    3: ("camera-mirror", "its mirror is up", "Leave live view and switch mirror lock-up off, then try again."),
    7: ("card-full", "its memory is full", "Empty or replace the card, then go on; nothing was exposed."),
    8: ("card-unusable", "its card is write-protected", "Slide the card's lock back; nothing was exposed."),
}


class EosBody:
    """See ``plugins.ptp_body.Body``. ``to_card``: let pictures go to the card instead of straight to this computer."""

    def __init__(self, channel: Channel, *, to_card: bool, keep_on_card: bool) -> None:
        self._channel = channel
        self._to_card = to_card
        self._keep = keep_on_card
        self._state = EosState()
        self._alive_at_s = time.monotonic()

    @property
    def capabilities(self) -> CameraCapabilities:
        return self._state.capabilities

    def prepare(self, *, after_break: bool, deadline: Deadline) -> None:
        for operation in (Operation.EOS_SET_REMOTE_MODE, Operation.EOS_SET_EVENT_MODE):
            self._channel.ask(operation, 1, doing="let itself be controlled", deadline=deadline)
        if after_break and self._channel.has(Operation.EOS_RELEASE_OFF):
            self._let_go(_FULL)
            self._let_go(_HALF)
        self._drain(deadline)
        self._aim_at_target(deadline)

    def configure(self, settings: ExposureSettings, *, deadline: Deadline) -> ExposureSettings:
        self._drain(deadline)
        image_format = self._state.pick_format(raw=settings.raw)
        if image_format is None:
            raise no_such_file(settings.raw)
        exposures, isos, apertures = self._state.exposures(), self._state.isos(), self._state.apertures()
        exposure_s = nearest(exposures, settings.exposure_s, setting="exposure time in seconds")
        iso = round(nearest(isos, settings.iso, setting="ISO speed")) if isos else settings.iso
        aperture_f = settings.aperture_f
        if aperture_f is not None:
            aperture_f = nearest(apertures, aperture_f, setting="aperture")
            code = self._set(EosProperty.APERTURE, apertures[aperture_f], deadline)
            aperture_f = aperture_of(code) or aperture_f
        self._set(EosProperty.IMAGE_FORMAT, image_format, deadline)
        exposure_s = exposure_of(self._set(EosProperty.SHUTTER, exposures[exposure_s], deadline)) or exposure_s
        if isos:
            iso = iso_of(self._set(EosProperty.ISO, isos[iso], deadline)) or iso
        return ExposureSettings(exposure_s, iso, aperture_f, settings.raw)

    def exposure_s(self, *, deadline: Deadline) -> float:
        self._drain(deadline)
        return exposure_of(self._state.number(EosProperty.SHUTTER)) or 30.0

    def release(self, shot: Shot, *, deadline: Deadline) -> None:
        self._aim_at_target(deadline)
        self._forget_old_pictures(deadline)
        self._keep_alive(deadline)
        if self._to_card:
            shot.known = self._channel.handles(deadline)
        give_up = deadline.within(self._channel.timing.busy_s)
        pause_s = 0.01
        while True:
            reply = self._press(shot, deadline)
            if reply.ok and not any(reply.parameters[:1]):
                return
            shot.not_fired()
            if reply.ok:
                raise _not_released(reply.parameters[0])
            if not reply.busy:
                raise refused(reply, "take a picture")
            if give_up.passed:
                raise camera_busy("take a picture")
            self._drain(deadline)
            give_up.sleep(pause_s)
            pause_s = min(0.5, 2 * pause_s)

    def collect(self, shot: Shot, *, deadline: Deadline) -> list[Picture]:
        """Poll for the records of the new files; on a card also look at the list, should a record be lost."""
        timing = self._channel.timing
        expected = len(self._state.current_format() or (None,))
        listing_due_s = 0.0 if shot.recovering else 2 * shot.exposure_s + timing.grace_s
        pause_s = 0.002
        while True:
            for new in self._state.fresh:
                if kind_of(new.format, new.filename) is not None and new.handle not in shot.known:
                    shot.found[new.handle] = Picture(new.handle, new.format, new.size, new.filename, new.waiting)
            self._state.fresh.clear()
            if len(shot.found) < expected and shot.age_s() >= listing_due_s:
                self._look_again(shot, deadline)
                listing_due_s = shot.age_s() + timing.grace_s
            if len(shot.found) >= expected or (shot.found and shot.overdue(timing)):
                return list(shot.found.values())
            if shot.overdue(timing):
                raise shot.missing()
            still_waiting(deadline)
            deadline.sleep(pause_s)
            pause_s = min(0.02, 1.5 * pause_s)
            self._keep_alive(deadline)
            self._drain(deadline)

    def download(self, picture: Picture, file: PendingFile, *, deadline: Deadline) -> None:
        for operation in (Operation.GET_PARTIAL_OBJECT, Operation.EOS_GET_PARTIAL_OBJECT):
            if self._channel.has(operation):
                self._channel.download(picture, file, partly=operation, block=_BLOCK, deadline=deadline)
                return
        self._channel.download(picture, file, partly=None, block=_BLOCK, deadline=deadline)

    def done(self, picture: Picture, *, deadline: Deadline) -> None:
        if picture.waiting:
            self._channel.once(Operation.EOS_TRANSFER_COMPLETE, picture.handle, deadline=deadline)
        elif not self._keep and self._channel.has(Operation.DELETE_OBJECT):
            self._channel.once(Operation.DELETE_OBJECT, picture.handle, 0, deadline=deadline)

    def leave(self, *, deadline: Deadline) -> None:
        for operation, mode in (
            (Operation.EOS_SET_REMOTE_MODE, 0),
            (Operation.EOS_SET_REMOTE_MODE, 1),
            (Operation.EOS_SET_EVENT_MODE, 0),
        ):
            self._channel.once(operation, mode, deadline=deadline)

    def _press(self, shot: Shot, deadline: Deadline) -> Reply:
        """Press and let go. The answer that decides is the one to the full press."""
        patience_s = self._channel.timing.answer_s + 2 * shot.exposure_s
        if not self._channel.has(Operation.EOS_RELEASE_ON):
            shot.fire()
            return self._channel.once(Operation.EOS_RELEASE, patience_s=patience_s, deadline=deadline)
        half = self._channel.once(Operation.EOS_RELEASE_ON, _HALF, 0, deadline=deadline)
        if not half.ok or any(half.parameters[:1]):
            self._let_go(_HALF)
            return half
        try:
            shot.fire()
            return self._channel.once(Operation.EOS_RELEASE_ON, _FULL, 0, patience_s=patience_s, deadline=deadline)
        finally:
            # Whatever came of it: a body whose button stays down takes no further picture.
            self._let_go(_FULL)
            self._let_go(_HALF)

    def _let_go(self, button: int) -> None:
        """With time of its own, so that neither the caller's deadline nor its cancellation leaves the button down."""
        if not self._channel.link.broken:
            self._channel.once(Operation.EOS_RELEASE_OFF, button, deadline=in_seconds(_LET_GO_S))

    def _drain(self, deadline: Deadline) -> None:
        """Take in all records until an answer has none."""
        for _ in range(_MOST_DRAINS):
            reply = self._channel.ask(Operation.EOS_GET_EVENT, doing="say what has changed", deadline=deadline)
            records = parse_records(reply.data)
            self._state.take(records)
            if not records:
                return

    def _aim_at_target(self, deadline: Deadline) -> None:
        """Let pictures go to this computer, or to the card; looked at each time, for bodies change it by themselves."""
        self._drain(deadline)
        if not self._state.knows(EosProperty.CAPTURE_DESTINATION):
            self._to_card = True
            return
        cards = [one for one in self._state.allowed(EosProperty.CAPTURE_DESTINATION) if one != Destination.HOST]
        now = self._state.number(EosProperty.CAPTURE_DESTINATION)
        wanted: int = Destination.HOST
        if self._to_card:
            wanted = now if now != Destination.HOST or not cards else cards[0]
        self._set(EosProperty.CAPTURE_DESTINATION, wanted, deadline)
        if wanted == Destination.HOST and self._channel.has(Operation.EOS_HOST_CAPACITY):
            self._channel.ask(
                Operation.EOS_HOST_CAPACITY,
                *_HOST_SPACE,
                doing="take note of this computer's space",
                deadline=deadline,
            )

    def _forget_old_pictures(self, deadline: Deadline) -> None:
        """What waits from before this shot belongs to an earlier one, and must not be taken for this one."""
        self._drain(deadline)
        for old in self._state.fresh:
            if old.waiting:
                self._channel.once(Operation.EOS_TRANSFER_COMPLETE, old.handle, deadline=deadline)
        self._state.fresh.clear()

    def _look_again(self, shot: Shot, deadline: Deadline) -> None:
        """A record may have been lost: list the card, or have the body report everything anew."""
        if not self._to_card:
            self._channel.ask(Operation.EOS_SET_EVENT_MODE, 1, doing="report everything", deadline=deadline)
            self._drain(deadline)
            return
        for handle in sorted(self._channel.handles(deadline) - shot.known - shot.found.keys()):
            picture = self._channel.picture(handle, deadline)
            if picture is not None:
                shot.found[handle] = picture

    def _keep_alive(self, deadline: Deadline) -> None:
        due = time.monotonic() - self._alive_at_s >= self._channel.timing.keep_alive_s
        if due and self._channel.has(Operation.EOS_KEEP_DEVICE_ON):
            self._channel.once(Operation.EOS_KEEP_DEVICE_ON, deadline=deadline)
            self._alive_at_s = time.monotonic()

    def _set(self, code: EosProperty, value: int | ImageFormat, deadline: Deadline) -> int:
        """Set a property and wait until the body says so (C189); return what it says."""
        wanted = pack_setting(code, value)[8:]
        if self._state.is_set(code, wanted):
            return self._state.number(code)
        self._state.forget(code)
        self._channel.ask(
            Operation.EOS_SET_PROPERTY,
            data=pack_setting(code, value),
            doing=f"set 0x{code:04x}",
            meanwhile=lambda: self._drain(deadline),
            deadline=deadline,
        )
        self._await_value(code, deadline.within(self._channel.timing.answer_s))
        return self._state.number(code)

    def _await_value(self, code: EosProperty, until: Deadline) -> None:
        pause_s = 0.001
        while True:
            self._drain(until)
            if self._state.knows(code):
                return
            if until.passed:
                # What is set is unknown now; a new connection begins with a full report.
                self._channel.link.close()
                raise DeviceTimeout(
                    "camera-not-confirmed",
                    what=f"The camera took a setting (0x{code:04x}) but did not confirm it.",
                    remedy="Turn its mode dial to M and leave its menus, then try again.",
                )
            until.sleep(pause_s)
            pause_s = min(0.05, 2 * pause_s)


def _not_released(code: int) -> DeviceRefused:
    name, why, remedy = _RELEASE_ERRORS.get(
        code, ("camera-not-released", f"it gave the unknown reason {code}", "Switch it off and on, then try again.")
    )
    return DeviceRefused(name, what=f"The camera took no picture: {why}.", remedy=remedy)
