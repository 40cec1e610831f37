"""hidapi, and our drivers on it, with emulated boards and sensors: what works, and what goes wrong on a real bus."""

from __future__ import annotations

import importlib
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from controller.stage.rig.ambient_light import AmbientLightLimit
from hal.conformance import LightSensorConformance, PowerSwitchConformance
from hal.deadline import Cancelled, in_seconds
from hal.errors import DeviceBusy, DeviceError, DeviceGone, DeviceRefused, DeviceTimeout, ProtocolError
from lab.emulated.usb.process import UsbBusProcess
from plugins.emulated.bench import EmulatedBench
from plugins.hid.light_sensor import ColorHugLightSensor
from plugins.hid.link import BACKENDS
from plugins.hid.relay import RelayBoard

BOTH = pytest.mark.parametrize("backend", sorted(BACKENDS))
OpenRelay = Callable[..., RelayBoard]


@pytest.fixture
def open_relay() -> Iterator[OpenRelay]:
    opened: list[RelayBoard] = []

    def make(**settings: Any) -> RelayBoard:
        opened.append(RelayBoard(deadline=in_seconds(20), **settings))
        return opened[-1]

    yield make
    for board in opened:
        board.close()


class TestRelayBoard(PowerSwitchConformance):
    @pytest.fixture(params=sorted(BACKENDS))
    def power_switch(self, bus: UsbBusProcess, open_relay: OpenRelay, request: pytest.FixtureRequest) -> RelayBoard:
        bus.add("relay", "relay", channels=4)
        return open_relay(backend=request.param)


class TestLightSensor(LightSensorConformance):
    @pytest.fixture(params=sorted(BACKENDS))
    def light_sensor(self, bus: UsbBusProcess, request: pytest.FixtureRequest) -> Iterator[ColorHugLightSensor]:
        bus.add("light", "light", lux=2.5)
        sensor = ColorHugLightSensor(backend=request.param, deadline=in_seconds(20))
        yield sensor
        sensor.close()


@BOTH
def test_unchanged_hidapi_lists_opens_and_asks(bus: UsbBusProcess, backend: str) -> None:
    bus.add("relay", "relay", channels=2, serial="ABCDE")
    bus.add("light", "light", lux=12.34)
    module = importlib.import_module(BACKENDS[backend])
    names = {entry["product_string"]: entry for entry in module.enumerate()}
    assert {"USBRelay2", "ColorHugALS"} <= set(names)
    board = module.device()
    board.open_path(names["USBRelay2"]["path"])
    assert bytes(board.get_feature_report(0, 9)) == b"\0ABCDE\0\0\0"
    board.send_feature_report([0, 0xFF, 2, 0, 0, 0, 0, 0, 0])
    assert bus.get("relay", "state") == [False, True]
    board.close()
    sensor = module.device()
    sensor.open_path(names["ColorHugALS"]["path"])
    assert sensor.read(8, 100) == [], "nothing comes unasked at first"
    sensor.send_feature_report([1, 1, 2, 2, 0, 100, 0, 0, 0])
    bus.set("light", "lux", 5.0)
    assert bytes(sensor.read(8, 2000))[3:] == (500).to_bytes(4, "little")
    sensor.close()


@BOTH
def test_the_board_does_what_the_driver_says(bus: UsbBusProcess, open_relay: OpenRelay, backend: str) -> None:
    bus.add("relay", "relay", channels=8, serial="LAMPS")
    board = open_relay(backend=backend)
    assert board.channels(deadline=in_seconds(20)) == 8
    assert board.identity(deadline=in_seconds(20)).serial == "LAMPS"
    board.switch(3, True, deadline=in_seconds(20))
    board.switch(8, True, deadline=in_seconds(20))
    assert bus.get("relay", "state") == [False, False, True, False, False, False, False, True]


