"""Search and notifications of PJLink class 2, over loopback UDP."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from hal.codecs.projectors.pjlink import InputChanged, LinkUp, PowerChanged, TroubleChanged
from hal.deadline import Cancelled, in_seconds
from hal.errors import DeviceBusy, DeviceGone, DeviceTimeout
from hal.values import Power
from lab.emulated.projectors.pjlink import EmulatedPjLinkUdp, PjLinkOddities
from plugins.emulated.projectors.lamp import EmulatedLamp, LampTiming
from plugins.finding.network import FoundProjector, PjLinkListener

MAC = "02:00:00:00:00:0a"


@pytest.fixture
def listener() -> Iterator[PjLinkListener]:
    with PjLinkListener("127.0.0.1", 0) as made:
        yield made


def test_a_search_finds_the_projector_and_its_mac(listener: PjLinkListener) -> None:
    with EmulatedPjLinkUdp(EmulatedLamp(LampTiming(0, 0)), mac=MAC.upper()) as projector:
        found = listener.search(deadline=in_seconds(20), to=projector.address, patience_s=0.3)
    assert found == (FoundProjector("127.0.0.1", MAC),)


def test_a_projector_that_takes_its_time_is_found_and_the_deadline_is_kept(listener: PjLinkListener) -> None:
    with EmulatedPjLinkUdp(EmulatedLamp(LampTiming(0, 0)), mac=MAC, answer_after_s=1.0) as projector:
        assert listener.search(deadline=in_seconds(0.1), to=projector.address) == ()
        assert len(listener.search(deadline=in_seconds(30.0), to=projector.address, patience_s=1.5)) == 1


def test_changes_are_heard_in_order_though_a_search_ran_meanwhile(listener: PjLinkListener) -> None:
    lamp = EmulatedLamp(LampTiming(0.4, 0.4))
    with EmulatedPjLinkUdp(lamp, mac=MAC, controller=("127.0.0.1", listener.port)) as projector:
        assert listener.heard(deadline=in_seconds(20)).notification == LinkUp(MAC)
        lamp.strike()
        listener.search(deadline=in_seconds(20), to=projector.address, patience_s=0.7)
        projector.select_input("32")
        lamp.fail()
        expected = {
            PowerChanged(Power.WARMING),
            PowerChanged(Power.ON),
            PowerChanged(Power.COOLING),
            PowerChanged(Power.OFF),
            TroubleChanged(("lamp-failed",)),
            InputChanged("32"),
        }
        told = [listener.heard(deadline=in_seconds(20)).notification for _ in expected]
    assert set(told) == expected
    assert told[:2] == [PowerChanged(Power.WARMING), PowerChanged(Power.ON)]


def test_noise_on_the_port_is_counted_and_changes_nothing(listener: PjLinkListener) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for data in (b"hello", b"%2POWR=9\r", b"x" * 5000, b"%2SRCH\r", b"%2POWR=1\r"):
            stranger.sendto(data, ("127.0.0.1", listener.port))
    assert listener.heard(deadline=in_seconds(20)).notification == PowerChanged(Power.ON)
    assert listener.ignored == 3


def test_silence_ends_at_the_deadline_and_when_cancelled(listener: PjLinkListener) -> None:
    started = time.monotonic()
    with pytest.raises(DeviceTimeout):
        listener.heard(deadline=in_seconds(0.1))
    stop = threading.Event()
    stop.set()
    with pytest.raises(Cancelled):
        listener.heard(deadline=in_seconds(30, stop))
    with pytest.raises(Cancelled):
        listener.search(deadline=in_seconds(30, stop), to=("127.0.0.1", listener.port))
    assert time.monotonic() - started < 10


def test_a_port_that_is_taken_is_named_and_a_closed_listener_is_gone(listener: PjLinkListener) -> None:
    with pytest.raises(DeviceBusy, match=str(listener.port)):
        PjLinkListener("127.0.0.1", listener.port)
    listener.close()
    with pytest.raises(DeviceGone):
        listener.heard(deadline=in_seconds(20))


def test_a_projector_that_tells_of_itself_before_it_answers_is_understood(open_pjlink: Any) -> None:
    pair = open_pjlink(odd=PjLinkOddities(chatty=True))
    assert pair.driver.status(deadline=in_seconds(20)).power is Power.OFF
    pair.driver.switch_on(deadline=in_seconds(20))
    assert pair.emulator.lamp.strikes == 1
