"""The PTP camera driver between threads: one waits for another, or closes what another uses, or tells it something."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from types import FrameType
from typing import Any

import pytest

from hal.deadline import Cancelled, Deadline, in_seconds
from hal.errors import DeviceError, DeviceGone, DeviceTimeout
from lab.emulated.cameras.camera import EmulatedPtpCamera
from plugins.ptp.ip import PtpIpAddress, PtpIpLink
from plugins.ptp.link import MOST_IN_MEMORY, Diary, Reply, Sink
from plugins.ptp.still import PtpCamera
from tests.plugins.ptp.ptp_rig import PATIENT, Studio


class HeldLink(PtpIpLink):
    """A link whose next transaction waits after ``hold`` until ``go``; ``crowded``: two were on it at once."""

    hold = threading.Event()
    held = threading.Event()
    go = threading.Event()
    inside = 0
    crowded = False

    def transact(
        self,
        operation: int,
        *parameters: int,
        data: bytes | None = None,
        sink: Sink | None = None,
        most: int = MOST_IN_MEMORY,
        deadline: Deadline,
    ) -> Reply:
        self.crowded = self.crowded or self.inside > 0
        self.inside += 1
        if self.hold.is_set() and not self.held.is_set():
            self.held.set()
            assert self.go.wait(30)
        try:
            return super().transact(operation, *parameters, data=data, sink=sink, most=most, deadline=deadline)
        finally:
            self.inside -= 1


class Stand:
    """A driver whose links are kept; ``before`` is called before a new one is made."""

    def __init__(self, emulator: EmulatedPtpCamera) -> None:
        for event in (HeldLink.hold, HeldLink.held, HeldLink.go):
            event.clear()
        self.address = PtpIpAddress.parse(emulator.address)
        self.links: list[HeldLink] = []
        self.closes_meanwhile = False
        self.driver = PtpCamera(self.connect, timing=PATIENT, deadline=in_seconds(20))

    def connect(self, deadline: Deadline) -> HeldLink:
        if self.closes_meanwhile:
            closer = threading.Thread(target=self.driver.close)
            closer.start()
            closer.join()
        self.links.append(HeldLink.connect(self.address, deadline=deadline))
        return self.links[-1]


@pytest.fixture
def stand() -> Iterator[Stand]:
    with EmulatedPtpCamera(Studio().expose, flavour="eos-new", time_scale=0.2) as emulator:
        stand = Stand(emulator)
        yield stand
        HeldLink.go.set()
        stand.driver.close()


@pytest.fixture
def busy(stand: Stand) -> Iterator[Stand]:
    """Another thread is on the link, and stays there until ``go``."""
    HeldLink.hold.set()
    with ThreadPoolExecutor(1) as pool:
        other = pool.submit(stand.driver.status, deadline=in_seconds(60))
        assert HeldLink.held.wait(30)
        yield stand
        HeldLink.go.set()
        assert other.exception() is None or isinstance(other.exception(), DeviceError)


def test_whoever_waits_for_another_callers_answer_keeps_his_own_deadline(busy: Stand) -> None:
    with ThreadPoolExecutor(1) as pool:
        late = pool.submit(busy.driver.status, deadline=in_seconds(0.05))
        try:
            assert isinstance(late.exception(timeout=10), DeviceTimeout)
        finally:
            HeldLink.go.set()


def test_whoever_waits_for_another_callers_answer_can_be_stopped(busy: Stand) -> None:
    cancel = threading.Event()
    cancel.set()
    with ThreadPoolExecutor(1) as pool:
        stopped = pool.submit(busy.driver.status, deadline=in_seconds(60, cancel))
        try:
            assert isinstance(stopped.exception(timeout=10), Cancelled)
        finally:
            HeldLink.go.set()


def test_closing_says_nothing_on_a_link_that_another_thread_is_using(busy: Stand) -> None:
    busy.driver.close()
    assert busy.links[0].broken
    assert not busy.links[0].crowded


def test_a_camera_that_is_closed_while_it_is_opened_again_is_let_go(stand: Stand) -> None:
    stand.links[0].close()
    stand.closes_meanwhile = True
    with pytest.raises(DeviceGone) as caught:
        stand.driver.status(deadline=in_seconds(30))
    assert caught.value.code == "camera-closed"
    assert len(stand.links) == 2
    assert all(link.broken for link in stand.links)


def test_a_note_that_comes_while_the_others_are_taken_is_told_the_next_time() -> None:
    diary, added = Diary(), 0

    def interrupt(frame: FrameType, event: str, argument: Any) -> Any:
        """Between any two lines of ``take`` another thread may run."""
        nonlocal added
        if frame.f_code is not Diary.take.__code__:
            return None
        if event == "line":
            added += 1
            diary.add("mended", f"note {added}")
        return interrupt

    former = sys.gettrace()
    sys.settrace(interrupt)
    try:
        told = diary.take()
    finally:
        sys.settrace(former)
    told += diary.take()
    assert added > 0
    assert [notice.what for notice in told] == [f"note {number}" for number in range(1, added + 1)]
