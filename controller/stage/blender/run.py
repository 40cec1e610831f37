"""Finds a Blender, has it render a job, and reports its progress. Blender runs as a process of its own: its libraries
do not mix with ours, a scene that brings it down brings nothing else down, and it can be stopped at any moment."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final

from controller.core.errors import UsageError, WorkError

VARIABLE: Final = "VELATURA_BLENDER"
ENVIRONMENT: Final = ".venv-blender"
"""Beside the environment in which Velatura runs; ``make blender`` creates it."""
_WORKER: Final = Path(__file__).with_name("worker.py")
_SAMPLE: Final = re.compile(r"(?:Rendered (\d+)/(\d+) Tiles, )?Sample (\d+)/(\d+)")
"""Large pictures are rendered in tiles, one after another, each with all its samples."""
_TOLD_LINES: Final = 6
_POLL_S: Final = 0.2


@dataclass(frozen=True, slots=True)
class Blender:
    """A program that renders: ``command`` before the worker's own arguments."""

    command: tuple[str, ...]

    @classmethod
    def at(cls, program: Path) -> Blender:
        """Blender itself, or a Python that has the ``bpy`` module."""
        if program.name.startswith("python"):
            return cls((str(program), str(_WORKER)))
        quiet = ("--background", "--factory-startup", "--python-exit-code", "1", "--python", str(_WORKER), "--")
        return cls((str(program), *quiet))


def find_blender() -> Blender:
    """The Blender of the environment variable VELATURA_BLENDER, of ``.venv-blender``, or on the search path.

    Raises UsageError("blender-missing").
    """
    named = os.environ.get(VARIABLE)
    if named:
        found = shutil.which(named)
        if found is None:
            raise UsageError(
                "blender-missing",
                what=f"{VARIABLE} names {named}, which is not a program.",
                remedy="Set it to Blender, or to a Python with the bpy module, or unset it.",
            )
        return Blender.at(Path(found))
    beside = Path(sys.prefix).parent / ENVIRONMENT / "bin" / "python"
    if beside.exists():
        return Blender.at(beside)
    installed = shutil.which("blender")
    if installed is not None:
        return Blender.at(Path(installed))
    raise UsageError(
        "blender-missing",
        what="Blender was not found, but this target needs it.",
        remedy=f"Run `make blender`, or install Blender 4.5 and set {VARIABLE} to its path.",
    )


def render(blender: Blender, folder: Path, advance: Callable[[float, str], None]) -> Path:
    """Render the job in ``folder``; returns the picture.

    ``advance`` gets the share that is done and a note, several times a second; what it raises ends Blender.
    Raises WorkError("blender-failed") with Blender's last words.
    """
    picture = folder / "picture.exr"
    picture.unlink(missing_ok=True)
    log = folder / "blender.log"
    with log.open("wb") as log_file, _running([*blender.command, str(folder)]) as process:
        assert process.stdout is not None
        watch = _Watch(process.stdout, log_file)
        while watch.reading(_POLL_S):
            advance(watch.share, watch.note)
        code = process.wait()
    if code != 0 or not picture.exists():
        raise WorkError(
            "blender-failed",
            what=f"Blender did not render the target: {watch.last_words() or f'it ended with code {code}'}.",
            remedy=f"Open the scene in Blender and correct it there; Blender's full log is {log}.",
        )
    return picture


@contextlib.contextmanager
def _running(command: Sequence[str]) -> Iterator[subprocess.Popen[bytes]]:
    """The process, in a group of its own, which is ended on leaving whatever happens."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    process = subprocess.Popen(  # noqa: S603 - a program that the user named, and a job of ours
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=environment,
        start_new_session=True,
    )  # fmt: skip
    try:
        yield process
    finally:
        if process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        assert process.stdout is not None
        process.stdout.close()


class _Watch:
    """Reads what Blender says in a thread, so that a stop is followed while Blender says nothing."""

    def __init__(self, stream: IO[bytes], log: IO[bytes]) -> None:
        self.share, self.note, self._left_out, self._tile = 0.0, "starting Blender", "", 0
        self._lines: list[str] = []
        self._stream, self._log = stream, log
        self._thread = threading.Thread(target=self._read, name="blender-output", daemon=True)
        self._thread.start()

    def _read(self) -> None:
        # ValueError: the process was ended, and its pipe closed under this thread.
        with contextlib.suppress(OSError, ValueError):
            for line in self._stream:
                self._log.write(line)
                self._note(line.decode(errors="replace").strip())

    def _note(self, line: str) -> None:
        found = _SAMPLE.search(line)
        if found is not None:
            tile, tiles, done, of = (int(number) for number in found.groups(default="0"))
            tiles, of = max(tiles, 1), max(of, 1)
            if tile > self._tile:  # the line that ends a tile still has that tile's samples
                self._tile, done = tile, 0
            self.share = max(self.share, min(0.05 + 0.95 * (tile + done / of) / tiles, 1.0))
            part = f"part {min(tile + 1, tiles)} of {tiles}, " if tiles > 1 else ""
            self.note = f"{part}sample {done} of {of}{self._left_out}"
        elif line.startswith("Omitted: "):
            self._left_out = f" ({line.lower()})"
            self.note += self._left_out
        elif line:
            self._lines = [*self._lines[-_TOLD_LINES:], line]

    def reading(self, wait_s: float) -> bool:
        """Wait a little; whether more may come."""
        self._thread.join(wait_s)
        return self._thread.is_alive()

    def last_words(self) -> str:
        """The last error, or the last line of output."""
        errors = [line for line in self._lines if "rror" in line]
        words = (errors or self._lines)[-1:]
        return " ".join(words)[:300].rstrip(".")
