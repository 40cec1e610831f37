"""Canon EOS bodies, old (910F, such as the EOS 400D) and new (9128/9129): chosen by their operations, not by model.

Sequences as libgphoto2 documents them from traces; see ``hal.codecs.ptp.eos`` for the bytes. Live view (9153) is for
aiming, and off before any picture.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Final

from hal.codecs.ptp.eos import VIEW_TO_COMPUTER, Destination, EosProperty, aperture_of, exposure_of, iso_of, parse_view
from hal.codecs.ptp.values import Answer, Operation
from hal.deadline import Deadline
from hal.errors import DeviceRefused, DeviceTimeout
from hal.values import CameraCapabilities, CameraStatus, ExposureSettings
from plugins.camera_files import PendingFile, kind_of
from plugins.ptp.body import Channel, PictureStorage, nearest, no_live_view, no_such_file, still_waiting
from plugins.ptp.canon.conversation import EosTalk
from plugins.ptp.canon.shutter import EosShutter, not_released, released
from plugins.ptp.link import Reply, camera_busy, refused
from plugins.ptp.shot import Picture, Shot

_WHOLE_FRAME: Final = (0x0020_0000, 0, 0)


class EosView:
    """``on`` while live view is active."""

    def __init__(self, talk: EosTalk) -> None:
        self._talk = talk

    @property
    def able(self) -> bool:
        return self._talk.channel.has(Operation.EOS_GET_VIEWFINDER) and self._talk.state.knows(EosProperty.VIEW_OUTPUT)

    @property
    def on(self) -> bool:
        return self.able and self._talk.state.number(EosProperty.VIEW_OUTPUT) & VIEW_TO_COMPUTER != 0

    def frame(self, deadline: Deadline) -> bytes:
        """One JPEG. The body answers "busy" or "not ready" until the first frame is there."""
        if not self.able:
            raise no_live_view()
        talk = self._talk
        if not self.on:
            if talk.state.knows(EosProperty.VIEW_MODE):
                talk.set(EosProperty.VIEW_MODE, 1, deadline)
            talk.set(EosProperty.VIEW_OUTPUT, VIEW_TO_COMPUTER, deadline)
        until = deadline.within(talk.channel.timing.busy_s)
        while True:
            talk.keep_alive(deadline)
            # Every body is busy until its mirror is up: that is no trouble.
            reply = talk.channel.once(Operation.EOS_GET_VIEWFINDER, *_WHOLE_FRAME, deadline=deadline, note_busy=False)
            if reply.ok:
                return parse_view(reply.data)
            if not reply.busy:
                raise refused(reply, "show live view")
            if until.passed:
                raise DeviceTimeout(
                    "camera-no-view",
                    what="The camera sent no live view picture in time.",
                    remedy="Enable live view in its menu, leave its menus, then try again.",
                )
            talk.drain(deadline)
            until.sleep(0.02)

    def end(self, deadline: Deadline) -> None:
        if self.on:
            self._talk.set(EosProperty.VIEW_OUTPUT, 0, deadline)


_BLOCK: Final = 1 << 20
"""Some bodies stop answering when asked for more at once."""
_HOST_SPACE: Final = (0x0FFF_FFFF, 0x1000, 1)
"""The free space of this computer that 911A reports to the body, so that it does not refuse to expose."""
_LONGEST_BULB_S: Final = 900.0
_FULL: Final = 7
"""Result of a release with full memory."""


class EosBody:
    """See ``plugins.ptp.body.Body``."""

    def __init__(self, channel: Channel, storage: PictureStorage) -> None:
        self._channel = channel
        self._talk = EosTalk(channel)
        self._state = self._talk.state
        self._shutter = EosShutter(self._talk)
        self._view = EosView(self._talk)
        self._to_card = storage.to_card
        self._keep = storage.keep_on_card
        self._both = storage.both
        self._bulb_s: float | None = None
        self._target_changed = False
        self._space_refused = False

    @property
    def capabilities(self) -> CameraCapabilities:
        return replace(self._state.capabilities, bulb=self._can_bulb, live_view=self._view.able)

    def prepare(self, *, deadline: Deadline) -> None:
        for operation in (Operation.EOS_SET_REMOTE_MODE, Operation.EOS_SET_EVENT_MODE):
            self._channel.request(operation, 1, doing="accept remote control", deadline=deadline)
        # Also at the first connection: a program that was killed may have left both as they were.
        self._shutter.close()
        self._shutter.let_go()
        self._talk.drain(deadline)
        self._view.end(deadline)
        self._aim_at_target(deadline)

    def configure(self, settings: ExposureSettings, *, deadline: Deadline) -> ExposureSettings:
        self._talk.drain(deadline)
        image_format = self._state.pick_format(raw=settings.raw, both=self._both)
        if image_format is None:
            raise no_such_file(settings.raw)
        exposures, isos, apertures = self._state.exposures(), self._state.isos(), self._state.apertures()
        bulb_s = settings.exposure_s if self._needs_bulb(settings.exposure_s, exposures) else None
        exposure_s = bulb_s or nearest(exposures, settings.exposure_s, setting="exposure time in seconds")
        iso = round(nearest(isos, settings.iso, setting="ISO speed")) if isos else settings.iso
        aperture_f = settings.aperture_f
        if aperture_f is not None:
            aperture_f = nearest(apertures, aperture_f, setting="aperture")
            code = self._talk.set(EosProperty.APERTURE, apertures[aperture_f], deadline)
            aperture_f = aperture_of(code) or aperture_f
        self._talk.set(EosProperty.IMAGE_FORMAT, image_format, deadline)
        code = (self._state.bulb() or 0) if bulb_s is not None else exposures[exposure_s]
        confirmed_s = exposure_of(self._talk.set(EosProperty.SHUTTER, code, deadline))
        self._bulb_s = bulb_s
        if isos:
            iso = iso_of(self._talk.set(EosProperty.ISO, isos[iso], deadline)) or iso
        return ExposureSettings(bulb_s or confirmed_s or exposure_s, iso, aperture_f, settings.raw)

    def exposure_s(self, *, deadline: Deadline) -> float:
        self._talk.drain(deadline)
        return self._bulb_s or exposure_of(self._state.number(EosProperty.SHUTTER)) or 30.0

    def release(self, shot: Shot, *, deadline: Deadline) -> None:
        self._view.end(deadline)
        self._aim_at_target(deadline)
        self._talk.keep_alive(deadline)
        give_up = self._channel.patience(deadline)
        pause_s = 0.01
        aimed_again = self._to_card
        while True:
            # At each attempt: while the body was busy, an earlier picture may have been finished.
            self._forget_old_pictures(deadline)
            shot.known = self._channel.handles(deadline)
            reply = self._shutter.press(shot, bulb=self._bulb_s is not None, deadline=deadline)
            if released(reply):
                return
            shot.not_fired()
            if _full(reply) and not aimed_again:
                # Its card is full, but the card is not the target: it has changed the target by itself.
                aimed_again = self._target_changed = True
                self._aim_at_target(deadline, again=True)
                continue
            if reply.ok:
                raise not_released(reply.parameters[0])
            if not reply.busy:
                raise refused(reply, "take a picture")
            if give_up.passed:
                raise camera_busy("take a picture")
            self._talk.drain(deadline)
            give_up.sleep(pause_s)
            pause_s = min(0.5, 2 * pause_s)

    def collect(self, shot: Shot, *, deadline: Deadline) -> list[Picture]:
        """Poll for the records of the new files; look at the list, should a record be lost."""
        if shot.held:
            raise shot.missing()
        timing = self._channel.timing
        expected = len(self._state.current_format() or (None,))
        listing_due_s = 0.0 if shot.recovering else 2 * shot.exposure_s + timing.grace_s
        pause_s = 0.002
        while True:
            self._take_in(shot)
            if len(shot.found) < expected and shot.age_s() >= listing_due_s:
                before = len(shot.found)
                self._look_again(shot, deadline)
                if len(shot.found) > before and not shot.recovering:
                    self._channel.diary.add("camera-event-lost", "The camera has a picture that it did not report.")
                listing_due_s = shot.age_s() + timing.grace_s
            if len(shot.found) >= expected or (shot.found and shot.overdue(timing)):
                self._check_target(shot, deadline)
                return list(shot.found.values())
            if shot.overdue(timing):
                raise shot.missing()
            still_waiting(deadline)
            deadline.sleep(pause_s)
            pause_s = min(0.02, 1.5 * pause_s)
            self._talk.keep_alive(deadline)
            self._talk.drain(deadline)

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

    def keep_alive(self, *, deadline: Deadline) -> None:
        self._talk.keep_alive(deadline, at_once=True)
        self._talk.drain(deadline)

    def status(self, *, deadline: Deadline) -> CameraStatus:
        self._talk.drain(deadline)
        changed, self._target_changed = self._target_changed, False
        warnings = self._state.warnings() + ["target-changed"] * changed
        battery = self._channel.battery_percent(deadline)
        return self._channel.status(self._state.battery_percent() if battery is None else battery, warnings, deadline)

    def live_view(self, *, deadline: Deadline) -> bytes:
        return self._view.frame(deadline)

    def end_live_view(self, *, deadline: Deadline) -> None:
        self._view.end(deadline)

    def leave(self, *, deadline: Deadline) -> None:
        self._view.end(deadline)
        for operation, mode in (
            (Operation.EOS_SET_REMOTE_MODE, 0),
            (Operation.EOS_SET_REMOTE_MODE, 1),
            (Operation.EOS_SET_EVENT_MODE, 0),
        ):
            self._channel.once(operation, mode, deadline=deadline)

    @property
    def _can_bulb(self) -> bool:
        return self._shutter.bulb and self._state.bulb() is not None

    def _needs_bulb(self, exposure_s: float, exposures: Collection[float]) -> bool:
        """Whether the exposure is longer than the body's own times, and bulb can do it."""
        return self._can_bulb and bool(exposures) and 2**0.5 * max(exposures) < exposure_s <= _LONGEST_BULB_S

    def _take_in(self, shot: Shot) -> None:
        for new in self._state.fresh:
            if kind_of(new.format, new.filename) is not None and new.handle not in shot.known:
                shot.found[new.handle] = Picture(new.handle, new.format, new.size, new.filename, new.waiting)
        self._state.fresh.clear()

    def _check_target(self, shot: Shot, deadline: Deadline) -> None:
        """A picture on the card, although this computer was the target: the body has changed it by itself."""
        if not self._to_card and not all(picture.waiting for picture in shot.found.values()):
            self._target_changed = True
            self._channel.diary.add("camera-target-changed", "The camera stored a picture on its card unasked.")
            self._aim_at_target(deadline, again=True)

    def _aim_at_target(self, deadline: Deadline, *, again: bool = False) -> None:
        """Send pictures to this computer, or to the card; checked each time, because bodies change it by themselves.

        ``again``: set it even if the body has reported it.
        """
        self._talk.drain(deadline)
        if not self._state.knows(EosProperty.CAPTURE_DESTINATION):
            self._to_card = True
            return
        cards = [one for one in self._state.allowed(EosProperty.CAPTURE_DESTINATION) if one != Destination.HOST]
        now = self._state.number(EosProperty.CAPTURE_DESTINATION)
        wanted: int = Destination.HOST
        if self._to_card:
            wanted = now if now != Destination.HOST or not cards else cards[0]
        self._talk.set(EosProperty.CAPTURE_DESTINATION, wanted, deadline, again=again)
        if wanted == Destination.HOST and self._channel.has(Operation.EOS_HOST_CAPACITY):
            self._send_free_space(deadline)

    def _send_free_space(self, deadline: Deadline) -> None:
        """Some bodies refuse it and expose all the same; one that needs it refuses the release, with its reason."""
        try:
            self._channel.request(
                Operation.EOS_HOST_CAPACITY, *_HOST_SPACE, doing="accept this computer's free space", deadline=deadline
            )
        except DeviceRefused as error:
            if not self._space_refused:
                self._channel.diary.add("camera-space-refused", error.what)
            self._space_refused = True

    def _forget_old_pictures(self, deadline: Deadline) -> None:
        """Drop pictures that belong to an earlier shot."""
        self._talk.drain(deadline)
        for old in self._state.fresh:
            if old.waiting:
                self._channel.once(Operation.EOS_TRANSFER_COMPLETE, old.handle, deadline=deadline)
        self._state.fresh.clear()

    def _look_again(self, shot: Shot, deadline: Deadline) -> None:
        """A record may have been lost: list the card, or let the body report everything again."""
        if not self._to_card:
            self._channel.request(Operation.EOS_SET_EVENT_MODE, 1, doing="report everything", deadline=deadline)
            self._talk.drain(deadline)
            self._take_in(shot)
        for handle in sorted(self._channel.handles(deadline) - shot.known - shot.found.keys()):
            picture = self._channel.picture(handle, deadline)
            if picture is not None:
                shot.found[handle] = picture


def _full(reply: Reply) -> bool:
    return reply.code == Answer.STORE_FULL or (reply.ok and reply.parameters[:1] == (_FULL,))
