"""Output on the terminal, and JSON lines with ``--json``.

Every command has ``--json``. With it, standard output holds one JSON object a line: ``{"progress": {...}}`` and
``{"message": {"level", "text"}}`` while it works, and at its end ``{"result": {...}}``, or
``{"error": {"code", "what", "remedy"}}``.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
import os
import sys
import threading
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from pathlib import Path
from typing import Any, Final, TextIO

from controller.core.text import duration, printable
from controller.run.progress import Phase, Progress, Reporter
from hal.notices import Level

SILENT_S: Final = 60.0
"""After so many seconds, plain output prints a line within a step, too."""

_JSON: ContextVar[bool] = ContextVar("json", default=False)


@contextlib.contextmanager
def json_lines(on: bool) -> Iterator[None]:
    """Print for programs (``on``) or for people, while it is entered."""
    before = _JSON.set(on)
    try:
        yield
    finally:
        _JSON.reset(before)


def as_json() -> bool:
    """Whether ``--json`` was given."""
    return _JSON.get()


@contextlib.contextmanager
def reporter(stream: TextIO | None = None) -> Iterator[Reporter]:
    """A command's reporter for ``stream``: JSON lines (default: stdout), a bar on a terminal, else lines (stderr)."""
    if as_json():
        yield JsonReporter(stream or sys.stdout)
    elif (stream or sys.stderr).isatty():
        with RichReporter(stream or sys.stderr) as rich_reporter:
            yield rich_reporter
    else:
        yield PlainReporter(stream or sys.stderr)


class JsonReporter:
    """One JSON object a line: ``{"progress": {...}}`` and ``{"message": {...}}``."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._lock = threading.Lock()

    def progress(self, now: Progress) -> None:
        self.line(
            progress={
                "step": now.step,
                "index": now.index,
                "count": now.count,
                "phase": now.phase.value,
                "fraction": round(now.fraction, 4),
                "step_fraction": round(now.step_fraction, 4),
                "elapsed_s": round(now.elapsed_s, 2),
                "left_s": None if now.left_s is None else round(now.left_s, 1),
                "note": now.note,
            }
        )

    def say(self, text: str, level: Level = Level.INFO) -> None:
        self.line(message={"level": level.value, "text": text})

    def line(self, **content: Any) -> None:
        """Print ``content`` as one line, at once."""
        with self._lock:
            print(json.dumps(content, default=str), file=self._stream, flush=True)


class PlainReporter:
    """One line for each step, when it ends; one a minute within a long step."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._lock = threading.Lock()
        self._printed_s = 0.0

    def progress(self, now: Progress) -> None:
        if now.phase is Phase.RUNNING and now.elapsed_s - self._printed_s < SILENT_S:
            return
        self._printed_s = now.elapsed_s
        left = "" if now.left_s is None or now.fraction >= 1 else f", {duration(now.left_s)} left"
        what = {Phase.RUNNING: now.note or "...", Phase.DONE: "done", Phase.SKIPPED: "done earlier"}[now.phase]
        self._print(f"[{now.fraction:4.0%}{left}] {now.index + 1}/{now.count} {now.step}: {what}")

    def say(self, text: str, level: Level = Level.INFO) -> None:
        self._print(text if level is Level.INFO else f"{level.value}: {text}")

    def _print(self, text: str) -> None:
        # Work that lights lamps does not stop only because its progress can't be printed.
        with self._lock, contextlib.suppress(OSError):
            print(printable(text), file=self._stream, flush=True)


class RichReporter:
    """A bar with steps, percentage and time left; finished steps stay above it."""

    def __init__(self, stream: TextIO) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, TaskProgressColumn, TextColumn
        from rich.progress import Progress as Bar

        self._console = Console(file=stream, highlight=False)
        self._bar = Bar(
            TextColumn("{task.fields[step]}", markup=False),
            BarColumn(),
            TaskProgressColumn(),
            TextColumn("{task.fields[left]}", markup=False),
            console=self._console,
            transient=True,
        )
        self._task = self._bar.add_task("", total=1.0, step="", left="", visible=False)

    def __enter__(self) -> RichReporter:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def progress(self, now: Progress) -> None:
        left = "" if now.left_s is None else f"{duration(now.left_s)} left"
        note = f": {now.note}" if now.note else ""
        step = printable(f"{now.index + 1}/{now.count} {now.step}{note}")
        self._bar.update(self._task, completed=now.fraction, step=step, left=left, visible=True)
        if now.phase is not Phase.RUNNING:
            mark = "done" if now.phase is Phase.DONE else "done earlier"
            self._above(f"{duration(now.elapsed_s):>12}  {now.step}: {mark}", "green")

    def say(self, text: str, level: Level = Level.INFO) -> None:
        self._above(text, {Level.INFO: "", Level.WARNING: "yellow", Level.ERROR: "bold red"}[level])

    def _above(self, text: str, style: str) -> None:
        from rich.text import Text

        self._console.print(Text(printable(text), style=style))


