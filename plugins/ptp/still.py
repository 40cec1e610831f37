"""A still camera with PTP over any link: its settings are restored after a lost connection.

How it is released is chosen by the operations that it lists, never by its model's name.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final, TypeVar

from hal.codecs.ptp.datasets import DeviceInfo
from hal.codecs.ptp.values import Answer, Operation
from hal.deadline import Deadline, in_seconds, turn
from hal.errors import DeviceBusy, DeviceError, DeviceGone, DeviceRefused, DeviceTimeout, ProtocolError
from hal.notices import Notice
from hal.tape import Transcript
from hal.values import CameraCapabilities, CameraStatus, CapturedFile, DeviceIdentity, ExposureSettings
from plugins.camera_files import PendingFile, commit_all, kind_of
from plugins.ptp.body import Body, Channel, PictureStorage
from plugins.ptp.canon.body import EosBody
from plugins.ptp.generic import GenericBody
from plugins.ptp.link import Diary, PtpLink, refused
from plugins.ptp.shot import Picture, Shot, Timing

GPHOTO2_MAKERS: Final = ("Nikon", "NIKON", "Sony")
"""What the names of makers begin with. The number of their extension is no sign: cameras of others have it, too, and on
the network theirs call themselves MTP devices."""


def choose_body(channel: Channel, info: DeviceInfo, storage: PictureStorage) -> Body:
    """What releases the camera. Raises DeviceRefused."""
    eos = {Operation.EOS_SET_PROPERTY, Operation.EOS_GET_EVENT} <= info.operations
    if eos and info.operations & {Operation.EOS_RELEASE, Operation.EOS_RELEASE_ON}:
        return EosBody(channel, storage)
    if info.manufacturer.startswith(GPHOTO2_MAKERS):
        raise DeviceRefused(
            "camera-needs-gphoto2",
            what=f"The {info.model or 'camera'} has commands of its maker, which this driver does not know.",
            remedy='Write driver = "gphoto2" into its table in stage.toml; libgphoto2 knows it.',
        )
    if Operation.INITIATE_CAPTURE in info.operations:
        return GenericBody(channel, info, storage)
    raise DeviceRefused(
        "camera-no-remote-release",
        what=f"The {info.model or 'camera'} can't be released over its cable.",
        remedy="Set its USB or network mode to PTP or remote control, or use another camera.",
    )


def device_info(channel: Channel, deadline: Deadline) -> DeviceInfo:
    """The camera's identity and capabilities."""
    return DeviceInfo.parse(channel.request(Operation.GET_DEVICE_INFO, doing="identify itself", deadline=deadline).data)


Connect = Callable[[Deadline], PtpLink]
Result = TypeVar("Result")

_SESSION: Final = 1
_ATTEMPTS: Final = 4
_CLOSE_S: Final = 0.7
_ALIVE_S: Final = 1.0


