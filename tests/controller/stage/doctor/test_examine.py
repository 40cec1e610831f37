"""The doctor on a stage whose projectors are emulated ones on real ptys and sockets."""

from __future__ import annotations

import json
import threading
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from controller.config import load_stage
from controller.core.errors import UsageError
from controller.core.storage import exclusive
from controller.stage.doctor.examine import Tools, examine
from controller.stage.doctor.values import Examination
from controller.stage.sessions.run import LOCK
from hal.deadline import Deadline
from hal.errors import DeviceBusy
from hal.finding import Finder, Found, SearchScope, load_finders
from hal.registry import BrokenPlugin, Driver, Drivers, load_drivers
from plugins.dousers.sacn_douser import DRIVER
from plugins.emulated.projectors.lamp import EmulatedLamp, LampTiming, quick_profile
from plugins.emulated.projectors.serial import EmulatedSerialProjector
from tests.controller.stage.rig.lamp_model import World
from tests.controller.stage.rig.rig_model import ModelCamera, ModelDisplay
from tests.controller.stage.rig.test_mains_relays import Board
from tests.controller.stage.sessions.run_models import Told
from tests.controller.stage.sessions.test_relays_and_light import Sensor

LAMP = LampTiming(0.2, 0.2)
STAGE = """\
# what the technician wrote
[stage]
name = "hall"
[[projectors]]
name = "left"   # by the window
output = "P1"
driver = "serial"
profile = "quick.toml"
port = "by-id/left"
[camera]
driver = "model"
iso = 100
focal_length_px = 500
[display]
driver = "player"
frames = "run/outputs.frame"
[[display.outputs]]
name = "P1"
width_px = 4
height_px = 3
[[display.outputs]]
name = "P2"
width_px = 4
height_px = 3
"""
RELAYS = """
[[relays]]
name = "cupboard"
driver = "model"
[[relays.mains]]
channel = 1
feeds = ["left"]
"""


