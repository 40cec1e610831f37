"""Tests for drivers of light sensors."""

from __future__ import annotations

import math

import pytest

from hal.conformance.device import DeviceConformance
from hal.deadline import in_seconds
from hal.errors import DeviceTimeout
from hal.interfaces import LightSensor

_SUNLIGHT_LUX = 150_000.0


class LightSensorConformance(DeviceConformance):
    """Run on every light sensor driver; supply a fixture ``light_sensor``."""

    def test_says_who_it_is(self, light_sensor: LightSensor) -> None:
        assert isinstance(light_sensor, LightSensor)
        self.check_identity(light_sensor)

    def test_light_is_told_in_lux(self, light_sensor: LightSensor) -> None:
        for _ in range(3):
            lux = light_sensor.illuminance_lux(deadline=self.soon())
            assert math.isfinite(lux)
            assert 0 <= lux < _SUNLIGHT_LUX

    def test_keeps_deadlines_and_stops_when_cancelled(self, light_sensor: LightSensor) -> None:
        with pytest.raises(DeviceTimeout):
            light_sensor.illuminance_lux(deadline=in_seconds(-1.0))
        self.check_deadline_and_cancel(light_sensor)

    def test_every_answer_and_error_is_of_its_type(self, light_sensor: LightSensor) -> None:
        self.check_types("light_sensor", light_sensor, lambda it: it.illuminance_lux(deadline=self.soon()))

    def test_closing_twice_is_harmless(self, light_sensor: LightSensor) -> None:
        self.check_closes_twice(light_sensor)
