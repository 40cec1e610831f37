"""The serial driver against an emulated projector that misbehaves, over a real pseudo terminal."""

from __future__ import annotations

import itertools
import os
import re
import threading
import time
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from hal.deadline import Deadline, in_seconds
from hal.errors import (
    DeviceBusy,
    DeviceError,
    DeviceGone,
    DeviceRefused,
    DeviceTimeout,
    PluginError,
    ProtocolError,
)
from hal.registry import OpenContext
from hal.serial_link import SerialLink
from hal.values import Power
from plugins.emulated.projectors.board import OptomaBoard, OptomaQuirks
from plugins.emulated.projectors.lamp import EmulatedLamp, LampTiming, quick_profile
from plugins.projectors.profile_files import load_profile, shipped_profiles
from plugins.projectors.serial import SerialProjector, open_serial_projector
from tests.plugins.conftest import hasty, wait_for_power

SOON = 30.0


def test_a_lost_answer_is_asked_again_and_never_mistaken_for_the_next(open_serial: Any) -> None:
    pair = open_serial(edit=hasty)
    pair.emulator.faults.set(drop=1)
    status = pair.driver.status(deadline=in_seconds(SOON))
    assert (status.power, status.lamp_hours) == (Power.OFF, 1200)


def test_a_late_answer_is_not_taken_for_the_answer_to_the_next_question(open_serial: Any) -> None:
    # The model's answer, OK1, would read as the firmware, or as the power state "on".
    pair = open_serial(board=partial(OptomaBoard, quirks=OptomaQuirks(model_code=1)), edit=hasty)
    pair.emulator.faults.set(slow_s=0.6)  # later than the driver waits for an answer (0.4 s)
    who = pair.driver.identity(deadline=in_seconds(SOON))
    assert (who.model[-1], who.firmware) == ("1", "C07")
    pair.emulator.faults.clear()
    assert pair.driver.status(deadline=in_seconds(SOON)).power is Power.OFF


def test_a_silent_projector_is_a_timeout_with_a_remedy_well_before_the_deadline(open_serial: Any) -> None:
    pair = open_serial(edit=hasty)
    pair.emulator.faults.set(silent=True)
    until = in_seconds(60)
    with pytest.raises(DeviceTimeout) as caught:
        pair.driver.status(deadline=until)
    assert caught.value.code == "projector-no-answer"
    assert "power" in caught.value.remedy
    assert until.left_s() > 30


def test_a_deadline_shorter_than_the_projectors_patience_is_kept(open_serial: Any) -> None:
    pair = open_serial(edit=lambda text: re.sub("(answer|late)_s = .*", r"\1_s = 60.0", text))
    pair.emulator.faults.set(silent=True)
    started = time.monotonic()
    with pytest.raises(DeviceTimeout):
        pair.driver.status(deadline=in_seconds(0.2))
    assert time.monotonic() - started < 30


def test_garbage_is_a_protocol_error_and_recovers(open_serial: Any) -> None:
    pair = open_serial(edit=hasty)
    pair.emulator.faults.set(garbage=True)
    with pytest.raises(ProtocolError) as caught:
        pair.driver.status(deadline=in_seconds(SOON))
    assert caught.value.code == "projector-garbage"
    pair.emulator.faults.clear()
    assert pair.driver.status(deadline=in_seconds(SOON)).lamp_hours == 1200


def test_a_wrong_baud_rate_is_reported_as_such(open_serial: Any) -> None:
    pair = open_serial(settings={"baud": 19200}, edit=hasty)
    with pytest.raises(DeviceError) as caught:
        pair.driver.status(deadline=in_seconds(SOON))
    assert "baud rate" in caught.value.remedy


def test_a_busy_projector_is_busy_and_not_broken(open_serial: Any) -> None:
    pair = open_serial()
    pair.emulator.faults.set(busy=True)
    with pytest.raises(DeviceBusy):
        pair.driver.status(deadline=in_seconds(SOON))


