from __future__ import annotations

import io
import json
from dataclasses import replace

import pytest

from controller.cli import console
from controller.core.text import duration, printable
from controller.run.progress import Phase, Progress
from hal.notices import Level

HOSTILE = "EP910 \x1b]0;owned\x07 [bold]\x00\n\u202e"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def now(phase: Phase = Phase.RUNNING, step_fraction: float = 0.0, note: str = "") -> Progress:
    return Progress("Decode", 1, 4, phase, 0.3, step_fraction, 12.0, 65.0, note)


def test_machines_get_one_object_a_line() -> None:
    stream = io.StringIO()
    with console.json_lines(True), console.reporter(stream) as reporter:
        reporter.progress(now(note=HOSTILE))
        reporter.say("three lamps", Level.WARNING)
    progress, message = (json.loads(line) for line in stream.getvalue().splitlines())
    assert progress["progress"]["step"] == "Decode"
    assert progress["progress"]["fraction"] == 0.3
    assert progress["progress"]["left_s"] == 65.0
    assert message == {"message": {"level": "warning", "text": "three lamps"}}


def test_plain_output_has_one_line_for_a_step_and_one_a_minute_within_a_long_one() -> None:
    stream = io.StringIO()
    with console.reporter(stream) as reporter:
        for hundredth in range(100):
            reporter.progress(now(step_fraction=hundredth / 100))
        reporter.progress(now(Phase.DONE))
        for second in range(12, 100):
            reporter.progress(replace(now(), elapsed_s=float(second)))
    lines = stream.getvalue().splitlines()
    assert lines == ["[ 30%, 1 min 05 s left] 2/4 Decode: done", "[ 30%, 1 min 05 s left] 2/4 Decode: ..."]


def test_a_terminal_sees_step_percentage_and_time_left() -> None:
    terminal = Terminal()
    with console.reporter(terminal) as reporter:
        reporter.progress(now(note="shot 7 of 35"))
        reporter.progress(now(Phase.SKIPPED))
    text = terminal.getvalue()
    assert "Decode: done earlier" in text
    assert "1 min 05 s left" in text
    assert "30%" in text


@pytest.mark.parametrize("stream", [io.StringIO(), Terminal()], ids=["plain", "terminal"])
def test_what_a_device_said_cannot_steer_the_terminal(stream: io.StringIO) -> None:
    with console.reporter(stream) as reporter:
        reporter.say(f"This is {HOSTILE}.")
        reporter.progress(now(note=HOSTILE))
    text = stream.getvalue()
    assert "\x1b]0" not in text
    assert "\x07" not in text
    assert "\u202e" not in text
    assert "[bold]" in text


def test_errors_are_two_sentences_on_stderr_or_one_object_on_stdout(capsys: pytest.CaptureFixture[str]) -> None:
    console.show_error("camera-gone", f"The camera {HOSTILE} left.", "Plug it in.")
    people = capsys.readouterr()
    assert people.out == ""
    assert people.err.startswith("velatura: The camera EP910")
    assert people.err.endswith("left.\nPlug it in.\n")
    assert "\x1b" not in people.err
    with console.json_lines(True):
        console.show_error("camera-gone", HOSTILE, "Plug it in.")
    machines = capsys.readouterr()
    assert json.loads(machines.out) == {
        "error": {"code": "camera-gone", "what": printable(HOSTILE), "remedy": "Plug it in."}
    }
    assert machines.err == ""


def test_a_result_is_for_people_without_marks_of_a_language(capsys: pytest.CaptureFixture[str]) -> None:
    console.show_result({"names": ["a", "b"], "rows": [{"lit": True, "error": 0.123456789}, {"lit": None}], "none": ()})
    assert capsys.readouterr().out == "names: a, b\nrows: lit yes, error 0.123457; lit -\nnone: -\n"


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(-1, "0 s"), (59.4, "59 s"), (59.6, "1 min 00 s"), (3599, "59 min 59 s"), (4800, "1 h 20 min")],
)
def test_durations_are_for_people(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_line_breaks_become_spaces_and_other_controls_a_mark() -> None:
    assert printable("a\tb\nc\x1bd") == "a b c\ufffdd"
