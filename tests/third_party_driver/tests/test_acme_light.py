"""The light post's driver against Velatura's conformance suite, and what only light posts do."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from acme_light import DRIVER, AcmeLight
from acme_light.emulated import EmulatedLightPost

from hal.conformance import LightSensorConformance
from hal.deadline import in_seconds
from hal.errors import ProtocolError
from hal.registry import OpenContext, open_device


@pytest.fixture
def post() -> Iterator[EmulatedLightPost]:
    with EmulatedLightPost() as post:
        yield post


@pytest.fixture
def light_sensor(post: EmulatedLightPost) -> Iterator[AcmeLight]:
    sensor: AcmeLight = open_device(DRIVER, {"address": post.address}, OpenContext(Path()), in_seconds(5))
    yield sensor
    sensor.close()


class TestAcmeLight(LightSensorConformance):
    """All of the suite, by this one line."""


def test_light_is_told_as_it_is(post: EmulatedLightPost, light_sensor: AcmeLight) -> None:
    post.lux = 123.45
    assert light_sensor.illuminance_lux(deadline=in_seconds(5)) == pytest.approx(123.45)


def test_garbage_is_a_protocol_error(post: EmulatedLightPost, light_sensor: AcmeLight) -> None:
    post.garbage = True
    with pytest.raises(ProtocolError):
        light_sensor.illuminance_lux(deadline=in_seconds(5))
