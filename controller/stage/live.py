"""Where live targets come from: a folder that fills, a video file, a stream of a network or a camera.

Streams come at their own pace. A thread reads them, and the newest picture counts.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, Protocol

import cv2
import numpy as np

from controller.core.arrays import ByteImage
from controller.core.colour import Unsuitable, linear_to_srgb
from controller.core.errors import UsageError
from controller.core.extras import extra_missing
from controller.core.files import UnfitFile, check_pixels
from controller.core.pictures import read_picture_file
from controller.optics.solve.targets import files
from hal.secret_words import concealed

PICTURES: Final = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".exr")
SETTLED_S: Final = 0.2
"""A picture that can't be read and is older than this is damaged, not still being written."""


@dataclass(frozen=True, slots=True)
class LivePicture:
    """``pixels`` (rows, columns, 3) uint8 sRGB; ``number`` its place in the source; ``skipped`` since the last."""

    pixels: ByteImage
    number: int
    skipped: int


class LiveSource(Protocol):
    """Pictures over time."""

    def next(self, at_s: float) -> LivePicture | None:
        """The picture that is due ``at_s`` seconds after the beginning, if it is another than the last; never waits."""

    @property
    def ended(self) -> bool: ...

    def close(self) -> None: ...


class VideoSource:
    """A video file, each frame at its own time; frames whose time has passed are skipped, and counted."""

    def __init__(self, path: Path, *, loop: bool) -> None:
        """Raises UsageError("live-source-unreadable")."""
        self._path, self._loop = path, loop
        # Errors of a file are reported in our words; its decoder would write its own to the terminal.
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
        self._capture = _opened(path)
        _check_colours(path)
        rate = float(self._capture.get(cv2.CAP_PROP_FPS)) if self._capture.isOpened() else 0.0
        if not rate > 0:
            self._capture.release()
            raise unreadable(path, "it is not a video that OpenCV can decode")
        size = (int(self._capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(self._capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
        try:
            check_pixels(path, size)
        except UnfitFile as error:
            self._capture.release()
            raise unreadable(path, error.reason) from error
        self._frame_s = self._step_s = 1 / rate
        self._begins_s = 0.0
        """When this turn of the video began; with ``loop`` there are many."""
        self._first_s: float | None = None
        self._due_s: float | None = None
        """When the frame is due that was read last; None: it has been shown."""
        self._read_s = -self._frame_s
        self._count = 0
        self._ended = False

    def next(self, at_s: float) -> LivePicture | None:
        """See ``LiveSource``."""
        found: ByteImage | None = None
        skipped = -1
        while self._read() <= at_s:
            got, image = self._capture.retrieve()
            found = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8) if got else found
            skipped += 1
            self._due_s = None
            self._count += 1
        # the last frame is shown however late it is
        self._ended = self._ended or (self._due_s == math.inf and found is None and at_s >= self._end_s())
        return None if found is None else LivePicture(found, self._count - 1, skipped)

    def _read(self) -> float:
        """When the next frame is due, in seconds since the beginning; infinite after the last."""
        if self._due_s is not None:
            return self._due_s
        if not self._capture.grab():
            if not self._loop or self._first_s is None:
                self._due_s = math.inf
                return math.inf
            self._begins_s = self._end_s()
            self._first_s, self._read_s = None, self._begins_s - self._frame_s
            self._capture.release()
            self._capture = _opened(self._path)
            return self._read()
        said_s = float(self._capture.get(cv2.CAP_PROP_POS_MSEC)) / 1000
        self._first_s = said_s if self._first_s is None else self._first_s
        due_s = self._begins_s + said_s - self._first_s
        # Streams without a container give no times, or the same for all.
        is_later = due_s > self._read_s
        self._step_s = due_s - self._read_s if is_later else self._frame_s
        self._read_s = self._due_s = self._read_s + self._step_s
        return self._due_s

    def _end_s(self) -> float:
        """The last frame stays as long as the previous one. The length that a file states is often wrong."""
        return self._read_s + self._step_s

    @property
    def ended(self) -> bool:
        """Whether the last frame's time has passed."""
        return self._ended

    def close(self) -> None:
        """Close the file."""
        self._capture.release()


UNLIKE_SRGB: Final = re.compile("2020|2084|2100|428|431|P3|PQ|HLG|XYZ|Adobe|Linear|Log", re.IGNORECASE)


def _opened(path: Path) -> cv2.VideoCapture:
    """Raises UsageError("live-source-unreadable")."""
    try:
        with path.open("rb") as file:
            # by its number: OpenCV takes no name that is not UTF-8
            return cv2.VideoCapture(f"/proc/self/fd/{file.fileno()}")
    except OSError as error:
        raise unreadable(path, str(error.strerror)) from error


def _check_colours(path: Path) -> None:
    """Raises UsageError("live-source-unreadable") where they are not those of sRGB, since OpenCV converts none."""
    from pymediainfo import MediaInfo

    with path.open("rb") as file:
        tracks = MediaInfo.parse(file).video_tracks
    named = [
        name
        for track in tracks
        for name in (track.color_primaries, track.transfer_characteristics, track.matrix_coefficients)
        if name and UNLIKE_SRGB.search(name)
    ]
    if named:
        raise unreadable(path, f"its colours are {', '.join(named)}; convert it to BT.709 without HDR first")


LAST_PICTURE_S: Final = 30.0
"""The last picture of a source that is gone stays for so long; then it is black until the source is back."""


class _Absence:
    """What is shown while a source is gone."""

    def __init__(self) -> None:
        self._since_s: float | None = None
        self.is_black = False

    def back(self) -> None:
        """The source is there."""
        self._since_s, self.is_black = None, False

    def picture(self, what: str, remedy: str, at_s: float) -> LivePicture | None:
        """Black, once, after LAST_PICTURE_S. Raises UsageError("live-source-gone") when called first."""
        if self._since_s is None:
            self._since_s = at_s
            raise UsageError(
                "live-source-gone", what=f"{what} The last picture stays for {LAST_PICTURE_S:g} s.", remedy=remedy
            )
        if self.is_black or at_s - self._since_s < LAST_PICTURE_S:
            return None
        self.is_black = True
        return LivePicture(np.zeros((2, 2, 3), np.uint8), -1, 0)


class FolderSource:
    """A folder that fills: always the newest whole picture, by name; those that came between are skipped, and counted.

    With ``loop`` (or ``rate_hz``) the pictures that are there are shown in turn instead, at that rate.
    """

    def __init__(self, folder: Path, *, loop: bool, rate_hz: float, clock: Callable[[], float] = time.time) -> None:
        self._folder, self._loop, self._rate_hz, self._clock = folder, loop, rate_hz, clock
        self._last: tuple[str, int] | None = None
        self._shown = -1
        self._known = 0
        self._absence = _Absence()

    def next(self, at_s: float) -> LivePicture | None:
        """See ``LiveSource``. Once it is surely whole, a damaged picture raises UsageError, but only once.

        "target-unreadable", or "target-not-finite" where it has NaN or infinite pixels. "live-source-gone" once for
        each time that the folder is gone: a stick that was pulled out, a server that does not answer.
        """
        try:
            names = sorted(path for path in self._folder.iterdir() if path.suffix.lower() in PICTURES)
            if self._absence.is_black:
                self._last, self._shown = None, -1
            self._absence.back()
            # The program that fills the folder may clear it, too.
            with contextlib.suppress(FileNotFoundError):
                return self._of(names, at_s) if names else None
        except OSError as error:
            return self._absence.picture(
                f"The folder {self._folder} can't be read ({error.strerror}).",
                "Connect its disk or share again; it is shown again by itself.",
                at_s,
            )
        return None

    def _of(self, names: Sequence[Path], at_s: float) -> LivePicture | None:
        if self._loop:
            turn = int(at_s * self._rate_hz)
            if turn == self._shown:
                return None
            skipped, self._shown = max(turn - self._shown - 1, 0), turn
            return LivePicture(_as_srgb(names[turn % len(names)]), turn, skipped)
        newest = names[-1]
        mark = (newest.name, newest.stat().st_mtime_ns)
        if mark == self._last:
            return None
        try:
            pixels = _as_srgb(newest)
        except UsageError:
            # half written: it is read again, unless it has not changed for a while
            if self._clock() - mark[1] / 1e9 > SETTLED_S:
                self._last = mark
                raise
            return None
        skipped = max(len(names) - self._known - 1, 0) if self._last is not None else 0
        self._last, self._known = mark, len(names)
        self._shown += 1 + skipped
        return LivePicture(pixels, self._shown, skipped)

    @property
    def ended(self) -> bool:
        """A folder may always fill."""
        return False

    def close(self) -> None:
        """Nothing is open."""


def open_source(path: Path, *, loop: bool, rate_hz: float) -> LiveSource:
    """A folder or a video file. Raises UsageError("live-source-unreadable")."""
    if path.is_dir():
        return FolderSource(path, loop=loop, rate_hz=rate_hz)
    if not path.is_file():
        raise unreadable(path, "it does not exist")
    return VideoSource(path, loop=loop)


def fitted(picture: ByteImage, size: tuple[int, int]) -> ByteImage:
    """A picture (rows, columns, 3) scaled to ``size`` (width, height)."""
    if picture.shape[1::-1] == size:
        return picture
    smaller = picture.shape[1] > size[0]
    return np.asarray(
        cv2.resize(picture, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR), np.uint8
    )


def unreadable(path: Path, why: str) -> UsageError:
    """The error of a source that can't be used."""
    return UsageError(
        "live-source-unreadable",
        what=f"{path} can't be used as a stream of targets: {why}.",
        remedy=f"Give a video file, or a folder with {', '.join(PICTURES)} pictures as seen from the camera.",
    )


def _as_srgb(path: Path) -> ByteImage:
    """(rows, columns, 3) uint8, black where the picture is transparent. Raises UsageError, FileNotFoundError."""
    path.stat()
    if path.suffix.lower() != ".exr":
        try:
            return read_picture_file(path).bytes_shown()
        except Unsuitable as error:
            raise files.unreadable(path, error) from error
    light = files.read_picture(path)[..., :3]
    files.check_picture(path, light, (light.shape[1], light.shape[0]))
    return np.round(linear_to_srgb(light) * np.float32(255)).astype(np.uint8)


RETRY_S: Final = 2.0
"""From a loss to the next attempt."""
FIRST_S: Final = 15.0
"""A stream must have shown a picture by then, or it is refused."""
CLOSE_S: Final = 2.0
"""A reader that hangs in a library is left behind after that; it ends by itself."""
_SCHEME: Final = re.compile(r"(?:rtsps?|rtmps?|rtp|udp|tcp|srt|https?|ndi)://\S.*", re.IGNORECASE)
_CAMERA: Final = re.compile(r"/dev/video\d+")
_PASSWORD: Final = re.compile(r"^((?!ndi:)[a-z]+://)[^/@]*@", re.IGNORECASE)


class Lost(Exception):
    """A stream that can't be opened or read; ``str`` says why, in a few words."""


class Reader(Protocol):
    """One connection to a stream."""

    def read(self) -> ByteImage:
        """The next picture, (rows, columns, 3) RGB uint8. Waits a few seconds at most, then raises Lost."""

    def close(self) -> None: ...


def is_stream(source: str) -> bool:
    """Whether ``source`` is the address of a stream and no file or folder."""
    return bool(_SCHEME.fullmatch(source) or _CAMERA.fullmatch(source))


def without_password(source: str) -> str:
    """The address as messages show it."""
    return concealed(_PASSWORD.sub(r"\1", source))


class StreamSource:
    """``LiveSource`` of a stream. It never waits, and never ends: a lost stream is opened again every ``RETRY_S``.

    Meanwhile the last picture stays for LAST_PICTURE_S, then it is black.
    """

    def __init__(self, name: str, open_it: Callable[[], Reader], *, retry_s: float = RETRY_S) -> None:
        """``open_it``: connects; it may wait a few seconds, then raises Lost. ``name``: for messages."""
        self._name, self._open, self._retry_s = name, open_it, retry_s
        self._changed = threading.Condition()
        self._stopped = threading.Event()
        self._newest: ByteImage | None = None
        self._count = self._given = 0
        self._there = False
        self._absence = _Absence()
        self._why = "nothing was received"
        # A daemon, so that a library that hangs does not keep the program from ending.
        self._thread = threading.Thread(target=self._run, name="live stream", daemon=True)
        self._thread.start()

    def wait_for_picture(self, timeout_s: float = FIRST_S) -> None:
        """Return once a picture has come. Raises UsageError("live-source-unreadable") if none does in time."""
        with self._changed:
            if self._changed.wait_for(lambda: self._count > 0, timeout_s):
                return
            why = self._why
        raise UsageError(
            "live-source-unreadable",
            what=f"No picture came from {self._name} ({why}).",
            remedy="Check the address, and that the other program sends.",
        )

    def next(self, at_s: float) -> LivePicture | None:
        """See ``LiveSource``. Raises UsageError("live-source-gone") once for each time that the stream was lost."""
        with self._changed:
            if self._count != self._given and self._newest is not None:
                skipped = self._count - self._given - 1 if self._given else 0
                self._given = self._count
                self._absence.back()
                return LivePicture(self._newest, self._count - 1, skipped)
            if self._there or not self._count:
                return None
            why = self._why
        return self._absence.picture(
            f"The stream {self._name} was lost ({why}).",
            "Restart the program or camera that sends it; it is shown again by itself.",
            at_s,
        )

    @property
    def ended(self) -> bool:
        """False: a stream may come back at any time."""
        return False

    def close(self) -> None:
        """Stop reading."""
        self._stopped.set()
        self._thread.join(CLOSE_S)

    def _run(self) -> None:
        while not self._stopped.is_set():
            try:
                with contextlib.closing(self._open()) as reader:
                    while not self._stopped.is_set():
                        self._take(reader.read())
            except Lost as lost:
                with self._changed:
                    self._there, self._why = False, str(lost)
                self._stopped.wait(self._retry_s)

    def _take(self, picture: ByteImage) -> None:
        with self._changed:
            self._newest, self._there = picture, True
            self._count += 1
            self._changed.notify_all()


SILENT_S: Final = 5.0
"""A stream that sends nothing for so long is lost."""
NDI: Final = "ndi://"
POLL_MS: Final = 200


def open_stream(source: str, *, silent_s: float = SILENT_S, retry_s: float = RETRY_S) -> StreamSource:
    """The stream at an address that ``is_stream`` knows; one that is ``silent_s`` without a picture is lost.

    Raises UsageError("extra-missing") for NDI without cyndilib, and "live-source-unreadable" for SRT.
    """
    if source.lower().startswith(NDI):
        return StreamSource(source, _ndi(source[len(NDI) :], silent_s), retry_s=retry_s)
    if source.lower().startswith("srt:"):
        raise UsageError(
            "live-source-unreadable",
            what="SRT can't be read: the FFmpeg in OpenCV has no part for it.",
            remedy="Forward it: `ffmpeg -i ADDRESS -c copy -f mpegts udp://127.0.0.1:5000`, and give udp://@:5000.",
        )
    # What OpenCV and FFmpeg have to say comes in our words, and without the address's password.
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    shown = without_password(source)
    return StreamSource(shown, partial(OpenCvReader, source, shown, silent_s), retry_s=retry_s)


_WITHOUT_LIMIT: Final = "fifo_size=50000&overrun_nonfatal=1"
"""Of UDP: FFmpeg would end a stream whose packets wait too long for a busy computer; now some are lost."""


class OpenCvReader:
    """A stream of a network by FFmpeg, or a camera of this computer by V4L2.

    A file that a server sends as fast as it can is shown at its own pace, and again from its beginning.
    """

    def __init__(self, source: str, shown: str, silent_s: float) -> None:
        """Raises Lost."""
        camera = source.startswith("/dev/")
        if camera:
            if not Path(source).exists():
                raise Lost("there is no such device")
            os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", str(max(1, int(silent_s))))
            self._capture = cv2.VideoCapture(source, cv2.CAP_V4L2)
        else:
            wait_ms = int(1000 * silent_s)
            if source.lower().startswith("udp:") and "overrun_nonfatal" not in source:
                source += ("&" if "?" in source else "?") + _WITHOUT_LIMIT
            limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, wait_ms, cv2.CAP_PROP_READ_TIMEOUT_MSEC, wait_ms]
            self._capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, limits)
        if not self._capture.isOpened():
            raise Lost("it can't be opened")
        size = (int(self._capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(self._capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
        try:
            check_pixels(Path(shown), size)
        except UnfitFile as error:
            self._capture.release()
            raise Lost(error.reason) from error
        # A live stream has its sender's pace, and no length.
        self._is_file = float(self._capture.get(cv2.CAP_PROP_FRAME_COUNT)) > 0
        self._began_s = time.monotonic()

    def read(self) -> ByteImage:
        """See ``Reader``."""
        got, image = self._capture.read()
        if not got or image is None or image.ndim != 3:
            raise Lost("it ended or sent nothing")
        if self._is_file:
            ahead_s = self._began_s + float(self._capture.get(cv2.CAP_PROP_POS_MSEC)) / 1000 - time.monotonic()
            time.sleep(min(max(ahead_s, 0.0), 1.0))
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)

    def close(self) -> None:
        """Disconnect."""
        self._capture.release()


def _ndi(name: str, silent_s: float) -> Callable[[], Reader]:
    try:
        import cyndilib  # noqa: F401
    except ImportError as error:
        missing = extra_missing("cyndilib")
        raise (missing or error) from error
    return partial(NdiReader, name, silent_s)


class NdiReader:
    """A source of NDI by its name, "COMPUTER (SOURCE)" as NDI's own programs show it."""

    def __init__(self, name: str, silent_s: float) -> None:
        """Raises Lost."""
        from cyndilib.finder import Finder
        from cyndilib.receiver import Receiver
        from cyndilib.video_frame import VideoRecvFrame
        from cyndilib.wrapper.ndi_recv import RecvBandwidth, RecvColorFormat

        self._silent_s = silent_s
        self._finder: Any = Finder()
        self._finder.open()
        source = self._found(name)
        self._frame: Any = VideoRecvFrame()
        self._receiver: Any = Receiver(color_format=RecvColorFormat.RGBX_RGBA, bandwidth=RecvBandwidth.highest)
        self._receiver.set_video_frame(self._frame)
        self._receiver.set_source(source)

    def _found(self, name: str) -> Any:
        until_s = time.monotonic() + self._silent_s
        while True:
            found = {str(one): self._finder.get_source(one) for one in self._finder.get_source_names()}
            if name in found:
                return found[name]
            if time.monotonic() > until_s:
                self._finder.close()
                raise Lost(f"there is no such source; found: {', '.join(found) or 'none'}")
            self._finder.wait_for_sources(POLL_MS / 1000)

    def read(self) -> ByteImage:
        """See ``Reader``."""
        from cyndilib.receiver import ReceiveFrameType

        until_s = time.monotonic() + self._silent_s
        while time.monotonic() < until_s:
            got = self._receiver.receive(ReceiveFrameType.recv_video, POLL_MS)
            if not got & ReceiveFrameType.recv_video:
                continue
            width, height = self._frame.get_resolution()
            try:
                check_pixels(Path("NDI"), (width, height))
            except UnfitFile as error:
                raise Lost(error.reason) from error
            data = np.empty(self._frame.get_buffer_size(), np.uint8)
            if not self._frame.fill_p_data(data):
                continue
            return np.ascontiguousarray(data.reshape(height, -1)[:, : 4 * width].reshape(height, width, 4)[..., :3])
        raise Lost("it ended or sent nothing")

    def close(self) -> None:
        """Disconnect."""
        self._receiver.disconnect()
        self._finder.close()
