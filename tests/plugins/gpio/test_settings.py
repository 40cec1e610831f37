"""What the driver ``gpio-keys`` takes from stage.toml; the lines themselves: ``tests/real_kernel``."""

from __future__ import annotations

from pathlib import Path

import pytest

from controller.stage.rig.key_panel import technicians_keys
from hal.deadline import in_seconds
from hal.errors import DeviceGone, PluginError
from hal.registry import OpenContext, check_device
from hal.values import TECHNICIAN_KEYS
from plugins.gpio.keys import DRIVER, open_keys

PLAY = {"line": 3, "does": "play"}
NAMED = {"line": "BUTTON", "does": "stop", "active_low": False}


@pytest.mark.parametrize(
    "wrong",
    [[], [3], [{**PLAY, "does": "state"}], [{**PLAY, "does": 1}], [{**PLAY, "line": -1}], [{**PLAY, "line": ""}],
     [{**PLAY, "line": True}], [PLAY, {**PLAY, "does": "stop"}], [{**PLAY, "other": 1}], [{**PLAY, "active_low": 1}]],
)  # fmt: skip
def test_wrong_keys_are_refused_before_a_line_is_used(wrong: list[object]) -> None:
    with pytest.raises(PluginError):
        check_device(DRIVER, {"chip": "chip", "keys": wrong}, OpenContext(Path()))


@pytest.mark.parametrize("wrong", [{"debounce_ms": 0}, {"debounce_ms": 501}, {"pull": "left"}, {"chip": 3}])
def test_wrong_settings_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(PluginError):
        check_device(DRIVER, {"chip": "chip", "keys": [PLAY, NAMED], **wrong}, OpenContext(Path()))


def test_sound_settings_are_taken() -> None:
    settings = {"chip": "chip", "keys": [PLAY, NAMED], "debounce_ms": 5, "pull": "up"}
    check_device(DRIVER, settings, OpenContext(Path()))


@pytest.mark.parametrize("chip", ["/dev/gpiochip99", "no such label"])
def test_a_chip_that_is_not_there_is_gone(chip: str) -> None:
    with pytest.raises(DeviceGone):
        open_keys({"chip": chip, "keys": [PLAY]}, OpenContext(Path()), in_seconds(20))


def test_the_keys_of_the_controller_are_in_the_order_that_drivers_know() -> None:
    pressed: list[str] = []
    commands = technicians_keys(*(lambda name=name: pressed.append(name) for name in ("play", "stop", "recalibrate")))
    for command in commands:
        command.press()
    assert pressed == list(TECHNICIAN_KEYS[1:])
