"""Whole solves of targets, as what the object will look like before they become appearances.

A process of its own solves (`computing`): a driver that ends it ends no kiosk, and its memory goes with it. It stays
for the next target, until no one asks, a job of the kiosk needs the memory, or calibration or settings change.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any, Final

from controller.core.errors import UsageError, WorkError
from controller.core.storage import write_atomically
from controller.kiosk.preview.reach import kept_at
from controller.kiosk.values import Computed
from controller.stage.sessions.calibrations import finished_calibration
from controller.stage.sessions.check import Checked

FIGURES: Final = "computed.json"
PICTURE: Final = "computed.jpg"
IDLE_S: Final = 120.0
SILENT_S: Final = 300.0
"""Without a word a driver hangs. What says that it continues may take long: on a processor with other work."""


class ComputedPreviews:
    """Of one stage. Any thread may call; one target is solved at a time."""

    def __init__(self) -> None:
        self._one_at_a_time = threading.Lock()
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._stage = ""
        self._idle: threading.Timer | None = None

    def begin(self, checked: Checked, target: Path) -> None:
        """Let the process read the calibration for ``target`` already, unless it solves, or its result is kept."""
        run = finished_calibration(checked.stage.folder)
        if _kept(*kept_at(checked, run, target)) is None and self._one_at_a_time.acquire(blocking=False):
            try:
                self._ready(_stage_line(checked, run))
                self._rest()
            finally:
                self._one_at_a_time.release()

    def of(self, checked: Checked, target: Path) -> Computed:
        """Solve ``target`` (PNG or EXR); kept until target, calibration or settings change.

        Seconds, more at the first target. Raises UsageError("not-calibrated", "target-unreadable"),
        WorkError("memory-too-small", "preview-ended", "preview-slow"), and what ``choose_engine`` raises.
        """
        run = finished_calibration(checked.stage.folder)
        folder, about = kept_at(checked, run, target)
        with self._one_at_a_time:
            if (known := _kept(folder, about)) is not None:
                return known
            folder.mkdir(parents=True, exist_ok=True)
            found = self._asked(_stage_line(checked, run), {"target": str(target), "picture": str(folder / PICTURE)})
            write_atomically(folder / FIGURES, json.dumps({"of": about, "figures": found}).encode())
            return _read(found, folder)

    def end(self) -> None:
        """End the process, if there is one, and so free all that it holds; a solve that runs is lost."""
        if self._process is None:
            return
        with self._lock:
            process, self._process = self._process, None
            if self._idle is not None:
                self._idle.cancel()
        if process is not None:
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                assert pipe is not None
                with contextlib.suppress(OSError):
                    pipe.close()

    def _asked(self, stage: str, task: dict[str, str]) -> dict[str, Any]:
        process, line = self._ready(stage), "\n"
        assert process.stdin is not None
        with contextlib.suppress(OSError, ValueError):  # it has ended, or was ended: then it says nothing
            process.stdin.write(json.dumps(task) + "\n")
            process.stdin.flush()
        while line.isspace():  # it continues
            try:
                line = _said(process)
            except WorkError:
                self.end()
                raise
        self._rest()
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            failure = answer["error"]
            kind = UsageError if failure["usage"] else WorkError
            raise kind(failure["code"], what=failure["what"], remedy=failure["remedy"])
        return answer

    def _ready(self, stage: str) -> subprocess.Popen[str]:
        """The process that has this stage."""
        if self._stage != stage:
            self.end()
        with self._lock:
            if self._idle is not None:
                self._idle.cancel()
            if self._process is not None:
                return self._process
            process = subprocess.Popen(
                [sys.executable, "-m", "controller.kiosk.preview.computing"], stdin=subprocess.PIPE,
                stdout=subprocess.PIPE, text=True, encoding="utf-8",
            )  # fmt: skip
            self._process, self._stage = process, stage
        assert process.stdin is not None
        with contextlib.suppress(OSError):  # that it has ended is seen when it is asked
            process.stdin.write(stage + "\n")
            process.stdin.flush()
        return process

    def _rest(self) -> None:
        """End the process later, unless it is asked again."""
        with self._lock:
            self._idle = threading.Timer(IDLE_S, self.end)
            self._idle.daemon = True
            self._idle.start()


def _stage_line(checked: Checked, run: Path) -> str:
    solve = checked.stage.tables.solve.model_dump(mode="json")
    return json.dumps({"run": str(run), "names": checked.names, "solve": solve})


def _said(process: subprocess.Popen[str]) -> str:
    """Its next line; its end without one is an error, and its silence ends it."""
    slow = threading.Event()

    def give_up() -> None:
        slow.set()
        process.kill()

    limit = threading.Timer(SILENT_S, give_up)
    limit.daemon = True
    limit.start()
    line = ""
    with contextlib.suppress(OSError, ValueError):
        assert process.stdout is not None
        line = process.stdout.readline()
    limit.cancel()
    if not line:
        raise _slow() if slow.is_set() else _ended()
    return line


def _ended() -> WorkError:
    return WorkError("preview-ended", what="The preview was ended before it was there.",
                     remedy="Look at the picture again when no job of the kiosk runs.")  # fmt: skip


def _slow() -> WorkError:
    return WorkError("preview-slow", what=f"The preview's process said nothing for {SILENT_S:.0f} seconds.",
                     remedy="Compute the appearance: that may take as long as it needs.")  # fmt: skip


def _kept(folder: Path, about: dict[str, Any]) -> Computed | None:
    try:
        content = json.loads((folder / FIGURES).read_text())
        return _read(content["figures"], folder) if content["of"] == about and (folder / PICTURE).is_file() else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _read(figures: dict[str, Any], folder: Path) -> Computed:
    return Computed(**figures, pictures={"result": folder / PICTURE})
