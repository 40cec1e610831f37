"""Faults by a script: each kind happens when it should, ends when it should, and is refused when it can't."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial

from hal.deadline import in_seconds
from hal.errors import DeviceError
from lab.emulated.scenario import ScenarioPlayer, parse_scenario, read_scenario
from plugins.emulated.core.faults import Faults
from plugins.emulated.projectors.lamp import EmulatedLamp, LampTiming
from plugins.emulated.projectors.serial import EmulatedSerialProjector
from tests.plugins.emulated.conftest import Clock


class Plugged:
    def __init__(self) -> None:
        self.plugged = True

    def unplug(self) -> None:
        self.plugged = False

    def replug(self) -> None:
        self.plugged = True


class Stand:
    """A player with a clock that is turned by hand."""

    def __init__(self, text: str, device: str = "left") -> None:
        self.clock, self.faults, self.plug = Clock(), Faults(), Plugged()
        self.lamp = EmulatedLamp(LampTiming(0, 0), clock=self.clock)
        scenario = parse_scenario(text, file="faults.toml")
        self.player = ScenarioPlayer(
            scenario, device=device, faults=self.faults, lamp=self.lamp, plug=self.plug, clock=self.clock
        )

    def after(self, seconds: float) -> None:
        self.clock.now_s += seconds
        self.player.tick()


def test_an_event_begins_at_its_time_and_ends_after_its_duration() -> None:
    stand = Stand('[[event]]\ndo = "unplug"\nat_s = 5.0\nfor_s = 2.0\n')
    seen = []
    for _ in range(9):
        seen.append(stand.plug.plugged)
        stand.after(1.0)
    assert seen == [True] * 5 + [False] * 2 + [True] * 2
    assert stand.player.happened == [(5.0, "unplug")]


def test_an_event_without_a_duration_concerns_one_answer() -> None:
    stand = Stand('[[event]]\ndo = "garbage"\non_message = 2\n')
    for expected in (b"OK1\r", None, b"OK1\r"):
        stand.player.heard(9)
        carried, _ = stand.faults.bent(b"OK1\r")
        assert (carried == b"OK1\r") if expected else (carried != b"OK1\r")


@pytest.mark.parametrize(
    ("do", "answer", "wait_s"), [("cut", b"OK12", 0.0), ("slow", b"OK1200\r\n", 0.7), ("silence", b"OK1200\r\n", 0.0)]
)
def test_each_fault_bends_the_answer_in_its_own_way(do: str, answer: bytes, wait_s: float) -> None:
    stand = Stand(f'[[event]]\ndo = "{do}"\non_byte = 10\ndelay_s = 0.7\n')
    stand.player.heard(9)
    assert stand.faults.bent(b"OK1200\r\n") == (b"OK1200\r\n", 0.0)
    stand.player.heard(1)
    assert stand.faults.loses_this_one() is (do == "silence")
    assert stand.faults.bent(b"OK1200\r\n") == (answer, wait_s)
    assert stand.faults.bent(b"OK1200\r\n") == (b"OK1200\r\n", 0.0)


def test_lamps_fail_overheat_and_are_mended() -> None:
    stand = Stand('[[event]]\ndo = "lamp-failure"\nat_s = 1\nfor_s = 1\n[[event]]\ndo = "overheat"\nat_s = 3\n')
    states = []
    for _ in range(5):
        states.append((stand.lamp.failed, stand.lamp.too_hot))
        stand.after(1.0)
    assert states == [(False, False), (True, False), (False, False), (False, True), (False, True)]


def test_chance_follows_the_seed_and_the_device() -> None:
    text = 'seed = 3\n[[event]]\ndo = "silence"\nprobability = 0.3\n'

    def rolled(device: str) -> list[int]:
        stand = Stand(text, device)
        counts = []
        for _ in range(400):
            stand.player.heard(5)
            counts.append(len(stand.player.happened))
        return counts

    assert rolled("left") == rolled("left")
    assert rolled("left") != rolled("right")
    assert 80 < rolled("left")[-1] < 160


def test_an_event_for_another_device_leaves_this_one_alone() -> None:
    stand = Stand('[[event]]\ndo = "busy"\ndevice = "right"\nat_s = 0\n')
    stand.after(1.0)
    assert not stand.faults.now.busy


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ('[[event]]\ndo = "explode"\nat_s = 1\n', "scenario-wrong"),
        ('[[event]]\ndo = "cut"\n', "scenario-wrong"),
        ('[[event]]\ndo = "cut"\nat_s = 1\nprobability = 0.5\n', "scenario-wrong"),
        ('[[event]]\ndo = "cut"\nprobability = 1.5\n', "bench-key-wrong"),
        ('[[event]]\ndo = "cut"\nwhen = 1\n', "bench-key-unknown"),
        ("[[event]]\nat_s = 1\n", "bench-key-missing"),
        ("seed = 1\n", "bench-key-missing"),
        ("[[event]\n", "bench-file-unreadable"),
    ],
)
def test_a_scenario_that_cannot_be_is_refused(text: str, code: str) -> None:
    with pytest.raises(DeviceError) as caught:
        parse_scenario(text, file="faults.toml")
    assert caught.value.code == code
    assert "faults.toml" in caught.value.what


def test_a_missing_scenario_is_named(tmp_path: Path) -> None:
    with pytest.raises(DeviceError) as caught:
        read_scenario(tmp_path / "none.toml")
    assert caught.value.code == "scenario-missing"


@pytest.fixture
def scripted(tmp_path: Path) -> Iterator[EmulatedSerialProjector]:
    text = '[[event]]\ndo = "silence"\non_message = 2\n[[event]]\ndo = "unplug"\non_message = 4\nfor_s = 0.1\n'
    lamp = EmulatedLamp(LampTiming(0, 0))
    with EmulatedSerialProjector(tmp_path / "tty", lamp) as made:
        made.scenario = ScenarioPlayer(
            parse_scenario(text, file="faults.toml"), device="left", faults=made.faults, lamp=lamp, plug=made
        )
        yield made


def test_a_projector_on_a_pty_follows_its_script(scripted: EmulatedSerialProjector) -> None:
    before = scripted.path
    with serial.Serial(str(scripted.port), 9600, timeout=20) as line:
        answers = []
        for timeout_s in (20, 0.5, 20):
            line.timeout = timeout_s
            line.write(b"~00124 1\r")
            answers.append(bytes(line.read_until(b"\r")))
        assert answers == [b"OK0\r", b"", b"OK0\r"]
        line.write(b"~00124 1\r")
        with pytest.raises((serial.SerialException, OSError)):
            line.read(10)
    deadline = in_seconds(30)
    while scripted.path in (None, before) and not deadline.passed:
        time.sleep(0.02)
    assert scripted.path not in (None, before)
