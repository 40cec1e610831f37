"""A demo that is killed leaves nothing that keeps the next one from continuing; and its help."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.end_to_end.kiosk import with_ports_of_its_own
from tests.end_to_end.program import REPOSITORY, Command, lamps, processes_on

pytestmark = pytest.mark.timeout(600)


@pytest.mark.long
def test_a_killed_demos_bench_ends_by_itself_and_the_same_command_goes_on(prepared_once: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(prepared_once, tmp_path / "out"))
    with_ports_of_its_own(out / "stage")
    with Command("demo", "--room", "dark", "--out", out) as demo:
        demo.wait_for("Waiting for stable light")
        demo.kill()
    # At once: the bench and the player of the killed one may still be there.
    with Command("demo", "--room", "dark", "--out", out) as demo:
        demo.wait_for("Waiting for stable light")
        assert lamps(out / "stage") == {"left": True, "right": True, "above": True}
        stopped = demo.interrupt()
    assert stopped.code == 130
    assert lamps(out / "stage") == {"left": False, "right": False, "above": False}
    ends_s = time.monotonic() + 60
    while processes_on(out / "stage") and time.monotonic() < ends_s:
        time.sleep(0.1)
    assert processes_on(out / "stage") == []


def test_ctrl_c_while_the_bench_starts_ends_both(prepared_once: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(prepared_once, tmp_path / "out"))
    with_ports_of_its_own(out / "stage")
    with Command("demo", "--room", "dark", "--out", out) as demo:
        demo.wait_for_message("Starting the bench")
        stopped = demo.interrupt()
    assert stopped.code == 130
    assert processes_on(out / "stage") == []
    assert not (out / "stage" / "runs").exists()


@pytest.mark.parametrize("command", ["demo", "calibrate", "appearance", "play", "emulate", "kiosk"])
def test_every_command_explains_itself(command: str) -> None:
    words = [sys.executable, "-m", "controller", command, "--help"]
    told = subprocess.run(words, capture_output=True, text=True, cwd=REPOSITORY, check=True).stdout
    assert f"velatura {command}" in told
    assert "--help" in told
