"""The emulated lamp: light, heat, hours and failure."""

from __future__ import annotations

import pytest

from plugins.emulated.projectors.lamp import EmulatedLamp, LampTiming
from tests.plugins.emulated.conftest import Clock


@pytest.fixture
def lamp(clock: Clock) -> EmulatedLamp:
    return EmulatedLamp(LampTiming(60, 120), hours=1200.0, clock=clock)


def test_light_rises_while_it_warms_and_is_gone_when_off(lamp: EmulatedLamp, clock: Clock) -> None:
    assert lamp.light_level() == 0.0
    assert lamp.strike()
    levels = []
    for _ in range(7):
        levels.append(lamp.light_level())
        clock.now_s += 10
    assert levels == sorted(levels)
    assert 0 < levels[0] < levels[-1] == 1.0
    assert lamp.phase.name == "LIT"
    lamp.extinguish()
    assert lamp.light_level() == 0.0


def test_a_hot_lamp_refuses_to_strike_until_it_has_cooled(lamp: EmulatedLamp, clock: Clock) -> None:
    lamp.strike()
    lamp.extinguish()
    assert lamp.phase.name == "COOLING"
    assert not lamp.strike()
    clock.now_s += 120
    assert lamp.phase.name == "STANDBY"
    assert lamp.strike()
    assert lamp.strikes == 2


def test_a_shutter_hides_the_light_without_cooling(lamp: EmulatedLamp) -> None:
    lamp.warm_now()
    lamp.shutter_closed = True
    assert lamp.light_level() == 0.0
    assert lamp.phase.name == "LIT"
    lamp.shutter_closed = False
    assert lamp.light_level() == 1.0


def test_hours_count_only_while_it_burns(lamp: EmulatedLamp, clock: Clock) -> None:
    clock.now_s += 7200
    assert lamp.hours == 1200
    lamp.strike()
    clock.now_s += 7200
    assert lamp.hours == 1202
    lamp.extinguish()
    clock.now_s += 7200
    assert lamp.hours == 1202


def test_a_burst_lamp_takes_strikes_and_stays_dark(lamp: EmulatedLamp, clock: Clock) -> None:
    lamp.warm_now()
    lamp.fail()
    clock.now_s += 121
    assert lamp.strike()
    assert lamp.light_level() == 0.0
    assert lamp.phase.name == "STANDBY"
    lamp.repair()
    assert lamp.strike()
    assert lamp.light_level() > 0.0


def test_an_overheated_lamp_goes_out_and_refuses(lamp: EmulatedLamp, clock: Clock) -> None:
    lamp.warm_now()
    lamp.overheat()
    clock.now_s += 121
    assert not lamp.strike()
    lamp.repair()
    assert lamp.strike()


def test_mains_cut_from_a_lamp_that_has_not_cooled_are_damage(lamp: EmulatedLamp, clock: Clock) -> None:
    lamp.cut_mains()
    lamp.restore_mains()
    assert lamp.damages == 0, "it was cold"
    lamp.strike()
    clock.now_s += 70
    lamp.extinguish()
    clock.now_s += 100
    lamp.cut_mains()
    lamp.cut_mains()
    assert (lamp.damages, lamp.light_level(), lamp.strike()) == (1, 0.0, False)
    clock.now_s += 5000
    lamp.restore_mains()
    assert lamp.phase.name == "COOLING", "without mains there were no fans"
    assert not lamp.strike()
    clock.now_s += 121
    assert lamp.phase.name == "STANDBY"
    assert lamp.strike()
    lamp.cut_mains()
    assert lamp.damages == 2
