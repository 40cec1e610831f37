"""What a person sees on the terminal, and what a machine reads with ``--json``."""

from __future__ import annotations

import contextlib
import json
import sys
import threading
from collections.abc import Iterator, Mapping
from typing import Any, Final, TextIO

from controller.session.progress import Level, Phase, Progress, Reporter
from controller.text import duration, printable

PLAIN_EVERY: Final = 0.25
"""Share of a step after which plain output says another line."""


@contextlib.contextmanager
def reporter(*, as_json: bool, stream: TextIO | None = None) -> Iterator[Reporter]:
    """The reporter for ``stream``: JSON lines (default stdout), Rich on a terminal, plain lines elsewhere (stderr)."""
    if as_json:
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
    """One line for each change of step, and for each quarter of a long one."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._lock = threading.Lock()
        self._last: tuple[int, Phase, int] | None = None

    def progress(self, now: Progress) -> None:
        mark = (now.index, now.phase, int(now.step_fraction / PLAIN_EVERY) if now.phase is Phase.RUNNING else 0)
        if mark == self._last:
            return
        self._last = mark
        left = "" if now.left_s is None or now.fraction >= 1 else f", {duration(now.left_s)} left"
        what = {Phase.RUNNING: now.note or "...", Phase.DONE: "done", Phase.SKIPPED: "done earlier"}[now.phase]
        self._print(f"[{now.fraction:4.0%}{left}] {now.index + 1}/{now.count} {now.step}: {what}")

    def say(self, text: str, level: Level = Level.INFO) -> None:
        self._print(text if level is Level.INFO else f"{level.value}: {text}")

    def _print(self, text: str) -> None:
        with self._lock:
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


def show_error(code: str, what: str, remedy: str, *, as_json: bool) -> None:
    """One sentence on what happened and one on what to do, on stderr; for machines one JSON line on stdout."""
    if as_json:
        JsonReporter(sys.stdout).line(error={"code": code, "what": what, "remedy": remedy})
        return
    if not sys.stderr.isatty():
        print(f"velatura: {printable(what)}\n{printable(remedy)}", file=sys.stderr, flush=True)  # noqa: T201
        return
    from rich.console import Console
    from rich.text import Text

    message = Text.assemble(("velatura: ", "bold red"), printable(what), "\n", (printable(remedy), "bold"))
    Console(stderr=True, highlight=False, soft_wrap=True).print(message)


def show_result(result: Mapping[str, Any] | str | None, *, as_json: bool) -> None:
    """What a command returned: ``{"result": ...}`` for machines; for people the text, or ``key: value`` lines."""
    if as_json:
        JsonReporter(sys.stdout).line(result=result)
    elif isinstance(result, str):
        print(result, flush=True)  # noqa: T201 - the command line's own output
    elif result is not None:
        lines = (f"{printable(str(key))}: {printable(str(value))}" for key, value in result.items())
        print("\n".join(lines), flush=True)  # noqa: T201 - the command line's own output
