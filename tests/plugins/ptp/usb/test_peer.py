"""Our PTP-over-USB client on libgphoto2's virtual camera, by its port layer: containers by other authors."""

from __future__ import annotations

import ctypes
import gc
import os
import threading
import time
from array import array
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from hal.codecs.ptp.datasets import DeviceInfo
from hal.codecs.ptp.usb import ClassRequest
from hal.codecs.ptp.values import Operation, parse_handles
from hal.deadline import Deadline, in_seconds
from hal.values import ExposureSettings
from plugins.ptp.link import camera_lost
from plugins.ptp.shot import Timing
from plugins.ptp.still import PtpCamera
from plugins.ptp.usb.link import PtpUsbLink

JPEG = b"\xff\xd8\xff\xe0\0\x10JFIF\0" + bytes(range(256)) * 5000 + b"\xff\xd9"
_TIMEOUT = -10
_LIBRARY = "libgphoto2_port.so.12"


class PortPipes:
    """``plugins.ptp.usb.pipes.Pipes`` on libgphoto2's port layer, whose virtual USB bus has no packets."""

    packet = 512

    def __init__(self, library: ctypes.CDLL) -> None:
        self._library = library
        self._lock = threading.Lock()
        self._port = ctypes.c_void_p()
        infos, info = ctypes.c_void_p(), ctypes.c_void_p()
        self._must(library.gp_port_info_list_new(ctypes.byref(infos)))
        self._must(library.gp_port_info_list_load(infos))
        self._must(library.gp_port_info_list_get_info(infos, 0, ctypes.byref(info)))
        self._must(library.gp_port_new(ctypes.byref(self._port)))
        self._must(library.gp_port_set_info(self._port, info))
        self._must(library.gp_port_open(self._port))

    def read(self, buffer: array[int], seconds: float) -> int:
        place = (ctypes.c_char * len(buffer)).from_buffer(buffer)
        with self._lock:
            count = self._must(self._library.gp_port_read(self._port, place, len(buffer)))
        if count == 0:
            time.sleep(seconds)
        return count

    def write(self, data: bytes, seconds: float) -> int:
        if not data:
            return 0
        with self._lock:
            return self._must(self._library.gp_port_write(self._port, data, len(data)))

    def read_event(self, seconds: float) -> bytes:
        place = ctypes.create_string_buffer(64)
        with self._lock:
            count = self._library.gp_port_check_int(self._port, place, 64)
        if count in (0, _TIMEOUT):
            time.sleep(min(seconds, 0.005))
            return b""
        return place.raw[: self._must(count)]

    def send_request(self, request: ClassRequest, data: bytes, seconds: float) -> None:
        with self._lock:
            self._library.gp_port_usb_msg_class_write(self._port, int(request), 0, 0, data, len(data))

    def class_request(self, request: ClassRequest, count: int, seconds: float) -> bytes:
        place = ctypes.create_string_buffer(count)
        with self._lock:
            got = self._must(self._library.gp_port_usb_msg_class_read(self._port, int(request), 0, 0, place, count))
        return place.raw[:got]

    def clear_halts(self) -> None:
        return

    def close(self) -> None:
        with self._lock:
            self._library.gp_port_close(self._port)
            self._library.gp_port_free(self._port)

    def _must(self, result: int) -> int:
        if result < 0:
            raise camera_lost(f"libgphoto2_port says {result}")
        return result


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ctypes.CDLL]:
    gc.collect()  # a virtual camera that is still open keeps its folder for the next one
    folder = tmp_path_factory.mktemp("vcamera")
    (folder / "GPH_0001.JPG").write_bytes(JPEG)
    spec = find_spec("gphoto2")
    assert spec is not None
    assert spec.origin is not None
    wheel = Path(spec.origin).parent / "libgphoto2"
    before = dict(os.environ)
    os.environ.update(VCAMERADIR=str(folder), IOLIBS=str(wheel / "vusb"))
    yield ctypes.CDLL(str(wheel / _LIBRARY))
    os.environ.clear()
    os.environ.update(before)


@pytest.fixture
def link(library: ctypes.CDLL) -> Iterator[PtpUsbLink]:
    link = PtpUsbLink.over(PortPipes(library), deadline=in_seconds(20))
    yield link
    link.close()


def ask(link: PtpUsbLink, *request: int, **options: Any) -> bytes:
    reply = link.transact(*request, deadline=in_seconds(20), **options)
    assert reply.ok, hex(reply.code)
    return reply.data


def test_it_tells_what_it_is_and_what_it_holds(link: PtpUsbLink) -> None:
    ask(link, Operation.OPEN_SESSION, 1)
    info = DeviceInfo.parse(ask(link, Operation.GET_DEVICE_INFO))
    assert info.model == "VC"
    assert Operation.INITIATE_CAPTURE in info.operations
    handles = parse_handles(ask(link, Operation.GET_OBJECT_HANDLES, 0xFFFF_FFFF, 0, 0))
    sizes = [len(ask(link, Operation.GET_OBJECT, handle)) for handle in handles[-1:]]
    assert sizes == [len(JPEG)]
    ask(link, Operation.CLOSE_SESSION)


def test_our_whole_driver_takes_pictures_with_it(library: ctypes.CDLL, tmp_path: Path) -> None:
    def connect(deadline: Deadline) -> PtpUsbLink:
        return PtpUsbLink.over(PortPipes(library), deadline=deadline)

    timing = Timing(grace_s=0.2, margin_s=2.0)
    camera = PtpCamera(connect, timing=timing, deadline=in_seconds(20))
    try:
        assert camera.identity(deadline=in_seconds(20)).maker == "GP"
        confirmed = camera.configure(ExposureSettings(0.02, 100, 5.6, raw=False), deadline=in_seconds(20))
        assert (confirmed.exposure_s, confirmed.aperture_f) == (0.02, 5.6)
        for number in range(3):
            files = camera.capture(tmp_path / f"shot{number}", deadline=in_seconds(20))
            assert [file.path.read_bytes() == JPEG for file in files] == [True]
        assert camera.status(deadline=in_seconds(20)).battery_percent == 50
    finally:
        camera.close()
