"""A PTP camera on USB that is closed by one thread while another waits for its answer."""

from __future__ import annotations

import threading
from array import array
from concurrent.futures import ThreadPoolExecutor

from hal.codecs.ptp.usb import ClassRequest
from hal.codecs.ptp.values import Operation
from hal.deadline import in_seconds
from hal.errors import DeviceGone
from plugins.ptp.usb.link import PtpUsbLink
from plugins.ptp.usb.pipes import PipeStalled


class HeldPipes:
    """``plugins.ptp.usb.pipes.Pipes`` to a camera that answers nothing; a read lasts until ``go`` once one is held."""

    packet = 512

    def __init__(self) -> None:
        self.asked = False
        self.held, self.go = threading.Event(), threading.Event()
        self.cancelled = False
        self.reading = False
        self.closed = False
        self.closed_under_a_read = False

    def read(self, buffer: array[int], seconds: float) -> int:
        if self.asked:
            self.reading = True
            self.held.set()
            assert self.go.wait(30)
            self.reading = False
        return 0

    def write(self, data: bytes, seconds: float) -> int:
        self.asked = True
        return len(data)

    def read_event(self, seconds: float) -> bytes:
        return b""

    def send_request(self, request: ClassRequest, data: bytes, seconds: float) -> None:
        assert not self.closed
        self.cancelled = self.cancelled or request is ClassRequest.CANCEL

    def class_request(self, request: ClassRequest, count: int, seconds: float) -> bytes:
        raise PipeStalled

    def clear_halts(self) -> None:
        """None is halted."""

    def close(self) -> None:
        self.closed_under_a_read = self.closed_under_a_read or self.reading
        self.closed = True


def test_the_pipes_are_not_closed_under_a_thread_that_reads_but_by_it() -> None:
    pipes = HeldPipes()
    link = PtpUsbLink.over(pipes, deadline=in_seconds(30))
    with ThreadPoolExecutor(1) as pool:
        asking = pool.submit(link.transact, Operation.GET_DEVICE_INFO, deadline=in_seconds(30))
        assert pipes.held.wait(30)
        link.close()
        assert link.broken
        assert not pipes.closed_under_a_read
        pipes.go.set()
        assert isinstance(asking.exception(), DeviceGone)
    assert pipes.closed
    assert pipes.cancelled
    assert not pipes.closed_under_a_read


def test_a_link_that_nobody_uses_is_closed_at_once() -> None:
    pipes = HeldPipes()
    link = PtpUsbLink.over(pipes, deadline=in_seconds(30))
    link.close()
    link.close()
    assert pipes.closed
    assert not pipes.cancelled