def test_on_while_cooling_is_refused_even_by_a_driver_that_did_not_see_it_burn(open_serial: Any) -> None:
    lamp = EmulatedLamp(LampTiming(0.25, 600.0))
    lamp.warm_now()
    lamp.extinguish()
    pair = open_serial(lamp=lamp)
    with pytest.raises(DeviceRefused):
        pair.driver.switch_on(deadline=in_seconds(SOON))
    assert lamp.strikes == 0


def test_a_lost_reply_to_on_strikes_the_lamp_once_and_is_confirmed_by_the_power_state(open_serial: Any) -> None:
    pair = open_serial(edit=hasty)
    pair.driver.status(deadline=in_seconds(SOON))
    # The first answer is to the power question; the second, to the command, is the one to lose.
    original = pair.emulator.faults.loses_this_one
    answers: list[bool] = []

    def lose_the_second() -> bool:
        answers.append(len(answers) == 1)
        return answers[-1] or original()

    pair.emulator.faults.loses_this_one = lose_the_second
    pair.driver.switch_on(deadline=in_seconds(SOON))
    assert pair.emulator.lamp.strikes == 1
    assert sum(entry.data == b"~0000 1\r" for entry in pair.said()) == 1
    assert pair.driver.status(deadline=in_seconds(SOON)).power in (Power.WARMING, Power.ON)


def test_a_lamp_that_does_not_light_is_refused_and_reported(open_serial: Any) -> None:
    pair = open_serial()
    pair.emulator.lamp.fail()
    with pytest.raises(DeviceRefused, match="lamp-failed"):
        pair.driver.switch_on(deadline=in_seconds(SOON))
    status = pair.driver.status(deadline=in_seconds(SOON))
    assert (status.power, status.faults) == (Power.FAULT, ("lamp-failed",))
    pair.emulator.lamp.repair()
    pair.driver.switch_on(deadline=in_seconds(SOON))
    assert pair.driver.status(deadline=in_seconds(SOON)).faults == ()


def test_overheating_is_told_by_the_next_status(open_serial: Any) -> None:
    pair = open_serial()
    pair.driver.switch_on(deadline=in_seconds(SOON))
    pair.emulator.lamp.overheat()
    until = in_seconds(SOON)
    while "over-temperature" not in (status := pair.driver.status(deadline=in_seconds(SOON))).faults:
        assert not until.passed
        time.sleep(0.02)
    assert status.power in (Power.COOLING, Power.FAULT)


def test_an_unplugged_port_comes_back_as_another_tty_and_is_found_by_its_name(open_serial: Any) -> None:
    pair = open_serial(edit=hasty)
    pair.driver.status(deadline=in_seconds(SOON))
    before = pair.emulator.path
    pair.emulator.unplug()
    threading.Timer(0.3, pair.emulator.replug).start()
    assert pair.driver.status(deadline=in_seconds(SOON)).lamp_hours == 1200
    assert pair.emulator.path != before


def test_a_port_that_stays_away_is_gone_and_comes_back_later(open_serial: Any) -> None:
    pair = open_serial(edit=hasty)
    pair.emulator.unplug()
    started = time.monotonic()
    with pytest.raises((DeviceGone, DeviceTimeout)):
        pair.driver.status(deadline=in_seconds(0.5))
    assert time.monotonic() - started < 10
    pair.emulator.replug()
    assert pair.driver.status(deadline=in_seconds(SOON)).power is Power.OFF


def test_a_starting_projector_is_not_asked_more_often_than_its_profile_allows(open_serial: Any) -> None:
    pair = open_serial(timing=LampTiming(1.5, 0.4))
    pair.driver.switch_on(deadline=in_seconds(SOON))
    wait_for_power(pair.driver, Power.ON)
    sent = [entry.at_s for entry in pair.said() if entry.way.value == ">" and entry.data.startswith(b"~")]
    strike = next(entry.at_s for entry in pair.said() if entry.data == b"~0000 1\r")
    booting = [at for at in sent if strike <= at < strike + 1.4]
    gaps = [later - earlier for earlier, later in itertools.pairwise(booting)]
    assert gaps
    assert min(gaps) >= 0.049


