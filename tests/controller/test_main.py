"""The command line's shell, by what it prints and returns."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Annotated, Any

import pytest
import typer

from controller import __main__ as shell
from controller.cli import groups
from controller.core.errors import CalibrationError, UsageError
from hal.deadline import Cancelled
from hal.errors import DeviceGone

SENTENCES = {"what": "It \x1b[31mhappened.", "remedy": "Do this."}


def trial(kind: Annotated[str, typer.Argument()] = "", times: Annotated[int, typer.Option()] = 1) -> None:
    """A command for these tests."""

    def do(reporter: Any, cancel: threading.Event) -> dict[str, Any]:
        return work(kind=kind, times=times, reporter=reporter, cancel=cancel)

    groups.work(do)


def work(*, kind: str, times: int, reporter: Any, cancel: threading.Event) -> dict[str, Any]:
    errors: dict[str, BaseException] = {
        "calibration": CalibrationError("too-dark", **SENTENCES),
        "usage": UsageError("stage-missing", **SENTENCES),
        "device": DeviceGone("camera-gone", **SENTENCES),
        "cancelled": Cancelled(),
        "space": OSError(28, "No space left on device", "frame.exr"),
        "bug": ZeroDivisionError("a secret of the programmer"),
    }
    if kind in errors:
        raise errors[kind]
    if kind == "signal":
        os.kill(os.getpid(), signal.SIGINT)
        assert cancel.wait(60)
        raise Cancelled
    reporter.say("at work")
    return {"times": times, "path": Path("x")}


@pytest.fixture(autouse=True)
def trial_command(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    program = typer.main.get_command(shell.application({**shell.MEMBERS, "For these tests": (trial,)}))
    monkeypatch.setattr(shell, "_built", lambda: program)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))


@pytest.mark.parametrize(
    ("kind", "exit_code", "code"),
    [
        ("calibration", 1, "too-dark"),
        ("usage", 2, "stage-missing"),
        ("device", 3, "camera-gone"),
        ("space", 1, "no-space"),
        ("cancelled", 130, "cancelled"),
        ("signal", 130, "cancelled"),
        ("bug", 1, "crash"),
    ],
)
def test_every_failure_has_two_sentences_and_its_exit_code(
    kind: str, exit_code: int, code: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert shell.run(["trial", kind]) == exit_code
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.startswith("velatura: ")
    assert shown.err.count("\n") == 2
    assert "Traceback" not in shown.err
    assert "\x1b" not in shown.err
    assert shell.run(["trial", kind, "--json"]) == exit_code
    shown = capsys.readouterr()
    error = json.loads(shown.out)["error"]
    assert set(error) == {"code", "what", "remedy"}
    assert error["code"] == code
    assert shown.err == ""


def test_a_crash_keeps_its_traceback_in_a_private_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shell.run(["trial", "bug"])
    (report,) = (tmp_path / "velatura").iterdir()
    assert str(report) in capsys.readouterr().err
    assert "ZeroDivisionError: a secret of the programmer" in report.read_text()
    assert report.stat().st_mode & 0o077 == 0


def test_a_crash_is_told_even_when_no_report_can_be_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_bytes(b"")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path / "file"))
    assert shell.run(["trial", "bug"]) == 1
    assert "The error report could not be written" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments", [["trial", "--times", "many"], ["trial", "--no-such-option"], ["no-such-command"], ["trial", "a", "b"]]
)
def test_wrong_use_is_told_with_exit_code_two(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert shell.run(arguments) == 2
    assert "--help" in capsys.readouterr().err
    assert shell.run([*arguments, "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["error"]["code"] == "wrong-use"


def test_a_command_that_succeeds_shows_its_result(capsys: pytest.CaptureFixture[str]) -> None:
    assert shell.run(["trial", "--times", "3"]) == 0
    shown = capsys.readouterr()
    assert shown.out == "times: 3\npath: x\n"
    assert shown.err == "at work\n"
    assert shell.run(["trial", "--json"]) == 0
    message, result = (json.loads(line) for line in capsys.readouterr().out.splitlines())
    assert message["message"]["text"] == "at work"
    assert result == {"result": {"times": 1, "path": "x"}}


def test_help_names_every_listed_command_with_its_first_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    program: Any = shell._built()
    listed = [word for word in groups.words_of(program) if " " not in word and not program.commands[word].hidden]
    for arguments in ([], ["--help"]):
        assert shell.run(arguments) == 0
        shown = capsys.readouterr().out
        assert all(f"\n  {word} " in shown for word in listed)
        assert "A command for these tests." in shown


def test_help_loads_nothing_heavy() -> None:
    heavy = {"numpy", "numba", "scipy", "cv2", "rich", "sqlite3", "controller.config"}
    code = f"""
import sys
from controller.__main__ import run
assert run(["--help"]) == 0
assert run(["kiosk", "--help"]) == 0
print(sorted({heavy!r} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_the_installed_command_answers_quickly() -> None:
    took_s = []
    for _ in range(3):
        began_s = time.monotonic()
        subprocess.run([sys.executable, "-m", "controller", "--help"], capture_output=True, check=True)
        took_s.append(time.monotonic() - began_s)
    # Generous: what is meant is that no numeric package is loaded, on a machine that may be busy.
    assert min(took_s) < 2.0
