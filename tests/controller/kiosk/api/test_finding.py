"""A search for devices, and one that is tried: on buses and with drivers that are models, which vanish and lie."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from controller.kiosk.api.finding import find, findings, try_device
from controller.stage.doctor.examine import Tools
from hal.deadline import Deadline
from hal.errors import DeviceBusy, DeviceGone
from hal.finding import Finder, Found, SearchScope
from hal.notices import Notice
from hal.registry import Driver, Drivers
from hal.values import DeviceIdentity
from tests.controller.stage.rig.rig_model import ModelCamera

HOSTILE = "EOS \x1b]0;pwned\x07<script>\n\u202e"


@dataclass
class Device(ModelCamera):
    """``answer`` is who it is."""

    answer: Callable[[], DeviceIdentity] = lambda: DeviceIdentity("Model", "Camera")
    open: int = 1

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        return self.answer()

    def close(self) -> None:
        self.open -= 1


class Bus:
    """What a search finds, and what opening it gives."""

    def __init__(self, *found: Found, opens: Callable[[], Device] | None = None) -> None:
        self.found = list(found)

        def look(wanted: SearchScope, deadline: Deadline) -> Sequence[Found]:
            return tuple(self.found)

        def opened(settings: Any, context: object, deadline: Deadline) -> Device:
            assert opens is not None
            return opens()

        drivers = Drivers(
            tuple(Driver(kind, "model", "One.", opened, {"address": "where it is"}) for kind in ("camera", "projector"))
        )
        self.tools = Tools((Finder("usb", look),), drivers)


def camera(**changes: Any) -> Found:
    fields: dict[str, Any] = {"bus": "usb", "address": "1-2", "what": "A camera", "kind": "camera", "driver": "model"}
    return Found(**(fields | {"settings": {"address": "1-2"}} | changes))


@pytest.mark.parametrize(
    ("kind", "read"),
    [
        ("camera", lambda content: content["camera"]), ("projector", lambda content: content["projectors"][0]),
        ("power_switch", lambda content: content["relays"][0]), ("button_panel", lambda content: content["key_panel"]),
        ("light_sensor", lambda content: content["light_sensor"]),
    ],
)  # fmt: skip
def test_each_kind_gets_the_table_that_stage_toml_wants_whatever_it_calls_itself(
    tmp_path: Path, kind: str, read: Callable[[Any], Any]
) -> None:
    settings = {"port": '"]\n[keys]\nx = "', "serial": HOSTILE, "baud": 9600}
    (found,) = find(tmp_path, tools=Bus(camera(kind=kind, what=HOSTILE, settings=settings)).tools)
    assert read(tomllib.loads(found.table)) == {"driver": "model", **settings}
    assert set(tomllib.loads(found.table)) == {next(iter(tomllib.loads(found.table)))}, "no table beside its own"
    assert found.label.isprintable()
    assert (found.key, found.kind) == ("usb:1-2", kind)


def test_what_nobody_drives_is_shown_and_has_no_table(tmp_path: Path) -> None:
    tools = Bus(camera(driver="", kind="", settings={})).tools
    (found,) = find(tmp_path, tools=tools)
    assert (found.table, found.driver) == ("", "")
    tried = try_device(tmp_path, found.key, tools=tools)
    assert not tried.works
    assert "stage.toml by hand" in tried.what


def test_a_device_that_answers_says_who_it_is_in_harmless_words_and_is_closed(tmp_path: Path) -> None:
    device = Device(answer=lambda: DeviceIdentity("Canon", HOSTILE))
    tried = try_device(tmp_path, "usb:1-2", tools=Bus(camera(), opens=lambda: device).tools)
    assert tried.works
    assert tried.what.isprintable()
    assert "Canon" in tried.what
    assert device.open == 0


def gone() -> Any:
    raise DeviceGone("camera-gone", what="It left the bus.", remedy="Plug it in.")


def busy() -> Any:
    raise DeviceBusy("port-busy", what="Another program has it.", remedy="Stop that one.")


def test_a_device_that_vanishes_or_is_in_use_is_told_in_words(tmp_path: Path) -> None:
    bus = Bus(camera(), opens=busy)
    assert try_device(tmp_path, "usb:1-2", tools=bus.tools).what == "Another program has it. Stop that one."
    device = Device(answer=gone)
    tried = try_device(tmp_path, "usb:1-2", tools=Bus(camera(), opens=lambda: device).tools)
    assert (tried.works, tried.what, device.open) == (False, "It left the bus. Plug it in.", 0)
    (found,) = find(tmp_path, tools=bus.tools)
    bus.found.clear()
    assert "search again" in try_device(tmp_path, found.key, tools=bus.tools).what
    for key in ("", "usb", "usb:", "usb:1-2\x00", "../1-2"):
        assert not try_device(tmp_path, key, tools=bus.tools).works
    bus.found.append(camera(driver="not installed"))
    tried = try_device(tmp_path, "usb:1-2", tools=bus.tools)
    assert not tried.works
    assert "not installed" in tried.what


def test_what_is_wrong_on_a_bus_is_told_in_harmless_words_without_a_service(tmp_path: Path) -> None:
    problem = Notice.warning("no-rights", f"No rights for {HOSTILE}.", "Install the udev rules.")
    found, examined = findings(tmp_path, None, tools=Bus(camera(problems=(problem,))).tools)
    assert examined.what.startswith("player, ports, network, USB, outputs. Devices there: ")
    assert examined.level == "info"
    assert found.level == "warning"
    assert found.what.isprintable()
    assert found.remedy == "Install the udev rules."
