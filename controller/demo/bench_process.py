"""The bench as a process of its own, for as long as the demo lasts."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

from controller.errors import WorkError
from hal.deadline import Cancelled
from hal.errors import DeviceError

END_S = 10.0


class BenchProcess:
    """``velatura emulate STAGE --json`` in the background. A context manager; leaving it ends the bench.

    It is a process group of its own, so that Ctrl-C reaches the demo alone: the emulated lamps must still be there to
    be cooled.
    """

    def __init__(
        self, stage: Path, *, cancel: threading.Event, advance: Callable[[float, str], None] = lambda *_: None
    ) -> None:
        self.addresses: dict[str, str] = {}
        command = [sys.executable, "-m", "controller", "emulate", str(stage), "--json"]
        self._process = subprocess.Popen(  # noqa: S603 - our own program
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            start_new_session=True,
        )  # fmt: skip
        try:
            self._wait_until_ready(cancel, advance)
        except BaseException:
            self.end()
            raise

    def _wait_until_ready(self, cancel: threading.Event, advance: Callable[[float, str], None]) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if cancel.is_set():
                raise Cancelled
            record: dict[str, Any] = json.loads(line) if line.strip() else {}
            if "progress" in record:
                advance(float(record["progress"]), "casting rays")
            elif "device" in record:
                self.addresses[record["device"]] = record["address"]
            elif "error" in record:
                raise DeviceError(record["error"], what=record["what"], remedy=record["remedy"])
            elif record.get("ready"):
                return
        _, told = self._process.communicate()
        raise WorkError(
            "bench-not-started",
            what=f"The bench ended before its devices were there: {' '.join(told.split())[-400:]}",
            remedy="Start `velatura emulate` on the stage by hand to see more.",
        )

    def end(self) -> None:
        """Ask the bench to end, and make it end."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
            try:
                self._process.wait(END_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
        self._process.communicate()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()
