"""Finding drivers through real entry points of real (temporary) distributions."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from hal.deadline import in_seconds
from hal.errors import PluginError
from hal.registry import GROUP, Driver, OpenContext, check_settings, load_drivers, open_device, setting

Install = Callable[[str, dict[str, str], str], None]

GOOD = """
from hal.registry import Driver
from hal.values import DeviceIdentity
class Sensor:
    def __init__(self, settings):
        self.settings = settings
    def identity(self, *, deadline):
        return DeviceIdentity("Acme", self.settings["port"])
    def illuminance_lux(self, *, deadline):
        return 1.5
    def close(self):
        pass
DRIVER = Driver("light_sensor", "{name}", "a test", lambda settings, context, deadline: Sensor(settings),
                {{"port": "where it is plugged in", "baud": "its rate"}}, ("port",))
"""


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Install:
    """Install a distribution with entry points and one module, as pip would lay it out."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def make(distribution: str, points: dict[str, str], source: str) -> None:
        info = tmp_path / f"{distribution.replace('-', '_')}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.0\n")
        lines = "\n".join(f"{name} = {value}" for name, value in points.items())
        (info / "entry_points.txt").write_text(f"[{GROUP}]\n{lines}\n")
        for value in points.values():
            module = value.partition(":")[0]
            (tmp_path / f"{module}.py").write_text(source)
            monkeypatch.delitem(sys.modules, module, raising=False)

    return make


def test_a_plugin_of_another_distribution_is_found_and_opens(install: Install, tmp_path: Path) -> None:
    install("acme-projectors", {"acme": "vel_acme:DRIVER"}, GOOD.format(name="acme"))
    driver = load_drivers().get("light_sensor", "acme")
    opened = open_device(driver, {"port": "/dev/ttyUSB0"}, OpenContext(tmp_path), in_seconds(20))
    assert opened.identity(deadline=in_seconds(20)).model == "/dev/ttyUSB0"


def test_whoever_needs_no_bench_does_not_load_one(install: Install) -> None:
    install("acme-hall", {"acme-hall-bench": "vel_hall:DRIVER"}, "raise SystemExit(3)")
    assert not load_drivers(benches=False).broken
    assert [plugin.entry_point for plugin in load_drivers().broken] == ["acme-hall-bench = vel_hall:DRIVER"]


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("import a_module_that_is_not_there", "ModuleNotFoundError"),
        ("raise SystemExit(3)", "SystemExit"),
        ("DRIVER = 'not a driver'", "names a str"),
        ("NOTHING = 1", "AttributeError"),
        ("from hal.registry import Driver\nDRIVER = Driver('toaster', 'x', '', print)", "kind 'toaster'"),
        ("from hal.registry import Driver\nDRIVER = Driver('camera', 'x', '', print, {}, ('port',))", "requires port"),
        ("from hal.registry import Driver\nDRIVER = Driver('camera', 'x', '', print, None)", "settings: nothing"),
        ("from hal.registry import Driver\nDRIVER = Driver('camera', 'x', '', 'open')", "open: a str"),
    ],
)
def test_a_broken_plugin_is_reported_and_does_not_stop_the_others(install: Install, source: str, reason: str) -> None:
    install("broken-plugin", {"broken": "vel_broken:DRIVER"}, source)
    install("acme-projectors", {"acme": "vel_acme:DRIVER"}, GOOD.format(name="acme"))
    drivers = load_drivers()
    assert drivers.get("light_sensor", "acme").summary == "a test"
    mine = [plugin for plugin in drivers.broken if plugin.distribution == "broken-plugin"]
    assert len(mine) == 1
    assert reason in mine[0].reason
    with pytest.raises(PluginError, match="broken = vel_broken:DRIVER of broken-plugin"):
        drivers.get("projector", "not-there")


def test_of_two_plugins_that_claim_one_name_neither_is_used_and_every_other_is(install: Install) -> None:
    install("acme-projectors", {"acme": "vel_acme:DRIVER"}, GOOD.format(name="twin"))
    install("other-projectors", {"other": "vel_other:DRIVER"}, GOOD.format(name="twin"))
    drivers = load_drivers()
    assert drivers.get("projector", "pjlink").name == "pjlink"
    with pytest.raises(PluginError) as caught:
        drivers.get("light_sensor", "twin")
    assert caught.value.code == "driver-twice"
    assert {plugin.distribution for plugin in drivers.broken} == {"acme-projectors", "other-projectors"}
    assert "acme-projectors" in caught.value.what
    assert "other-projectors" in caught.value.what


def test_an_unknown_driver_names_those_of_its_kind(install: Install) -> None:
    install("acme-projectors", {"acme": "vel_acme:DRIVER"}, GOOD.format(name="acme"))
    with pytest.raises(PluginError) as caught:
        load_drivers().get("light_sensor", "acmee")
    assert caught.value.code == "driver-unknown"
    assert "acme" in caught.value.remedy


def test_our_own_projector_drivers_are_listed() -> None:
    drivers = load_drivers()
    assert drivers.get("projector", "serial").required == ("profile", "port")
    assert drivers.get("projector", "pjlink").required == ("address",)


DRIVER = Driver("projector", "x", "", print, {"port": "where", "baud": "rate"}, ("port",))


def test_an_unknown_setting_is_named_with_what_is_allowed() -> None:
    with pytest.raises(PluginError) as caught:
        check_settings(DRIVER, {"port": "a", "buad": 9600})
    assert caught.value.code == "setting-unknown"
    assert "'buad'" in caught.value.what
    assert "Did you mean 'baud'?" in caught.value.what
    assert "port (where), baud (rate)" in caught.value.remedy


def test_a_missing_setting_is_named() -> None:
    with pytest.raises(PluginError) as caught:
        check_settings(DRIVER, {"baud": 9600})
    assert caught.value.code == "setting-missing"
    assert "'port'" in caught.value.what


def test_a_setting_of_another_type_is_refused_with_those_that_are_allowed() -> None:
    assert setting({"wait_s": 2}, "wait_s", (int, float)) == 2
    assert setting({}, "wait_s", (int, float), 0.5) == 0.5
    for wrong in ("2", True, [2]):
        with pytest.raises(PluginError, match="not a whole number or a number") as refused:
            setting({"wait_s": wrong}, "wait_s", (int, float))
        assert refused.value.code == "setting-wrong"
    with pytest.raises(PluginError, match="not text in quotes"):
        setting({"port": 5}, "port", str)