@BOTH
def test_light_follows_the_room(bus: UsbBusProcess, backend: str) -> None:
    bus.add("light", "light", lux=0.0)
    sensor = ColorHugLightSensor(backend=backend, deadline=in_seconds(20))
    for lux in (0.0, 0.37, 500.0, 20_000.0):
        bus.set("light", "lux", lux)
        assert sensor.illuminance_lux(deadline=in_seconds(20)) == pytest.approx(lux, abs=0.005)
    sensor.close()


def test_the_sensor_sees_the_ambient_light_of_an_emulated_stage(bus: UsbBusProcess, tmp_path: Path) -> None:
    EmulatedBench().prepare(tmp_path, size="small", object_file=None, seed=1)
    bus.add("light", "light")
    sensor = ColorHugLightSensor(deadline=in_seconds(20))
    bus.call("light", "follow", str(tmp_path))
    dark_lux = sensor.illuminance_lux(deadline=in_seconds(20))
    assert 0.3 < dark_lux < 1.2
    (tmp_path / "bench" / "bumps.toml").write_text('[[bump]]\nwhat = "ambient"\nfactor = 50.0\n')
    bus.call("light", "follow", str(tmp_path))
    assert sensor.illuminance_lux(deadline=in_seconds(20)) == pytest.approx(50 * dark_lux, rel=0.02)
    with pytest.raises(DeviceRefused) as caught:
        AmbientLightLimit(sensor, 5.0).require(deadline=in_seconds(20))
    assert caught.value.code == "room-not-dark"
    sensor.close()


def test_a_sensor_that_is_not_ready_is_busy_until_the_deadline(bus: UsbBusProcess) -> None:
    bus.add("light", "light", lux=1.0)
    sensor = ColorHugLightSensor(deadline=in_seconds(20))
    bus.set("light", "state", 5)
    with pytest.raises(DeviceBusy) as caught:
        sensor.illuminance_lux(deadline=in_seconds(3))
    assert caught.value.code == "light-sensor-not-ready"
    threading.Timer(0.2, bus.set, ["light", "state", 2]).start()
    assert sensor.illuminance_lux(deadline=in_seconds(20)) == pytest.approx(1.0)
    sensor.close()


def test_a_sensor_that_is_slow_and_not_ready_is_busy_though_its_last_answer_did_not_come_in_time(
    bus: UsbBusProcess,
) -> None:
    bus.add("light", "light", lux=1.0)
    sensor = ColorHugLightSensor(deadline=in_seconds(20))
    bus.set("light", "state", 5)
    bus.set("light", "faults.slow_s", 1.0)  # so that a reading takes 2 s
    with pytest.raises(DeviceBusy):
        sensor.illuminance_lux(deadline=in_seconds(3.6))
    sensor.close()


def asked_until_it_fails(board: RelayBoard) -> None:
    while True:
        board.state(1, deadline=in_seconds(20))


@BOTH
def test_a_board_that_was_pulled_and_is_still_listed_is_gone(
    bus: UsbBusProcess, open_relay: OpenRelay, backend: str
) -> None:
    bus.add("relay", "relay", channels=2)
    board = open_relay(backend=backend)
    bus.set("relay", "faults.lingers_s", 0.7)
    pull = threading.Thread(target=bus.unplug, args=["relay"])
    pull.start()
    with pytest.raises(DeviceGone):
        asked_until_it_fails(board)
    pull.join()


@BOTH
def test_an_unplugged_board_is_gone_and_found_again_with_its_relays_open(
    bus: UsbBusProcess, open_relay: OpenRelay, backend: str
) -> None:
    bus.add("relay", "relay", channels=2)
    board = open_relay(backend=backend)
    board.switch(1, True, deadline=in_seconds(20))
    before = bus.bus("address_of", "relay")
    bus.unplug("relay")
    with pytest.raises(DeviceGone):
        board.state(1, deadline=in_seconds(20))
    bus.plug("relay")
    assert bus.bus("address_of", "relay") != before
    assert board.state(1, deadline=in_seconds(20)) is False, "a fresh answer, not the one of before"


