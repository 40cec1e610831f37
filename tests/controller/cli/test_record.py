"""`velatura record` and `velatura emulate --tape`, as programs."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from controller.core.errors import WorkError
from controller.stage.sessions import run as recording
from hal.deadline import in_seconds
from hal.registry import OpenContext
from hal.values import Power
from lab.emulated.projectors.pjlink import EmulatedPjLinkProjector
from lab.emulated.tape import read_tape
from plugins.emulated.bench import DRIVER as BENCH
from plugins.emulated.projectors.lamp import EmulatedLamp, LampTiming
from plugins.projectors.pjlink import open_pjlink_projector

OPENS = """
import sys
from pathlib import Path
from controller.stage.sessions.run import open_context
from hal.deadline import in_seconds
from plugins.projectors.pjlink import open_pjlink_projector
driver = open_pjlink_projector({"address": sys.argv[1]}, open_context(Path()), in_seconds(20))
driver.status(deadline=in_seconds(20))
driver.close()
"""


def velatura(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "controller", *words], capture_output=True, text=True, timeout=100, check=False
    )


@pytest.mark.slow
def test_the_code_of_the_command_is_kept_and_a_missing_tape_is_told(tmp_path: Path) -> None:
    (tmp_path / "stage.toml").write_text("")
    done = velatura("record", str(tmp_path), "--", "--version")
    assert done.returncode == 0
    assert "velatura " in done.stdout
    assert "no tape" in done.stdout


@pytest.mark.slow
def test_a_process_with_a_tape_records_its_devices_and_the_tape_is_served(tmp_path: Path) -> None:
    tape = recording.new_tape(tmp_path, "one")
    lamp = EmulatedLamp(LampTiming(0.1, 0.1))
    with EmulatedPjLinkProjector(lamp, name="hall") as emulated:
        subprocess.run(
            [sys.executable, "-c", OPENS, emulated.address],
            env={**os.environ, recording.VARIABLE: str(tape)}, timeout=60, check=True,
        )  # fmt: skip
    assert [track.kind for track in read_tape(tape)] == ["pjlink"]
    assert recording.tapes(tmp_path) == [tape]
    words = [sys.executable, "-m", "controller", "emulate", "--tape", str(tape), "--json", "--until-input-ends"]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as serving:
        assert serving.stdout is not None
        served = json.loads(serving.stdout.readline())
        assert served["kind"] == "pjlink"
        driver = open_pjlink_projector({"address": served["address"]}, OpenContext(tmp_path), in_seconds(20))
        assert driver.status(deadline=in_seconds(20)).power is Power.OFF
        driver.close()
        assert serving.stdin is not None
        serving.stdin.close()
        assert serving.wait(20) == 0


def test_a_file_that_is_no_tape_is_refused_by_the_bench(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.tape").write_text("no such thing\n")
    assert BENCH.open({}, OpenContext(tmp_path), in_seconds(5)).replay(tmp_path / "a.tape", json_lines=False) == 3
    assert "not a tape" in capsys.readouterr().err


def test_a_tape_that_cannot_be_made_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(recording.VARIABLE, str(tmp_path / "missing" / "a.tape"))
    recording._tape.cache_clear()
    with pytest.raises(WorkError) as caught:
        recording.open_context(tmp_path)
    assert caught.value.code == "tape-not-made"
    assert recording.open_context(tmp_path).tape is None, "the variable is for one process"