def test_calls_from_two_threads_take_turns(open_serial: Any) -> None:
    pair = open_serial()
    results: list[Any] = []

    def ask() -> None:
        for _ in range(5):
            results.append(pair.driver.status(deadline=in_seconds(SOON)))

    threads = [threading.Thread(target=ask) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(results) == 15
    assert all((status.power, status.lamp_hours) == (Power.OFF, 1200) for status in results)


def test_closing_ends_a_call_in_another_thread(open_serial: Any) -> None:
    pair = open_serial()
    pair.emulator.faults.set(silent=True)
    ended: list[DeviceError] = []

    def ask() -> None:
        try:
            pair.driver.status(deadline=in_seconds(20))
        except DeviceError as error:
            ended.append(error)

    thread = threading.Thread(target=ask)
    thread.start()
    time.sleep(0.1)
    pair.driver.close()
    thread.join(timeout=10)
    assert not thread.is_alive()
    assert ended[0].code == "projector-closed"


def test_the_shutter_blocks_the_light(open_serial: Any) -> None:
    pair = open_serial()
    with pytest.raises(DeviceRefused):
        pair.driver.set_shutter(True, deadline=in_seconds(SOON))
    pair.driver.switch_on(deadline=in_seconds(SOON))
    pair.driver.set_shutter(True, deadline=in_seconds(SOON))
    assert pair.emulator.lamp.light_level() == 0.0
    pair.driver.set_shutter(False, deadline=in_seconds(SOON))
    assert pair.emulator.lamp.light_level() > 0.0


def test_another_projectors_number_gets_no_answer(open_serial: Any) -> None:
    pair = open_serial(board=partial(OptomaBoard, number=3), settings={"address": "04"}, edit=hasty)
    with pytest.raises(DeviceTimeout):
        pair.driver.status(deadline=in_seconds(SOON))


def test_a_projector_that_is_closed_while_its_port_is_opened_again_lets_go_of_the_port(tmp_path: Path) -> None:
    master, slave = os.openpty()
    port = Path(os.ttyname(slave))

    def open_meanwhile_closed(deadline: Deadline) -> SerialLink:
        projector.close()
        return SerialLink(port, baud=9600, deadline=deadline)

    projector = SerialProjector(open_meanwhile_closed, load_profile("optoma-later", tmp_path), name="left")
    try:
        with pytest.raises(DeviceGone) as caught:
            projector.status(deadline=in_seconds(SOON))
        assert caught.value.code == "projector-closed"
        SerialLink(port, baud=9600, deadline=in_seconds(SOON)).close()  # it is held exclusively while it is open
    finally:
        os.close(slave)
        os.close(master)


@pytest.mark.parametrize(
    ("settings", "code"),
    [
        ({"profile": "no-such-model"}, "profile-missing"),
        ({"profile": "missing.toml"}, "profile-missing"),
        ({"profile": "pjlink"}, "profile-not-serial"),
        ({"profile": 3}, "setting-wrong"),
        ({"baud": "fast"}, "setting-wrong"),
        ({"address": "1"}, "setting-wrong"),
        ({"address": "xx"}, "setting-wrong"),
        ({"port": "run/nowhere"}, "port-missing"),
    ],
)
def test_wrong_settings_are_refused_by_name(settings: dict[str, Any], code: str, tmp_path: Path) -> None:
    master, slave = os.openpty()
    (tmp_path / "tty").symlink_to(os.ttyname(slave))
    table = {"profile": "optoma-later", "port": "tty", **settings}
    try:
        with pytest.raises((PluginError, DeviceGone)) as caught:
            open_serial_projector(table, OpenContext(tmp_path), in_seconds(SOON))
    finally:
        os.close(slave)
        os.close(master)
    assert caught.value.code == code


def test_a_quick_profile_only_changes_times() -> None:
    quick = quick_profile(LampTiming(1.5, 2.5), stable_s=4.0)
    assert "warm_up_s = 1.5" in quick
    assert "stable_s = 4.0" in quick
    assert "cool_down_s = 2.5" in quick
    assert set(shipped_profiles()) >= {"optoma-later", "pjlink"}