@BOTH
def test_a_silent_board_ends_at_the_deadline_and_works_again(
    bus: UsbBusProcess, open_relay: OpenRelay, backend: str
) -> None:
    bus.add("relay", "relay", channels=2)
    board = open_relay(backend=backend)
    bus.set("relay", "faults.silent", True)
    started = time.monotonic()
    with pytest.raises(DeviceError):
        board.state(1, deadline=in_seconds(0.4))
    assert time.monotonic() - started < 10
    bus.set("relay", "faults.silent", False)
    assert board.state(1, deadline=in_seconds(20)) is False


def test_a_hanging_call_is_left_behind_and_does_not_act_later(bus: UsbBusProcess, open_relay: OpenRelay) -> None:
    bus.add("relay", "relay", channels=2)
    board = open_relay()
    bus.unplug("relay")
    bus.plug("relay")  # so that the board must be opened again, and hangs before the relay gets it
    bus.set("relay", "faults.stuck", True)
    for _ in range(2):
        started = time.monotonic()
        with pytest.raises(DeviceTimeout):
            board.switch(1, True, deadline=in_seconds(0.3))
        assert time.monotonic() - started < 10
    assert sum(thread.name == "hid" for thread in threading.enumerate()) <= 2
    bus.set("relay", "faults.stuck", False)
    assert board.state(1, deadline=in_seconds(20)) is False
    assert bus.get("relay", "switched") == [0, 0]


def test_closing_during_a_hanging_call_does_not_hang(bus: UsbBusProcess, open_relay: OpenRelay) -> None:
    bus.add("relay", "relay", channels=2)
    board = open_relay()
    bus.set("relay", "faults.stuck", True)
    with pytest.raises(DeviceTimeout):
        board.state(1, deadline=in_seconds(0.2))
    started = time.monotonic()
    board.close()
    assert time.monotonic() - started < 10
    bus.set("relay", "faults.stuck", False)


def test_a_hanging_call_can_be_cancelled(bus: UsbBusProcess, open_relay: OpenRelay) -> None:
    bus.add("relay", "relay", channels=2)
    board = open_relay()
    bus.set("relay", "faults.stuck", True)
    stop = threading.Event()
    threading.Timer(0.2, stop.set).start()
    with pytest.raises(Cancelled):
        board.state(1, deadline=in_seconds(30, stop))
    bus.set("relay", "faults.stuck", False)


@BOTH
@pytest.mark.parametrize("fault", ["cut", "garble"])
def test_a_wrong_answer_is_a_protocol_error_and_no_state(
    bus: UsbBusProcess, open_relay: OpenRelay, backend: str, fault: str
) -> None:
    bus.add("relay", "relay", channels=2)
    board = open_relay(backend=backend)
    bus.set("relay", f"faults.{fault}", 1)
    with pytest.raises(ProtocolError):
        board.state(1, deadline=in_seconds(20))
    assert board.state(1, deadline=in_seconds(20)) is False


@BOTH
def test_a_stall_is_tried_once_more(bus: UsbBusProcess, open_relay: OpenRelay, backend: str) -> None:
    bus.add("relay", "relay", channels=2)
    board = open_relay(backend=backend)
    bus.set("relay", "faults.stalls", 1)
    assert board.state(1, deadline=in_seconds(20)) is False


def test_a_welded_relay_is_noticed(bus: UsbBusProcess, open_relay: OpenRelay) -> None:
    bus.add("relay", "relay", channels=2)
    board = open_relay()
    bus.set("relay", "stuck", [2])
    with pytest.raises(DeviceRefused) as caught:
        board.switch(2, True, deadline=in_seconds(20))
    assert caught.value.code == "relay-stuck"


