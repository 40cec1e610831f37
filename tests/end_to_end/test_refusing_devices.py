"""Devices that do not answer or are in use, and people who go away: lamps are left alone, or off. One bench for all."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from hal.values import Power
from tests.end_to_end.kiosk import with_ports_of_its_own
from tests.end_to_end.program import LONGEST_S, REPOSITORY, Bench, Command, lamps, powers, velatura, wrong_code

pytestmark = [pytest.mark.long, pytest.mark.timeout(600)]


@pytest.fixture(scope="module")
def served(prepared_once: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Bench]]:
    out = Path(shutil.copytree(prepared_once, tmp_path_factory.mktemp("served") / "out"))
    with_ports_of_its_own(out / "stage")
    with Bench(out / "stage") as bench:
        yield out / "stage", bench


def test_a_port_in_use_is_told(served: tuple[Path, Bench]) -> None:
    assert wrong_code(velatura("emulate", served[0]), code=3) == "port-in-use"


def test_a_demo_beside_it_is_told_of_the_port_in_use_and_lights_nothing(served: tuple[Path, Bench]) -> None:
    assert wrong_code(velatura("demo", "--room", "dark", "--out", served[0].parent), code=3) == "port-in-use"
    assert lamps(served[0]) == {}


def test_a_silent_projector_is_named_before_any_lamp_is_struck(served: tuple[Path, Bench]) -> None:
    stage, bench = served
    bench.turn("silent right")
    outcome = velatura("calibrate", stage)
    bench.turn("answering right")
    assert wrong_code(outcome, code=3) == "projector-no-answer"
    assert "tty-right" in outcome.error["what"]
    assert outcome.seconds < 30
    assert not any(lamps(stage).values())


def test_a_stage_in_use_is_told_and_the_one_at_work_is_not_disturbed(served: tuple[Path, Bench]) -> None:
    stage, _ = served
    with Command("calibrate", stage) as working:
        working.wait_for("Switching the projectors on")
        for command in ("calibrate", "appearance", "demo"):
            where = ["--room", "dark", "--out", stage.parent] if command == "demo" else [stage]
            assert wrong_code(velatura(command, *where)) == "already-running"
        assert working.interrupt().code == 130


@pytest.mark.parametrize("way", ["reader", "terminal"])
def test_a_reader_or_a_terminal_that_goes_away_leaves_no_lamp_lit(served: tuple[Path, Bench], way: str) -> None:
    stage, _ = served
    ours, theirs = os.pipe() if way == "reader" else os.openpty()
    words = ["setsid", "-c"] if way == "terminal" else []
    words += [sys.executable, "-m", "controller", "calibrate", str(stage)]
    working = subprocess.Popen(words, stdin=theirs, stdout=theirs, stderr=theirs, cwd=REPOSITORY)
    os.close(theirs)
    told = b""
    while b"Photographing black" not in told and working.poll() is None:
        told += os.read(ours, 4096)
    os.close(ours)
    # A calibration whose reader is gone continues to its end, which takes as long as the machine needs.
    assert working.wait(LONGEST_S) in (1, 130)
    assert lamps(stage) == {"left": False, "right": False, "above": False}
    assert set(powers(stage).values()) <= {Power.OFF, Power.COOLING}
    assert b"Traceback" not in told


def test_a_camera_that_is_off_is_told_before_any_lamp_is_struck(served: tuple[Path, Bench]) -> None:
    stage, bench = served
    bench.turn("camera off")
    outcome = velatura("calibrate", stage)
    assert wrong_code(outcome, code=3) == "camera-off"
    assert "battery" in outcome.error["remedy"]
    assert not any(lamps(stage).values())
