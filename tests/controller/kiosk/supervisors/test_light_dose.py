"""The light dose: against sums by hand, over restarts, gaps and damaged files."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.kiosk.supervisors.devices import Devices
from controller.kiosk.supervisors.light_records import DOSE_FILE, LONGEST_GAP_S, SAVED_EVERY_S, LightDose
from controller.kiosk.world import World
from controller.stage.sessions.check import check_stage
from tests.controller.stage.sessions.test_relays_and_light import LIGHT, Hall


class Clock:
    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


def test_an_hour_of_two_hundred_lux_is_two_hundred_lux_hours_also_after_a_restart(tmp_path: Path) -> None:
    clock = Clock()
    dose = LightDose(tmp_path, monotonic=clock)
    for _ in range(361):
        dose.add(200.0)
        clock.now_s += 10
    assert dose.lux_hours == pytest.approx(200)
    kept = LightDose(tmp_path, monotonic=clock).lux_hours
    assert 200 - 200 * (SAVED_EVERY_S + 10) / 3600 <= kept <= 200, "saved every ten minutes"
    dose.save()
    again = LightDose(tmp_path, monotonic=clock)
    assert again.lux_hours == pytest.approx(200, abs=1e-3)
    clock.now_s = 5.0
    again.add(1000.0)
    assert again.lux_hours == pytest.approx(200, abs=1e-3), "what was between two services is not known"


def test_a_gap_counts_as_the_brighter_end_and_a_long_one_not_at_all(tmp_path: Path) -> None:
    clock = Clock()
    dose = LightDose(tmp_path, monotonic=clock)
    dose.add(0.0)
    clock.now_s += LONGEST_GAP_S
    dose.add(90.0)
    assert dose.lux_hours == pytest.approx(90)
    clock.now_s += LONGEST_GAP_S + 1
    dose.add(90.0)
    assert dose.lux_hours == pytest.approx(90)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.floats(0.1, 100), st.floats(allow_nan=True, allow_infinity=True)), min_size=1))
def test_it_never_falls_and_is_never_less_than_the_light(readings: list[tuple[float, float]]) -> None:
    clock, least, before = Clock(), 0.0, 0.0
    dose = LightDose(Path("/proc/nowhere"), monotonic=clock)
    previous = None
    for seconds, lux in readings:
        clock.now_s += seconds
        dose.add(lux)
        steady = lux if 0 < lux < float("inf") else 0.0
        least += 0 if previous is None else seconds * min(previous, steady) / 3600
        previous = steady
        assert dose.lux_hours >= before
        before = dose.lux_hours
        assert before >= least * (1 - 1e-9)


@pytest.mark.parametrize("content", ["", "[]", '{"lux_hours": "x"}', '{"lux_hours": NaN}', '{"lux_hours": -5}'])
def test_a_damaged_file_begins_at_nothing(tmp_path: Path, content: str) -> None:
    (tmp_path / DOSE_FILE).parent.mkdir()
    (tmp_path / DOSE_FILE).write_text(content)
    assert LightDose(tmp_path).lux_hours == 0


def test_a_stages_light_sensor_makes_the_dose_and_a_stage_without_one_has_none(tmp_path: Path) -> None:
    class Later(World):
        at_s = 0.0

        def monotonic(self) -> float:
            return self.at_s

    hall, world = Hall(tmp_path, LIGHT), Later()
    checked = check_stage(hall.folder, drivers=hall.drivers)
    with contextlib.closing(Devices(checked, tmp_path, lambda _: None, world)) as devices:
        assert devices.sensor is not None
        hall.sensor.lux = 150.0
        for _ in range(721):
            devices.sensor.step()
            world.at_s += 10
        assert devices.dose_klx_h == pytest.approx(0.3)
    with contextlib.closing(Devices(checked, tmp_path, lambda _: None, world)) as devices:
        assert devices.dose_klx_h == pytest.approx(0.3)
    dark = Hall(tmp_path, "")
    with contextlib.closing(Devices(check_stage(dark.folder, drivers=dark.drivers), tmp_path, lambda _: None)) as bare:
        assert bare.dose_klx_h is None