def show_error(code: str, what: str, remedy: str) -> None:
    """One sentence on what happened and one on what to do, on stderr; for machines one JSON line on stdout."""
    if as_json():
        JsonReporter(sys.stdout).line(error={"code": code, "what": printable(what), "remedy": printable(remedy)})
        return
    if not sys.stderr.isatty() or importlib.util.find_spec("rich") is None:
        print(f"velatura: {printable(what)}\n{printable(remedy)}", file=sys.stderr, flush=True)  # noqa: T201
        return
    from rich.console import Console
    from rich.text import Text

    message = Text.assemble(("velatura: ", "bold red"), printable(what), "\n", (printable(remedy), "bold"))
    Console(stderr=True, highlight=False, soft_wrap=True).print(message)


def prepare_streams() -> None:
    """Make the standard streams safe: a closed one discards output, and unprintable characters raise no error.

    Otherwise the next opened file would get the closed stream's number, and child processes would write into it.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            handle = os.open(os.devnull, os.O_RDWR)
            if handle != number:
                os.dup2(handle, number)
                os.close(handle)
            os.set_inheritable(number, True)
            setattr(sys, name, open(number, "w" if number else "r", closefd=False, encoding="utf-8"))  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper) and isinstance(sys.stdout.buffer, io.RawIOBase):
        # PYTHONUNBUFFERED: a write error would be lost, and ``output_lost`` could not find it
        sys.stdout = open(1, "w", 1, closefd=False, encoding=sys.stdout.encoding)  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _is_of_printing(error: OSError) -> bool:
    """Whether it was raised where text is printed. A long text is not kept for the next flush when its write fails."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    place = "" if trace is None else trace.tb_frame.f_code.co_filename
    return place == __file__ or not {"click", "rich", "typer"}.isdisjoint(Path(place).parts)


def output_lost(because: OSError | None = None) -> bool:
    """Whether writing to standard output fails, now or as ``because`` says. If so, report it on standard error and stop
    writing.
    """
    try:
        sys.stdout.flush()
        if because is not None and _is_of_printing(because):
            raise because
    except OSError as error:
        if not isinstance(error, BrokenPipeError):
            what = f"The output could not be written: {error.strerror}."
            with contextlib.suppress(OSError), json_lines(False):
                show_error("output-lost", what, "Check the output's destination and start the command again.")
        # Otherwise Python tries again at exit and fails with its own message.
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115
        return True
    return False


def say(sentence: str) -> None:
    """Print a sentence on standard output while a command works; for programs as a message."""
    if as_json():
        JsonReporter(sys.stdout).say(sentence)
    else:
        print(printable(sentence), flush=True)  # noqa: T201 - the command line's own output


def show_result(result: Mapping[str, Any], text: str | None = None) -> None:
    """Print a command's result: ``{"result": ...}`` as JSON; for people ``text``, by default ``key: value`` lines."""
    if as_json():
        JsonReporter(sys.stdout).line(result=result)
        return
    if text is None:
        text = "\n".join(f"{printable(str(key))}: {printable(_words(value))}" for key, value in result.items())
    print(text, flush=True)  # noqa: T201 - the command line's own output


def _words(value: Any) -> str:
    """A value for people, without the marks that Python writes it with."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_words(item)}" for key, item in value.items()) or "-"
    if isinstance(value, list | tuple | set | frozenset):
        between = "; " if any(isinstance(item, Mapping) for item in value) else ", "
        return between.join(map(_words, value)) or "-"
    return str(value)
