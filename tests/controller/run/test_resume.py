"""Kills and Ctrl-C at random moments: what was done stays done, and the end is the same to the byte."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

from controller.run.journal import Journal
from controller.stage.rig.lamp_ledger import LampFile

TOY = Path(__file__).with_name("toy_pipeline.py")


SLOW_S = "0.2"
"""A pause that leaves even a busy machine the time to press Ctrl-C in the middle of the work."""


def start(folder: Path, pause_s: str = "0.01") -> subprocess.Popen[str]:
    folder.mkdir(exist_ok=True)
    process = subprocess.Popen([sys.executable, TOY, folder, pause_s], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline().startswith("begun")
    return process


def finish(folder: Path) -> int:
    process = start(folder)
    process.communicate(timeout=60)
    return process.returncode


def artefacts(folder: Path) -> dict[str, bytes]:
    files = [*folder.glob("*.bin"), *folder.glob("captures/*.raw")]
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("uninterrupted")
    assert finish(folder) == 0
    return artefacts(folder)


@pytest.mark.parametrize("seed", range(3))
def test_after_kills_at_random_the_end_is_the_same_and_little_is_repeated(
    tmp_path: Path, uninterrupted: dict[str, bytes], seed: int
) -> None:
    chance = random.Random(seed)
    kills = 0
    for _ in range(4):
        process = start(tmp_path)
        time.sleep(chance.uniform(0.0, 0.25))
        kills += process.poll() is None
        process.kill()
        process.communicate()
    assert finish(tmp_path) == 0
    assert artefacts(tmp_path) == uninterrupted
    worked = Counter((tmp_path / "worked.log").read_text().split())
    assert sum(worked.values()) - len(worked) <= kills, "more than one piece of work was repeated for a kill"
    assert not [file for file in tmp_path.rglob("*.part") if not kills]


def test_a_finished_run_does_nothing_again(tmp_path: Path) -> None:
    assert finish(tmp_path) == 0
    log = (tmp_path / "worked.log").read_text()
    assert finish(tmp_path) == 0
    assert (tmp_path / "worked.log").read_text() == log


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP], ids=lambda number: number.name)
def test_ctrl_c_cools_the_lamp_even_when_pressed_again_and_the_run_goes_on_later(
    tmp_path: Path, uninterrupted: dict[str, bytes], number: signal.Signals
) -> None:
    process = start(tmp_path, SLOW_S)
    while not (tmp_path / "worked.log").exists():
        time.sleep(0.005)
    assert (tmp_path / "lamp").read_text() == "lit"
    process.send_signal(number)
    assert process.stdout is not None
    assert process.stdout.readline().strip() == "cooling"
    process.send_signal(number)
    process.communicate(timeout=30)
    assert process.returncode == 130
    assert (tmp_path / "lamp").read_text() == "off"
    with Journal(tmp_path) as journal:
        assert journal.outcomes() == [("toy", "cancelled")]
        assert journal.events()[-1].text == "cooling -> off (cooled)"
    assert finish(tmp_path) == 0
    assert artefacts(tmp_path) == uninterrupted
    worked = Counter((tmp_path / "worked.log").read_text().split())
    assert max(worked.values()) == 1


def test_a_killed_run_leaves_the_lamp_on_record_as_lit(tmp_path: Path) -> None:
    process = start(tmp_path, SLOW_S)
    while not (tmp_path / "worked.log").exists():
        time.sleep(0.005)
    process.kill()
    process.communicate()
    record = LampFile(tmp_path / LampFile.NAME).read("toy")
    assert record is not None
    assert record.lit
    assert record.strikes == 1
