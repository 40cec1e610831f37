"""A real scheduler and real workers, each a process of its own, on this machine's loopback."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

START_S = 60.0


class Machines:
    """A scheduler, and the workers that were started for it."""

    def __init__(self, folder: Path, arguments: tuple[str, ...] = (), environment: Mapping[str, str] | None = None):
        self._environment = {**os.environ, "NUMBA_NUM_THREADS": "1", **(environment or {})}
        self._arguments = arguments
        self.workers: list[subprocess.Popen[bytes]] = []
        file = folder / "scheduler.json"
        self._scheduler = self._start("scheduler", "--port", "0", "--scheduler-file", str(file), *arguments)
        ends_s = time.monotonic() + START_S
        while not file.exists():
            assert self._scheduler.poll() is None, "the scheduler ended"
            assert time.monotonic() < ends_s
            time.sleep(0.05)
        time.sleep(0.1)
        self.address: str = json.loads(file.read_text())["address"]

    def _start(self, *command: str) -> subprocess.Popen[bytes]:
        line = [sys.executable, "-m", "dask", *command, "--host", "127.0.0.1", "--no-dashboard"]
        return subprocess.Popen(line, env=self._environment, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)

    def start_worker(self) -> subprocess.Popen[bytes]:
        worker = self._start("worker", self.address, "--nthreads", "1", "--no-nanny", *self._arguments)
        self.workers.append(worker)
        return worker

    def close(self) -> None:
        for process in (*self.workers, self._scheduler):
            process.kill()
            process.wait()


@contextlib.contextmanager
def machines(folder: Path, workers: int, **settings: object) -> Iterator[Machines]:
    made = Machines(folder, **settings)  # type: ignore[arg-type]
    try:
        for _ in range(workers):
            made.start_worker()
        yield made
    finally:
        made.close()