class PtpCamera:
    """A camera over any PTP link (``hal.interfaces.Camera``).

    ``connect`` opens a new link whenever one is needed: a lost connection is opened again, the settings are restored,
    and a picture in progress is looked for on the camera instead of being taken again. One caller at a time; the others
    wait. Between calls, a thread keeps the camera awake.

    Parameters
    ----------
    serial : the camera must have this serial number; "" uses the first that answers and keeps to it
    storage : where the camera stores pictures, and which
    transcript : for remarks; the opener of a link records its bytes
    """

    def __init__(
        self,
        connect: Connect,
        *,
        serial: str = "",
        storage: PictureStorage | None = None,
        timing: Timing | None = None,
        transcript: Transcript | None = None,
        deadline: Deadline,
    ) -> None:
        self._connect = connect
        self._serial = serial
        self._storage = storage or PictureStorage()
        self._timing = timing or Timing()
        self._channel: Channel | None = None
        self._body: Body | None = None
        self._settings: ExposureSettings | None = None
        self._closed = False
        self._exposing_until_s = 0.0
        self._diary = Diary(transcript)
        self._lock = threading.RLock()
        self._leaving = threading.Event()
        self._capabilities = replace(self._open(deadline).capabilities, picture_s=self._timing.margin_s)
        threading.Thread(target=self._stay_awake, name="ptp-keep-alive", daemon=True).start()

    @property
    def capabilities(self) -> CameraCapabilities:
        return self._capabilities

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        def query(body: Body) -> DeviceInfo:
            assert self._channel is not None
            return device_info(self._channel, deadline)

        info = self._with_body(query, deadline)
        return DeviceIdentity(info.manufacturer, info.model, info.serial, info.version)

    def configure(self, settings: ExposureSettings, *, deadline: Deadline) -> ExposureSettings:
        confirmed = self._with_body(lambda body: body.configure(settings, deadline=deadline), deadline)
        self._settings = confirmed
        return confirmed

    def capture(self, destination: Path, *, deadline: Deadline) -> list[CapturedFile]:
        """See ``hal.interfaces.Camera.capture``.

        A connection that is lost in the middle is opened again. Where the button may have been pressed, the picture
        is then looked for on the camera; it is never taken again. Raises DeviceGone("camera-shot-lost") where the
        camera has none.
        """
        with self._turn(deadline):
            shot = Shot(self._with_body(lambda body: self._exposure_s(body, deadline), deadline))
            try:
                return self._capture(shot, destination, deadline)
            except BaseException:
                if shot.fired:
                    self._exposing_until_s = shot.fired_at_s + shot.exposure_s
                    if self._channel is not None:
                        self._channel.exposing_until_s = self._exposing_until_s
                raise

    def status(self, *, deadline: Deadline) -> CameraStatus:
        """See ``hal.interfaces.WatchedCamera``."""
        return self._with_body(lambda body: body.status(deadline=deadline), deadline)

    def notices(self) -> list[Notice]:
        """See ``hal.interfaces.WatchedCamera``."""
        return self._diary.take()

    def live_view(self, *, deadline: Deadline) -> bytes:
        """See ``hal.interfaces.LiveViewCamera``."""
        return self._with_body(lambda body: body.live_view(deadline=deadline), deadline)

    def end_live_view(self, *, deadline: Deadline) -> None:
        """See ``hal.interfaces.LiveViewCamera``."""
        self._with_body(lambda body: body.end_live_view(deadline=deadline), deadline)

    def close(self) -> None:
        self._closed = True
        self._leaving.set()
        # A hanging call of another thread must not block this one.
        mine = self._lock.acquire(timeout=_CLOSE_S)
        try:
            self._close(farewell=mine)
        finally:
            if mine:
                self._lock.release()

    def _close(self, *, farewell: bool) -> None:
        """``farewell``: no other call uses the link, so answers can't be mixed up."""
        deadline = in_seconds(_CLOSE_S)
        body, channel, self._body, self._channel = self._body, self._channel, None, None
        if channel is not None:
            with contextlib.suppress(DeviceError):
                if farewell and body is not None and not channel.link.broken:
                    body.leave(deadline=deadline)
                    channel.once(Operation.CLOSE_SESSION, deadline=deadline)
            channel.link.close()

    def _capture(self, shot: Shot, destination: Path, deadline: Deadline) -> list[CapturedFile]:
        self._check_time_for(shot, deadline)
        attempt = 0
        while True:
            attempt += 1
            body = self._ready(deadline, self._timing.reconnect_s if shot.fired else self._timing.come_back_s)
            try:
                if shot.fired:
                    shot.resume()
                else:
                    body.release(shot, deadline=deadline)
                pictures = body.collect(shot, deadline=deadline)
                return self._fetch(body, pictures, destination, deadline)
            except (DeviceGone, DeviceTimeout, ProtocolError) as error:
                # Try again only after a broken link; an answer of the camera is final.
                if attempt == _ATTEMPTS or deadline.passed or not self._link_broken():
                    raise
                self._diary.add(error.code, error.what)

    def _with_body(self, work: Callable[[Body], Result], deadline: Deadline) -> Result:
        """Do ``work``; if that breaks the connection, again on a new one. Only for repeatable work."""
        with self._turn(deadline):
            body = self._ready(deadline, self._timing.come_back_s)
            try:
                return work(body)
            except (DeviceGone, DeviceTimeout, ProtocolError) as error:
                if deadline.passed or not self._link_broken():
                    raise
                self._diary.add(error.code, error.what)
            return work(self._ready(deadline, self._timing.come_back_s))

    @contextlib.contextmanager
    def _turn(self, deadline: Deadline) -> Iterator[None]:
        """One caller at a time; another caller's exposure may exceed this deadline."""
        with turn(self._lock, deadline, partial(_still_time, deadline)):
            yield

    def _stay_awake(self) -> None:
        """An idle camera switches itself off."""
        while not self._leaving.wait(self._timing.idle_s):
            if not self._lock.acquire(blocking=False):
                continue  # it is in use
            try:
                if self._body is not None and not self._link_broken():
                    self._body.keep_alive(deadline=in_seconds(_ALIVE_S))
            except DeviceError as error:
                self._diary.add(error.code, error.what)
            finally:
                self._lock.release()

    def _exposure_s(self, body: Body, deadline: Deadline) -> float:
        return self._settings.exposure_s if self._settings is not None else body.exposure_s(deadline=deadline)

    def _check_time_for(self, shot: Shot, deadline: Deadline) -> None:
        if deadline.left_s() <= shot.exposure_s:
            raise DeviceTimeout(
                "camera-deadline-too-short",
                what=f"An exposure of {shot.exposure_s:g} s does not fit into the remaining {deadline.left_s():.1f} s.",
                remedy="Allow more than twice the exposure time. Nothing was exposed.",
            )

    def _fetch(self, body: Body, pictures: list[Picture], destination: Path, deadline: Deadline) -> list[CapturedFile]:
        """Download all files of one picture, name them together, and only then let the camera delete them."""
        with ExitStack() as temporary:
            pending: list[PendingFile] = []
            for picture in pictures:
                kind = kind_of(picture.format, picture.filename)
                if kind is None:
                    continue
                path = destination.parent / f"{destination.name}{kind[1]}"
                file = temporary.enter_context(PendingFile(path, kind[0]))
                body.download(picture, file, deadline=deadline)
                pending.append(file)
            captured = commit_all(pending)
        # The files are safe: an error now must not make the caller take this picture again.
        with contextlib.suppress(DeviceError):
            for picture in pictures:
                body.done(picture, deadline=in_seconds(max(1.0, min(5.0, deadline.left_s()))))
        return captured

    def _ready(self, deadline: Deadline, patience_s: float) -> Body:
        """The body on a working connection; a broken one is opened again within ``patience_s``."""
        _still_time(deadline)
        self._check_open()
        if self._body is not None and not self._link_broken():
            return self._body
        give_up = deadline.within(patience_s)
        pause_s = 0.05
        gone: DeviceGone | None = None
        while True:
            self._check_open()
            try:
                return self._reopen(deadline)
            except (DeviceGone, DeviceBusy, DeviceTimeout, ProtocolError) as error:
                # A camera that restarts refuses connections at first, or still holds the lost one.
                gone = error if isinstance(error, DeviceGone) else gone
                if give_up.passed:
                    raise gone or error from None
                give_up.sleep(pause_s)
                pause_s = min(1.0, 2 * pause_s)

    def _open(self, deadline: Deadline) -> Body:
        """The first body. Its cable may just be plugged in; but who else uses the camera may do so for hours."""
        give_up = deadline.within(self._timing.come_back_s)
        while True:
            try:
                return self._reopen(deadline)
            except DeviceGone:
                if give_up.passed:
                    raise
                give_up.sleep(0.2)

    def _check_open(self) -> None:
        if self._closed:
            raise DeviceGone(
                "camera-closed", what="The camera's connection was closed.", remedy="Open the camera again."
            )

    def _link_broken(self) -> bool:
        return self._channel is None or self._channel.link.broken

    def _reopen(self, deadline: Deadline) -> Body:
        if self._channel is not None:
            self._channel.link.close()
        link = self._connect(deadline)
        try:
            self._channel = Channel(link, self._timing, self._diary, operations=frozenset({Operation.GET_DEVICE_INFO}))
            reply = self._channel.once(Operation.OPEN_SESSION, _SESSION, deadline=deadline)
            if not reply.ok and reply.code != Answer.SESSION_ALREADY_OPEN:
                raise refused(reply, "open a session")
            info = device_info(self._channel, deadline)
            self._check_serial(info)
            self._channel = Channel(
                link, self._timing, self._diary, operations=info.operations, properties=info.properties
            )
            self._channel.exposing_until_s = self._exposing_until_s
            body = choose_body(self._channel, info, self._storage)
            body.prepare(deadline=deadline)
            if self._settings is not None:
                body.configure(self._settings, deadline=deadline)
            # ``close`` does not wait for this thread without limit, so a link opened after it must be closed here.
            self._check_open()
        except BaseException:
            link.close()
            raise
        self._body = body
        self._capabilities = body.capabilities
        return body

    def _check_serial(self, info: DeviceInfo) -> None:
        """A calibration is for one camera, so refuse another one at the same address."""
        if self._serial and info.serial != self._serial:
            raise DeviceRefused(
                "camera-other",
                what=f"The connected camera has the serial number {info.serial or '(none)'}, not {self._serial}.",
                remedy="Connect the right camera, or change serial in stage.toml and recalibrate.",
            )
        self._serial = self._serial or info.serial


def _still_time(deadline: Deadline) -> None:
    deadline.check(
        "camera-no-answer",
        what="There was no time left to ask the camera.",
        remedy="Give it more time, then try again.",
    )
