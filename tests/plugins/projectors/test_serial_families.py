"""The serial driver against the families' oddities, over real pseudo terminals."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

from hal.deadline import in_seconds
from hal.errors import DeviceBusy, DeviceError, DeviceRefused, DeviceTimeout, ProtocolError
from hal.values import Power
from lab.emulated.projectors.boards import baud_of
from lab.emulated.projectors.boards_binary import NecBoard
from lab.emulated.projectors.boards_text import BenqBoard, BenqQuirks, EpsonBoard, EpsonQuirks, SanyoBoard
from plugins.emulated.projectors.lamp import EmulatedLamp, LampTiming
from plugins.projectors.profile_files import shipped_profiles
from tests.plugins.conftest import each, hasty, wait_for_power
from tests.plugins.projectors.switching import strikes_once_when_its_second_answer_is_lost

SOON = 30.0
SERIAL = [name for name in shipped_profiles() if name != "pjlink" and baud_of(name)]
SWITCHABLE = [name for name in SERIAL if name != "optoma-ep910"]


def burn(pair: Any) -> None:
    pair.driver.switch_on(deadline=in_seconds(SOON))
    wait_for_power(pair.driver, Power.ON)


@pytest.mark.parametrize(
    "quirks",
    [
        BenqQuirks(),
        BenqQuirks(prompt=False),
        BenqQuirks(echoes=0),
        BenqQuirks(echoes=2),
        BenqQuirks(prompt=False, echoes=0),
        BenqQuirks(glued_in_standby=True),
        BenqQuirks(bare_hours=True),
        BenqQuirks(starless_in_standby=True),
    ],
    ids=repr,
)
def test_a_benq_is_understood_however_it_echoes(open_serial: Any, quirks: BenqQuirks) -> None:
    pair = open_serial(profile="benq", board=partial(BenqBoard, quirks=quirks), edit=hasty)
    assert pair.driver.status(deadline=in_seconds(SOON)).power is Power.OFF
    burn(pair)
    assert pair.driver.status(deadline=in_seconds(SOON)).lamp_hours == 1200
    assert pair.driver.identity(deadline=in_seconds(SOON)).model.endswith("W1110")
    assert pair.emulator.lamp.strikes == 1


def test_an_echo_alone_is_not_an_answer(open_serial: Any) -> None:
    class Parrot(BenqBoard):
        def _act(self, line: bytes) -> bytes:
            return b""

    pair = open_serial(profile="benq", board=Parrot, edit=hasty)
    with pytest.raises(DeviceTimeout):
        pair.driver.status(deadline=in_seconds(SOON))


def test_an_epson_in_an_error_state_is_read_without_its_prompt(open_serial: Any) -> None:
    pair = open_serial(profile="epson-escvp21", edit=hasty)
    burn(pair)
    pair.emulator.lamp.fail()
    status = pair.driver.status(deadline=in_seconds(SOON))
    assert (status.power, status.faults) == (Power.FAULT, ("error-standby",))
    with pytest.raises(DeviceRefused, match="error-standby"):
        pair.driver.switch_on(deadline=in_seconds(SOON))


def test_half_an_answer_is_never_taken_for_one(open_serial: Any) -> None:
    # Neither as it stands, "PWR=", nor grown together with the next one, "PWR=PWR=01\r:".
    def cut_twice(profile: str) -> None:
        pair = open_serial(profile=profile, name=profile, edit=hasty)
        before = pair.driver.status(deadline=in_seconds(SOON)).power
        for _ in range(2):
            pair.emulator.faults.set(cut=1)
            assert pair.driver.status(deadline=in_seconds(SOON)).power is before

    each(("epson-escvp21", "nec", "optoma-ep910", "panasonic"), cut_twice)


def test_an_epson_that_answers_nothing_while_it_warms_is_waited_for(open_serial: Any) -> None:
    lamp = EmulatedLamp(LampTiming(0.8, 0.4))
    board = partial(EpsonBoard, quirks=EpsonQuirks(deaf_while_warming=True))
    pair = open_serial(profile="epson-escvp21", board=board, lamp=lamp, edit=hasty)
    pair.driver.switch_on(deadline=in_seconds(SOON))
    assert lamp.strikes == 1
    assert pair.driver.status(deadline=in_seconds(SOON)).power is Power.ON


@pytest.mark.parametrize("profile", SWITCHABLE)
def test_on_while_cooling_is_refused_even_by_a_driver_that_did_not_see_it_burn(open_serial: Any, profile: str) -> None:
    lamp = EmulatedLamp(LampTiming(0.1, 20.0))
    lamp.warm_now()
    lamp.extinguish()
    pair = open_serial(profile=profile, lamp=lamp)
    with pytest.raises(DeviceRefused) as caught:
        pair.driver.switch_on(deadline=in_seconds(SOON))
    assert caught.value.code in ("projector-cooling", "projector-refused-on")
    assert lamp.strikes == 0


def test_a_lost_acknowledgement_strikes_once_and_is_confirmed_by_the_state(open_serial: Any) -> None:
    def lost(profile: str) -> None:
        pair = open_serial(profile=profile, name=profile, edit=hasty)
        pair.driver.status(deadline=in_seconds(SOON))
        strikes_once_when_its_second_answer_is_lost(pair)

    each(SWITCHABLE, lost)


def expecting_late_ones(text: str) -> str:
    return hasty(text).replace("answer_s = 0.4", "answer_s = 0.8").replace("late_s = 0.8", "late_s = 2.4")


def test_a_late_answer_is_never_the_answer_to_the_next_question(open_serial: Any) -> None:
    def late_twice(profile: str) -> None:
        lamp = EmulatedLamp(LampTiming(0.0, 0.0), hours=1.0)  # an hour count that reads as a power state as well
        pair = open_serial(profile=profile, name=profile, lamp=lamp, edit=expecting_late_ones)
        before = pair.driver.status(deadline=in_seconds(SOON)).power
        for _ in range(2):
            # Just later than the driver waits: an emulator that is slow itself still answers before it gives up.
            pair.emulator.faults.set(late_s=0.9)
            assert pair.driver.status(deadline=in_seconds(SOON)).power is before

    each(SERIAL, late_twice)


@pytest.mark.parametrize("knob", ["silent", "garbage"])
def test_silence_and_noise_are_typed_errors_before_the_deadline(open_serial: Any, knob: str) -> None:
    def bent(profile: str) -> None:
        pair = open_serial(profile=profile, name=profile, edit=hasty)
        pair.emulator.faults.set(**{knob: True})
        until = in_seconds(60)
        with pytest.raises((DeviceTimeout, ProtocolError)):
            pair.driver.status(deadline=until)
        assert not until.passed
        pair.emulator.faults.clear()
        assert pair.driver.status(deadline=in_seconds(SOON)).power in (Power.OFF, Power.UNKNOWN)

    each(SERIAL, bent)


def test_a_christies_status_lines_are_heard_and_confuse_nothing(open_serial: Any) -> None:
    pair = open_serial(profile="christie")
    burn(pair)
    pair.emulator.lamp.fail()
    until = in_seconds(SOON)
    while "system-error" not in pair.driver.status(deadline=in_seconds(SOON)).faults:
        assert not until.passed
        time.sleep(0.02)
    pair.emulator.lamp.repair()
    wait_for_end = in_seconds(SOON)
    while pair.driver.status(deadline=in_seconds(SOON)).power is Power.COOLING:
        assert not wait_for_end.passed
        time.sleep(0.05)
    burn(pair)
    assert pair.driver.status(deadline=in_seconds(SOON)).faults == ()


def test_an_ep910_cannot_be_switched_and_says_why(open_serial: Any) -> None:
    pair = open_serial(profile="optoma-ep910")
    assert not pair.driver.capabilities.power
    assert not pair.driver.capabilities.lamp_hours
    for switch in (pair.driver.switch_on, pair.driver.switch_off):
        with pytest.raises(DeviceRefused) as caught:
            switch(deadline=in_seconds(SOON))
        assert caught.value.code == "projector-power-unknown"
        assert "optoma-ep910" in caught.value.what
    assert pair.emulator.lamp.strikes == 0
    pair.driver.set_shutter(True, deadline=in_seconds(SOON))
    assert pair.emulator.lamp.shutter_closed


def test_an_ep910_that_cools_is_seen_to_cool(open_serial: Any) -> None:
    lamp = EmulatedLamp(LampTiming(0.1, 20.0))
    pair = open_serial(profile="optoma-ep910", lamp=lamp)
    assert pair.driver.status(deadline=in_seconds(SOON)).power is Power.UNKNOWN
    lamp.warm_now()
    lamp.extinguish()
    assert pair.driver.status(deadline=in_seconds(SOON)).power is Power.COOLING
    with pytest.raises(DeviceRefused):
        pair.driver.set_shutter(True, deadline=in_seconds(SOON))


def test_a_projector_found_booting_is_asked_as_seldom_as_one_that_was_switched_on(open_serial: Any) -> None:
    lamp = EmulatedLamp(LampTiming(1.5, 0.4))
    lamp.strike()
    pair = open_serial(timing=LampTiming(1.5, 0.4), lamp=lamp, wedges_below_s=0.02, edit=slower)
    for _ in range(2):
        assert pair.driver.status(deadline=in_seconds(SOON)).power in (Power.ON, Power.WARMING)
    assert not pair.emulator.wedged


def faster(text: str) -> str:
    return text.replace("boot_interval_s = 0.05", "boot_interval_s = 0.005")


def slower(text: str) -> str:
    """Questions so far apart that a loaded machine does not bring two of them together."""
    return text.replace("boot_interval_s = 0.05", "boot_interval_s = 0.4")


def test_a_booting_projector_is_not_polled_into_a_wedge(open_serial: Any) -> None:
    def boot(profile: str) -> None:
        pair = open_serial(profile=profile, name=profile, timing=LampTiming(1.0, 0.4), wedges_below_s=0.02, edit=slower)
        pair.driver.switch_on(deadline=in_seconds(SOON))
        wait_for_power(pair.driver, Power.ON)
        assert not pair.emulator.wedged

    each(SWITCHABLE, boot)


def test_the_emulated_wedge_is_real_a_hastier_profile_falls_into_it(open_serial: Any) -> None:
    pair = open_serial(
        timing=LampTiming(20.0, 20.0),
        wedges_below_s=0.02,
        edit=lambda text: faster(hasty(text)).replace("confirm_s = 5.0", "confirm_s = 1.5"),
    )
    with pytest.raises(DeviceError):
        burn(pair)
    assert pair.emulator.wedged
    pair.emulator.cut_mains()
    pair.emulator.restore_mains()
    assert pair.driver.status(deadline=in_seconds(SOON)).power in (Power.COOLING, Power.OFF)
    assert pair.emulator.lamp.damages == 1


def test_an_adapter_that_comes_back_as_another_tty_is_found_by_its_name(open_serial: Any) -> None:
    def replugged(profile: str) -> None:
        pair = open_serial(profile=profile, name=profile, edit=hasty)
        before = pair.driver.status(deadline=in_seconds(SOON)).power
        pair.emulator.unplug()
        back: Callable[[], None] = pair.emulator.replug
        threading.Timer(0.2, back).start()
        assert pair.driver.status(deadline=in_seconds(SOON)).power is before

    each(SERIAL, replugged)


def test_a_sanyo_with_two_lamps_tells_the_hours_of_the_first(open_serial: Any) -> None:
    pair = open_serial(profile="sanyo", board=partial(SanyoBoard, lamps=2))
    burn(pair)
    assert pair.driver.status(deadline=in_seconds(SOON)).lamp_hours == 1200


def test_a_sanyo_that_can_take_no_command_is_busy_and_not_off(open_serial: Any) -> None:
    pair = open_serial(profile="sanyo", board=partial(SanyoBoard, deaf=True))
    with pytest.raises(DeviceBusy):
        pair.driver.switch_on(deadline=in_seconds(SOON))
    assert pair.emulator.lamp.strikes == 0


def test_a_sanyo_whose_lamp_failed_cools_and_then_reports_a_fault(open_serial: Any) -> None:
    pair = open_serial(profile="sanyo")
    burn(pair)
    pair.emulator.lamp.fail()
    wait_for_power(pair.driver, Power.FAULT)
    assert pair.driver.status(deadline=in_seconds(SOON)).faults == ("error-standby",)


@pytest.mark.parametrize(
    ("lens_shutter", "moves"), [(True, [b"\x02\x16", b"\x02\x17"]), (False, [b"\x02\x10", b"\x02\x11"])]
)
def test_a_necs_lens_shutter_is_used_where_there_is_one(
    open_serial: Any, lens_shutter: bool, moves: list[bytes]
) -> None:
    boards: list[NecBoard] = []

    def board(lamp: EmulatedLamp) -> NecBoard:
        boards.append(NecBoard(lamp, lens_shutter=lens_shutter))
        return boards[0]

    pair = open_serial(profile="nec", board=board)
    with pytest.raises(DeviceRefused):
        pair.driver.set_shutter(True, deadline=in_seconds(SOON))  # in standby neither shutter moves
    burn(pair)
    for closed in (True, False, True, False):
        pair.driver.set_shutter(closed, deadline=in_seconds(SOON))
        assert pair.emulator.lamp.shutter_closed is closed
    told = [code for code in boards[0].heard if code in (b"\x02\x10", b"\x02\x11", b"\x02\x16", b"\x02\x17")]
    assert told[-4:] == moves * 2


def test_a_family_without_an_emulated_board_is_not_taken_for_an_optoma(open_serial: Any) -> None:
    with pytest.raises(LookupError, match="no emulated board for pjlink: add it to"):
        open_serial(profile="pjlink")
