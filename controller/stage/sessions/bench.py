"""The bench as its own process during the demo."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Self

from controller.core.errors import WorkError
from controller.core.extras import extra_missing
from hal.deadline import Cancelled, in_seconds
from hal.errors import DeviceError
from hal.interfaces import Bench
from hal.registry import BENCH, GROUP, OpenContext, load_drivers

END_S = 10.0
STARTS = 2
TOLD = 400


class BenchProcess:
    """``velatura emulate STAGE`` in the background. A context manager: starts on entering, ends on leaving.

    It has its own process group, so that Ctrl-C reaches only the demo: the emulated lamps must still be there to
    cool. When the demo is killed, the bench ends because its standard input closes.
    """

    def __init__(
        self, stage: Path, *, cancel: threading.Event, tell: Callable[[str], None] = lambda sentence: None
    ) -> None:
        self.addresses: dict[str, str] = {}
        self._stage = stage
        self._cancel = cancel
        self._tell = tell
        self._disturbed = False

    def __enter__(self) -> Self:
        """Return once its devices are ready. Raises the bench's error, WorkError("bench-not-started") and Cancelled."""
        self._tell("Starting the bench (the emulated stage).")
        for left in reversed(range(STARTS)):
            try:
                self._start()
            except DeviceError as error:
                # The bench of a demo that was just killed may still be ending.
                if error.code != "port-in-use" or not left:
                    raise
            else:
                break
        return self

    def _start(self) -> None:
        command = [sys.executable, "-m", "controller", "emulate", str(self._stage), "--json", "--until-input-ends"]
        # A file, not a pipe: nothing reads a pipe while the demo works, and a full one would block the bench.
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed by end()
        self._process = subprocess.Popen(  # noqa: S603 - our own program
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors, text=True,
            start_new_session=True,
        )  # fmt: skip
        watcher = threading.Thread(target=self._end_when_cancelled, daemon=True)
        self._ready = threading.Event()
        watcher.start()
        try:
            self._wait_until_ready()
        except BaseException:
            self.end()
            raise
        finally:
            self._ready.set()
            watcher.join()

    def _end_when_cancelled(self) -> None:
        """While rays are cast the bench may print nothing for a long time; a stop must not wait for its next line."""
        while not self._ready.wait(0.1):
            if self._cancel.is_set():
                self._process.terminate()
                return

    def _wait_until_ready(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            record: dict[str, Any] = json.loads(line) if line.strip() else {}
            if "progress" in record:
                self._tell(f"Casting rays: {record['progress']:.0%}")
            elif "device" in record:
                self.addresses[record["device"]] = record["address"]
            elif "error" in record:
                failure = record["error"]
                raise DeviceError(failure["code"], what=failure["what"], remedy=failure["remedy"])
            elif record.get("ready"):
                return
        if self._cancel.is_set():
            raise Cancelled
        self._process.wait()
        self._errors.seek(0)
        last_words = self._errors.read().decode(errors="replace").split()
        raise WorkError(
            "bench-not-started",
            what=f"The bench ended before its devices were ready: {' '.join(last_words)[-TOLD:]}",
            remedy="Run `velatura emulate` on the stage to see more.",
        )

    def disturb(self, changes: Sequence[Mapping[str, Any]]) -> None:
        """Change the stage as the bench explains it; () undoes all changes. The change holds on return.

        Raises DeviceError for a change that the bench does not know, WorkError("bench-gone").
        """
        if not changes and not self._disturbed:
            return
        bench_of(self._stage).disturb(self._stage, changes)
        self._disturbed = bool(changes)
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.strip() and "bumps" in json.loads(line):
                return
        raise WorkError("bench-gone", what="The bench ended during a change of the stage.", remedy="Start again.")

    def end(self) -> None:
        """Ask the bench to end; kill it if it does not."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
            try:
                self._process.wait(END_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
        self._process.communicate()
        self._errors.close()

    def __exit__(self, *_: object) -> None:
        self.end()


def bench_of(stage: Path, settings: Mapping[str, Any] | None = None) -> Bench:
    """The installed bench for ``stage``; settings as its driver explains them.

    Raises UsageError("extra-missing") or PluginError("driver-unknown") where there is none.
    """
    drivers = load_drivers(entry for entry in entry_points(group=GROUP) if entry.name.endswith(BENCH))
    missing = extra_missing(drivers.missing_for("emulated"))
    if missing is not None:
        raise missing
    driver = drivers.get("bench", "emulated")
    bench: Bench = driver.open(dict(settings or {}), OpenContext(stage=stage), in_seconds(10))
    return bench


def terminated_when_input_ends() -> None:
    """Send SIGTERM when standard input closes: so a child notices that its parent was killed."""

    def watch() -> None:
        while sys.stdin.buffer.read(4096):
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, name="input", daemon=True).start()
