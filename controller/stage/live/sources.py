"""Where live targets come from: a folder that fills, a running render, a video file."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

import cv2
import numpy as np

from controller.core.arrays import ByteImage
from controller.core.errors import UsageError
from controller.core.files import UnfitFile, check_pixels, read_picture_bytes
from controller.optics.solve.targets.colour import Unsuitable, embedded_profile
from controller.optics.solve.targets.files import check_picture, read_picture
from controller.optics.solve.targets.values import linear_to_srgb

PICTURES: Final = (".png", ".jpg", ".jpeg", ".exr")
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
    """A video file, at its own rate; frames whose time has passed are skipped, and counted."""

    def __init__(self, path: Path, *, loop: bool) -> None:
        """Raises UsageError("live-source-unreadable")."""
        self._path, self._loop = path, loop
        # Errors of a file are reported in our words; its decoder would write its own to the terminal.
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
        self._capture = cv2.VideoCapture(str(path))
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
        self.rate_hz = rate
        count = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        # the last frame is shown however late it is; some files don't tell how many they have
        self._last = count - 1 if count > 0 and not loop else None
        self._at = -1
        self._before = 0
        self._ended = False

    def next(self, at_s: float) -> LivePicture | None:
        """See ``LiveSource``."""
        due = int(at_s * self.rate_hz)
        if self._last is not None:
            self._ended = self._ended or (due > self._last and self._at >= self._last)
            due = min(due, self._last)
        skipped = 0
        found: ByteImage | None = None
        while self._at < due and not self._ended:
            # only the frame that is due is decoded; those before it are passed over
            if not self._capture.grab():
                self._rewind()
                continue
            self._at += 1
            if self._at == due:
                got, image = self._capture.retrieve()
                found = np.ascontiguousarray(image[..., ::-1]) if got else None
            else:
                skipped += 1
        return None if found is None else LivePicture(found, self._at, skipped)

    def _rewind(self) -> None:
        if not self._loop or self._at + 1 == self._before:
            self._ended = True
            return
        self._before = self._at + 1
        self._capture.release()
        self._capture = cv2.VideoCapture(str(self._path))

    @property
    def ended(self) -> bool:
        """Whether the last frame's time has passed."""
        return self._ended

    def close(self) -> None:
        """Close the file."""
        self._capture.release()


class FolderSource:
    """A folder that fills: always the newest whole picture, by name; those that came between are skipped, and counted.

    With ``loop`` (or ``rate_hz``) the pictures that are there are shown in turn instead, at that rate.
    """

    def __init__(self, folder: Path, *, loop: bool, rate_hz: float, clock: Callable[[], float] = time.time) -> None:
        self._folder, self._loop, self._rate_hz, self._clock = folder, loop, rate_hz, clock
        self._last: tuple[str, int] | None = None
        self._shown = -1
        self._known = 0

    def next(self, at_s: float) -> LivePicture | None:
        """See ``LiveSource``. Once it is surely whole, a damaged picture raises UsageError, but only once.

        "target-unreadable", or "target-not-finite" where it has NaN or infinite pixels.
        """
        names = sorted(path for path in self._folder.iterdir() if path.suffix.lower() in PICTURES)
        if not names:
            return None
        # Whoever fills the folder may clear it, too.
        with contextlib.suppress(FileNotFoundError):
            return self._of(names, at_s)
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


def _has_own_colours(path: Path, data: bytes) -> bool:
    """Whether the picture says what its colours mean, so that they are not simply sRGB."""
    try:
        return embedded_profile(data) is not None
    except Unsuitable as error:
        raise unreadable(path, str(error)) from error


def _as_srgb(path: Path) -> ByteImage:
    if path.suffix.lower() != ".exr":
        try:
            data = read_picture_bytes(path)
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
        except FileNotFoundError:
            raise
        except OSError as error:
            raise unreadable(path, str(error.strerror)) from error
        except cv2.error:
            image = None
        if image is None or not (b"IEND" in data[-4096:] or b"\xff\xd9" in data[-4096:]):
            read_picture(path)  # tells what is wrong with it
            raise unreadable(path, "one of its pictures could not be decoded")
        if not _has_own_colours(path, data):
            return np.ascontiguousarray(image[..., ::-1])
    light = read_picture(path)[..., :3]
    check_picture(path, light, (light.shape[1], light.shape[0]))
    return np.round(linear_to_srgb(light) * np.float32(255)).astype(np.uint8)