def test_two_boards_are_told_apart_by_serial_number_only(bus: UsbBusProcess, open_relay: OpenRelay) -> None:
    bus.add("one", "relay", channels=2, serial="AAAAA")
    bus.add("two", "relay", channels=2, serial="BBBBB")
    with pytest.raises(DeviceRefused) as caught:
        open_relay()
    assert caught.value.code == "hid-several"
    assert "AAAAA" in caught.value.what
    board = open_relay(serial="BBBBB")
    board.switch(1, True, deadline=in_seconds(20))
    assert bus.get("one", "state") == [False, False]
    assert bus.get("two", "state") == [True, False]


def test_a_silent_board_does_not_keep_another_from_being_used(bus: UsbBusProcess, open_relay: OpenRelay) -> None:
    bus.add("quiet", "relay", channels=2, serial="QUIET")
    bus.add("relay", "relay", channels=2, serial="RIGHT")
    bus.set("quiet", "faults.silent", True)
    board = open_relay(serial="RIGHT")
    board.switch(1, True, deadline=in_seconds(20))
    assert bus.get("relay", "state") == [True, False]
    with pytest.raises(DeviceRefused) as caught:
        open_relay(serial="QUIET")
    assert caught.value.code == "hid-not-opened"


def test_usbrelay_of_debian_takes_the_emulated_board_for_a_real_one(bus: UsbBusProcess) -> None:
    bus.add("relay", "relay", channels=2, serial="PEER1")
    assert subprocess.run(["usbrelay", "PEER1_2=1"], timeout=20, check=False, capture_output=True).returncode == 0
    assert bus.get("relay", "state") == [False, True]
    said = subprocess.run(["usbrelay"], timeout=20, check=False, capture_output=True, text=True).stdout
    assert said.split() == ["PEER1_1=0", "PEER1_2=1"]
    assert subprocess.run(["usbrelay", "PEER1_2=0"], timeout=20, check=False, capture_output=True).returncode == 0
    assert bus.get("relay", "state") == [False, False]


def test_pyhid_usb_relay_takes_the_emulated_board_for_a_real_one(bus: UsbBusProcess) -> None:
    bus.add("relay", "relay", channels=4, serial="PEER2")

    def relay(*words: str) -> str:
        done = subprocess.run(
            [sys.executable, "-m", "pyhid_usb_relay", *words], timeout=20, check=False, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert "ID=[PEER2]" in relay("enum")
    relay("on", "3")
    assert bus.get("relay", "state") == [False, False, True, False]
    assert relay("get", "3").strip() == "on"
    relay("off", "all")
    assert bus.get("relay", "state") == [False] * 4


def test_our_driver_and_usbrelay_see_the_same_board(bus: UsbBusProcess, open_relay: OpenRelay) -> None:
    bus.add("relay", "relay", channels=2, serial="SHARE")
    board = open_relay()
    subprocess.run(["usbrelay", "SHARE_1=1"], timeout=20, check=True, capture_output=True)
    assert board.state(1, deadline=in_seconds(20)) is True


NOISE = "seed = 3\n" + "".join(
    f'[[event]]\ndo = "{deed}"\nprobability = {share}\nfor_s = {for_s}\n'
    for deed, share, for_s in (("cut", 0.03, 0), ("silence", 0.03, 0), ("garbage", 0.03, 0), ("unplug", 0.01, 0.05))
)


def test_every_call_ends_in_a_noisy_hour_of_a_board(bus: UsbBusProcess, open_relay: OpenRelay) -> None:
    bus.add("relay", "relay", channels=2)
    board = open_relay()
    bus.play("relay", NOISE)
    failures: list[DeviceError] = []
    for number in range(150):
        started = time.monotonic()
        try:
            board.switch(1, bool(number % 2), deadline=in_seconds(3.0))
        except DeviceError as error:
            failures.append(error)
            time.sleep(0.05)
        assert time.monotonic() - started < 10
    assert all(failure.remedy for failure in failures)
    assert 5 < len(failures) < 75
    assert {"cut", "silence", "garbage", "unplug"} == {deed for _, deed in bus.happened("relay")}