class Hall:
    """A stage folder, ports beside it, and models of what has no wire here."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.wires: list[EmulatedSerialProjector] = []
        self.board, self.sensor = Board(World()), Sensor()
        real = [driver for driver in load_drivers().list if driver.kind == "projector" or driver.name == "player"]
        self.drivers = Drivers(
            (
                *real,
                Driver("camera", "model", "A camera.", lambda *_: ModelCamera(), {"address": "where it is"}),
                Driver("display", "model", "A display.", lambda *_: ModelDisplay()),
                Driver("power_switch", "model", "Relays.", lambda *_: self.board),
                Driver("light_sensor", "colorhug-als", "A sensor.", lambda *_: self.sensor, {"serial": "its number"}),
            )
        )
        (folder / "stage.toml").write_text(STAGE)
        (folder / "quick.toml").write_text(quick_profile(LAMP))
        (folder / "by-id").mkdir()
        self.others: list[Finder] = []

    def plug(self, name: str, *, baud: int = 9600) -> EmulatedSerialProjector:
        wire = EmulatedSerialProjector(self.folder / "by-id" / name, EmulatedLamp(LAMP), baud=baud)
        wire.start()
        self.wires.append(wire)
        return wire

    def examine(self, *, write: bool = False, stage: bool = True) -> Examination:
        finders, broken = load_finders()
        assert broken == ()
        assert {one.bus for one in finders} == {"display", "hid", "network", "serial", "usb", "video"}
        wanted = {"serial_ports": self.folder / "by-id", "system_ports": False, "search": None, "answer_s": 0.15}
        mine = [one for one in finders if one.bus in ("serial", "network")]
        tools = Tools((*mine, *self.others), self.drivers, wanted)
        folder = self.folder if stage else None
        return examine(stage=folder, write_it=write, reporter=Told(), cancel=threading.Event(), tools=tools)


@pytest.fixture
def hall(tmp_path: Path) -> Iterator[Hall]:
    hall = Hall(tmp_path)
    yield hall
    for wire in hall.wires:
        wire.stop()


def codes(seen: Examination) -> list[str]:
    return [finding.code for finding in seen.findings]


def on_bus(*found: Found) -> Finder:
    def find(wanted: SearchScope, deadline: Deadline) -> Sequence[Found]:
        return found

    return Finder("bus", find)


def test_a_stage_that_is_well_has_no_problem_and_no_lamp_was_struck(hall: Hall) -> None:
    wire = hall.plug("left")
    seen = hall.examine()
    assert seen.healthy
    assert [(one.name, one.kind) for one in seen.tried] == [("left", "projector"), ("camera", "camera")]
    assert "1200 lamp hours" in str(seen.tried[0].answer)
    assert wire.lamp.strikes == 0
    assert json.loads(json.dumps(seen.as_json()))["healthy"] is True
    assert "No problems found." in seen.as_text()


def test_every_problem_says_what_it_is_and_what_to_do(hall: Hall) -> None:
    hall.plug("left").faults.set(silent=True)
    seen = hall.examine()
    assert codes(seen) == ["serial-no-answer"]
    assert seen.tried[0].answer is None
    told = seen.as_json()["problems"][0]
    assert set(told) == {"device", "code", "what", "remedy"}
    assert all(told.values())
    assert told["what"] in seen.as_text()
    assert told["remedy"] in seen.as_text()


def test_a_projector_behind_an_open_relay_is_told_to_have_no_mains(hall: Hall) -> None:
    (hall.folder / "stage.toml").write_text(STAGE + RELAYS)
    hall.board.closed = {1: False}
    hall.plug("left").faults.set(silent=True)
    seen = hall.examine()
    assert "mains-off" in codes(seen)
    assert hall.board.closed == {1: False}


def test_a_douser_is_tried_without_a_movement_and_its_table_stays_where_it_is(hall: Hall) -> None:
    douser = '\n[projectors.douser]\ndriver = "sacn"\naddress = "127.0.0.1:9"\nuniverse = 1\nchannel = 2\n'
    (hall.folder / "stage.toml").write_text(STAGE.replace("\n[camera]", douser + "[camera]"))
    hall.drivers = Drivers((*hall.drivers.list, DRIVER))
    hall.plug("left", baud=19200)
    seen = hall.examine(write=True)
    assert ("left (douser)", "douser") in [(one.name, one.kind) for one in seen.tried]
    assert "universe 1, channel 2: not moved yet" in seen.as_text()
    (left,) = tomllib.loads((hall.folder / "stage.toml").read_text())["projectors"]
    assert (left["baud"], left["douser"]["channel"]) == (19200, 2)
    assert hall.examine().healthy


def test_a_wrong_rate_is_written_into_the_file_and_the_comments_stay(hall: Hall) -> None:
    hall.plug("left", baud=19200)
    seen = hall.examine(write=True)
    assert codes(seen) == ["serial-wrong-baud"]
    assert seen.written == ("baud = 19200 for projector left",)
    text = (hall.folder / "stage.toml").read_text()
    assert "# what the technician wrote" in text
    assert "# by the window" in text
    assert tomllib.loads(text)["projectors"][0]["baud"] == 19200
    assert hall.examine().healthy


def test_a_second_projector_and_a_light_sensor_are_added_on_the_free_output(hall: Hall) -> None:
    hall.plug("left")
    hall.plug("usb-new")
    hall.others = [
        on_bus(Found("hid", "/dev/hidraw0", "ambient light sensor", "light_sensor", "colorhug-als", {"serial": "L1"}))
    ]
    seen = hall.examine(write=True)
    assert codes(seen) == ["not-in-stage", "not-in-stage"]
    tables = load_stage(hall.folder).tables
    second = tables.projectors[1].model_dump()
    assert (second["output"], second["profile"]) == ("P2", "optoma-later")
    assert second["port"] == str(hall.folder / "by-id" / "usb-new")
    assert tables.light_sensor is not None
    assert hall.examine().healthy


def test_a_relay_board_is_never_added_by_guess(hall: Hall) -> None:
    hall.plug("left")
    hall.others = [on_bus(Found("hid", "/dev/hidraw0", "relay board", "power_switch", "usb-relay", {"serial": "R1"}))]
    before = (hall.folder / "stage.toml").read_text()
    seen = hall.examine(write=True)
    assert codes(seen) == ["not-in-stage"]
    assert "with the projector of each relay" in seen.findings[0].remedy
    assert seen.written == ()
    assert (hall.folder / "stage.toml").read_text() == before


def test_a_first_stage_is_written_from_what_is_plugged_in(hall: Hall) -> None:
    (hall.folder / "stage.toml").unlink()
    hall.plug("usb-a")
    hall.others = [
        on_bus(
            Found("usb", "port 1-1", "still camera", "camera", "model", {"address": "usb:1"}),
            Found(
                "display",
                "DP-1",
                "output",
                "display",
                "player",
                {"outputs": [{"name": "DP-1", "width_px": 4, "height_px": 3}]},
            ),
        )
    ]
    seen = hall.examine(write=True)
    assert seen.written
    tables = load_stage(hall.folder).tables
    assert [one.output for one in tables.projectors] == ["DP-1"]
    assert tables.views[0][1].driver == "model"
    (hall.folder / "stage.toml").unlink()
    hall.others = []
    with pytest.raises(UsageError) as caught:
        hall.examine(write=True)
    assert caught.value.code == "doctor-not-enough"
    assert not (hall.folder / "stage.toml").exists()


def test_a_wrong_stage_toml_is_a_problem_and_the_search_goes_on(hall: Hall) -> None:
    (hall.folder / "stage.toml").write_text(STAGE.replace("iso", "izo"))
    hall.plug("left")
    seen = hall.examine()
    assert codes(seen) == ["stage-key-missing"]
    assert [one.kind for one in seen.found] == ["projector"]
    with pytest.raises(UsageError):
        hall.examine(write=True)


def test_a_bus_that_cannot_be_looked_at_stops_no_other(hall: Hall) -> None:
    def fail(wanted: SearchScope, deadline: Deadline) -> Sequence[Found]:
        raise DeviceBusy("bus-taken", what="It is taken.", remedy="Free it.")

    hall.plug("left")
    hall.others = [Finder("broken", fail)]
    seen = hall.examine()
    assert codes(seen) == ["bus-taken"]
    assert len(seen.found) == 1


def boom(*_: object) -> Any:
    raise ZeroDivisionError("a mistake of the driver's author")


@pytest.mark.parametrize("call", ["open", "check", "identity", "capabilities", "close"])
def test_a_driver_that_raises_anything_is_named_and_everything_else_is_still_told(hall: Hall, call: str) -> None:
    class Bad(ModelCamera):
        """Fails in one call."""

    if call == "capabilities":
        Bad.capabilities = property(boom)  # type: ignore[assignment,method-assign]
    elif call in ("identity", "close"):
        setattr(Bad, call, lambda self, **_: boom())
    bad = Driver("camera", "model", "A camera.", boom if call == "open" else lambda *_: Bad(), {"address": "where"},
                 check=boom if call == "check" else None)  # fmt: skip
    hall.drivers = Drivers((*(one for one in hall.drivers.list if one.kind != "camera"), bad))
    hall.plug("left")
    seen = hall.examine()
    assert "driver-fault" in codes(seen)
    fault = next(finding for finding in seen.findings if finding.code == "driver-fault")
    for word in ("'model' of the camera", call, "ZeroDivisionError"):
        assert word in fault.what
    assert "1200 lamp hours" in str(seen.tried[0].answer), "the projector was tried too"


def test_a_device_is_named_where_a_stage_may_have_several(hall: Hall) -> None:
    bad = Driver("projector", "serial", "A projector.", boom, {"profile": "", "port": ""})
    hall.plug("left")
    hall.drivers = Drivers((*(one for one in hall.drivers.list if one.name != "serial"), bad))
    fault = next(finding for finding in hall.examine().findings if finding.code == "driver-fault")
    assert "'serial' of projector left" in fault.what


def test_two_drivers_of_one_name_are_a_problem_and_nothing_else_is_lost(hall: Hall) -> None:
    claimed = ("projector", "acme")
    twice = [BrokenPlugin(f"p{n} = p{n}:DRIVER", f"dist-{n}", "two", "Uninstall one.", claimed) for n in (1, 2)]
    hall.drivers = Drivers(hall.drivers.list, tuple(twice))
    hall.plug("left")
    seen = hall.examine()
    assert codes(seen) == ["plugin-broken", "plugin-broken"]
    assert seen.findings[0].remedy == "Uninstall one."
    assert len(seen.tried) == 2


@pytest.mark.parametrize("found", [boom, lambda *_: None, lambda *_: ["a camera"]])
def test_a_finder_that_raises_or_finds_nonsense_stops_no_other(hall: Hall, found: Any) -> None:
    hall.plug("left")
    hall.others = [Finder("odd bus", found)]
    seen = hall.examine()
    assert codes(seen) == ["driver-fault"]
    assert "odd bus" in seen.findings[0].what
    assert len(seen.found) == 1


def test_a_running_stage_is_not_disturbed(hall: Hall) -> None:
    with exclusive(hall.folder / LOCK, what_is_running="Velatura"), pytest.raises(UsageError) as caught:
        hall.examine()
    assert caught.value.code == "already-running"


def test_what_a_device_says_of_itself_cannot_move_the_terminal(hall: Hall) -> None:
    hall.plug("left")
    hall.others = [on_bus(Found("hid", "x", "panel \x1b[2J", "", ""))]
    seen = hall.examine()
    assert "\x1b" not in seen.as_text()
    assert "\x1b" not in json.loads(json.dumps(seen.as_json()))["found"][-1]["what"]


def test_without_a_stage_only_what_is_plugged_in_is_told(hall: Hall, monkeypatch: Any) -> None:
    monkeypatch.chdir(hall.folder)
    hall.plug("left")
    seen = hall.examine(stage=False)
    assert seen.tried == ()
    assert len(seen.new) == 1
    assert seen.healthy


def test_nothing_is_searched_on_a_network_unless_it_is_asked_for(tmp_path: Path) -> None:
    class Said(Told):
        def __init__(self) -> None:
            self.all: list[str] = []

        def say(self, text: str, *rest: Any, **more: Any) -> None:
            self.all.append(text)

    wanted: list[Any] = []

    def find(told: Any, deadline: Any) -> list[Found]:
        wanted.append(told)
        return []

    for network in ("", "all", "lo"):
        reporter = Said()
        tools = Tools((Finder("network", find),), None)
        if network == "lo":
            with pytest.raises(UsageError, match="no broadcast address"):
                examine(
                    stage=None,
                    write_it=False,
                    reporter=reporter,
                    cancel=threading.Event(),
                    network=network,
                    tools=tools,
                )
            continue
        examine(stage=None, write_it=False, reporter=reporter, cancel=threading.Event(), network=network, tools=tools)
        place = "255.255.255.255" if network else "Not searching the network"
        assert any(place in line for line in reporter.all)
    assert [told.search for told in wanted] == [None, ("255.255.255.255", 4352)]
    with pytest.raises(UsageError, match="'eth77'"):
        examine(stage=None, write_it=False, reporter=Said(), cancel=threading.Event(), network="eth77", tools=Tools(()))
