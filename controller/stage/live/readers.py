"""Connections to streams: RTSP, UDP and cameras by OpenCV, NDI by cyndilib."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from controller.core.arrays import ByteImage
from controller.core.extras import extra_missing
from controller.core.files import UnfitFile, check_pixels
from controller.stage.live.streams import RETRY_S, Lost, Reader, StreamSource, without_password

SILENT_S: Final = 5.0
"""A stream that sends nothing for so long is lost."""
NDI: Final = "ndi://"
POLL_MS: Final = 200


def open_stream(source: str, *, silent_s: float = SILENT_S, retry_s: float = RETRY_S) -> StreamSource:
    """The stream at an address that ``is_stream`` knows; one that is ``silent_s`` without a picture is lost.

    Raises UsageError("extra-missing") for NDI without cyndilib.
    """
    if source.lower().startswith(NDI):
        return StreamSource(source, _ndi(source[len(NDI) :], silent_s), retry_s=retry_s)
    # What OpenCV and FFmpeg have to say comes in our words, and without the address's password.
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    shown = without_password(source)
    return StreamSource(shown, partial(OpenCvReader, source, shown, silent_s), retry_s=retry_s)


class OpenCvReader:
    """An RTSP or UDP stream by FFmpeg, or a camera of this computer by V4L2."""

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

    def read(self) -> ByteImage:
        """See ``Reader``."""
        got, image = self._capture.read()
        if not got or image is None or image.ndim != 3:
            raise Lost("it ended or sent nothing")
        return np.ascontiguousarray(image[..., ::-1], np.uint8)

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
