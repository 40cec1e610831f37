"""The command line and the bench as processes, as a person starts them, and what they leave on the stage."""

from __future__ import annotations

import contextlib
import json
import os
import re
import resource
import signal
import sqlite3
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from hal.deadline import in_seconds
from hal.registry import OpenContext, load_drivers
from hal.values import Power

REPOSITORY = Path(__file__).parents[2]
LONGEST_S = 800.0
"""Far beyond what anything here takes, for machines that do much else meanwhile."""
Record = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a command ended, and every JSON line that it printed. ``error`` is empty for one that said none."""

    code: int
    records: list[Record]
    stderr: str
    seconds: float

    @property
    def error(self) -> Record:
        return next((record["error"] for record in self.records if "error" in record), {})

    @property
    def result(self) -> Record:
        return dict(next(record["result"] for record in self.records if "result" in record))


@contextlib.contextmanager
def listening_to_ctrl_c() -> Iterator[None]:
    """A shell's background job ignores SIGINT, and so would its children; those begun inside do not."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def share_of_the_cores() -> dict[str, str]:
    """For a program beside other workers' tests: as many kernel threads as there are cores for it."""
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    return {"NUMBA_NUM_THREADS": str(max(1, (os.cpu_count() or 1) // workers))} if workers > 1 else {}


class Command:
    """``velatura WORDS --json`` in a process of its own, its lines read as they come; ``more``: of its environment."""

    def __init__(self, *words: str | Path, more: Mapping[str, str] | None = None) -> None:
        self.records: list[Record] = []
        self._seen = threading.Condition()
        self._ended = False
        self._began_s = time.monotonic()
        with listening_to_ctrl_c():
            self.process = subprocess.Popen(
                [sys.executable, "-m", "controller", *map(str, words), "--json"],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                cwd=REPOSITORY,
                env=os.environ | {"PYTHONFAULTHANDLER": "1"} | share_of_the_cores() | dict(more or {}),
            )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        try:
            for line in self.process.stdout:
                with self._seen:
                    self.records.append({"at_s": time.monotonic() - self._began_s, **json.loads(line)})
                    self._seen.notify_all()
        finally:
            with self._seen:
                self._ended = True
                self._seen.notify_all()

    def wait_for(self, step: str, *, fraction: float = 0.0) -> None:
        """Until a step whose title begins with ``step`` has come that far."""

        def reached(record: Record) -> bool:
            progress = record.get("progress", {"step": "", "step_fraction": 0.0})
            return bool(progress["step"].startswith(step) and progress["step_fraction"] >= fraction)

        self._wait(reached, step)

    def wait_for_key(self, key: str) -> Record:
        """The first record that has it."""
        self._wait(lambda record: key in record, key)
        return next(record for record in self.records if key in record)

    def wait_for_message(self, text: str) -> None:
        """Until it has said a sentence that begins so."""
        self._wait(lambda record: str(record.get("message", {}).get("text", "")).startswith(text), text)

    def _wait(self, reached: Callable[[Record], bool], what: str) -> None:
        with self._seen:
            self._seen.wait_for(lambda: any(map(reached, self.records)) or self._ended, LONGEST_S)
        assert any(map(reached, self.records)), f"{what} was not reached: {self.records[-1:]}"

    def limit_files_to(self, size: int) -> None:
        """The process can make no larger file from now on, as on a disk that is nearly full; -1: no limit."""
        _, hard = resource.prlimit(self.process.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(self.process.pid, resource.RLIMIT_FSIZE, (size, hard))

    def interrupt(self) -> Outcome:
        """Ctrl-C, and its result."""
        self.process.send_signal(signal.SIGINT)
        return self.outcome(timeout_s=180)

    def kill(self) -> None:
        self.process.kill()
        self.outcome(timeout_s=60)

    def outcome(self, *, timeout_s: float = LONGEST_S) -> Outcome:
        """Wait for the end."""
        try:
            code = self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"hung for {timeout_s:.0f} s after {self.records[-1:]}:\n{self._hung()}") from None
        ended_s = time.monotonic() - self._began_s
        self._reader.join(10)
        assert self.process.stderr is not None
        assert self.process.stdout is not None
        stderr = self.process.stderr.read()
        self.process.stderr.close()
        self.process.stdout.close()
        return Outcome(code, self.records, stderr, ended_s)

    def _hung(self) -> str:
        """Where every thread hangs (the fault handler prints it), and how the system sees the process; it is ended."""
        seen = Path(f"/proc/{self.process.pid}/status").read_text().split("\n")[2]
        self.process.send_signal(signal.SIGABRT)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(20)
        self.process.kill()
        assert self.process.stderr is not None
        return f"{seen}\n{self.process.stderr.read()}"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            self.outcome(timeout_s=180)


def velatura(*words: str | Path, timeout_s: float = LONGEST_S) -> Outcome:
    """Run a command to its end."""
    return Command(*words).outcome(timeout_s=timeout_s)


class Bench:
    """``velatura emulate STAGE`` with fault knobs; ready once made."""

    def __init__(self, stage: Path) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-X", "faulthandler", "-m", "tests.end_to_end.bench_with_knobs", str(stage)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=REPOSITORY,
            env=os.environ | share_of_the_cores(),
            start_new_session=True,
        )
        self._until("ready")

    def _until(self, key: str) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if key in json.loads(line):
                return
        raise AssertionError(f"the bench ended with {self._process.wait()}")

    def turn(self, knob: str) -> None:
        """E.g. "unplug left"; on return it is."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{knob}\n")
        self._process.stdin.flush()
        self._until("knob")

    def kill(self) -> None:
        self._process.kill()
        self.end()

    def end(self) -> None:
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
        self._process.communicate(timeout=20)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()


def wrong_code(outcome: Outcome, code: int = 2) -> str:
    """The code of an error, which is reported in two sentences and nothing else."""
    assert outcome.code == code, outcome
    assert outcome.stderr == ""
    assert outcome.error.keys() == {"code", "what", "remedy"}
    for sentence in (outcome.error["what"], outcome.error["remedy"]):
        assert re.search(r"[.?]$", sentence), sentence
        assert "Traceback" not in sentence
    return str(outcome.error["code"])


@contextlib.contextmanager
def hidden(*files: Path) -> Iterator[None]:
    """The files are elsewhere inside, and back afterwards."""
    away = [file.with_name(f"{file.name}.away") for file in files]
    for file, place in zip(files, away, strict=True):
        file.rename(place)
    try:
        yield
    finally:
        for file, place in zip(files, away, strict=True):
            place.rename(file)


def powers(stage: Path, names: Sequence[str] = ("left", "right", "above")) -> dict[str, Power]:
    """What the projectors themselves answer, asked through their driver."""
    tables = tomllib.loads((stage / "stage.toml").read_text())["projectors"]
    driver = load_drivers().get("projector", "serial")
    found = {}
    for table in (table for table in tables if table["name"] in names):
        settings = {"profile": table["profile"], "port": table["port"]}
        projector = driver.open(settings, OpenContext(stage=stage), in_seconds(10))
        try:
            found[table["name"]] = projector.status(deadline=in_seconds(10)).power
        finally:
            projector.close()
    return found


def lamps(stage: Path) -> dict[str, bool]:
    """Which lamps count as lit; empty before the first strike."""
    file = stage / "lamps.json"
    if not file.exists():
        return {}
    return {name: row["lit"] for name, row in json.loads(file.read_text()).items()}


def strikes(stage: Path) -> dict[str, int]:
    """How often each lamp was struck."""
    file = stage / "lamps.json"
    return {name: row["strikes"] for name, row in json.loads(file.read_text()).items()} if file.exists() else {}


def run_of(stage: Path) -> Path:
    """The one calibration, or demo, of the stage."""
    (run,) = (path for path in (stage / "runs").iterdir() if not path.name.endswith(("-play", "-refine")))
    return run


def asked(run: Path, statement: str) -> list[tuple[Any, ...]]:
    """Rows of a run's journal, read without Velatura."""
    with contextlib.closing(sqlite3.connect(f"file:{run / 'journal.sqlite'}?mode=ro", uri=True)) as database:
        return list(database.execute(statement))


def shots(run: Path) -> dict[str, float]:
    """When each photograph was taken, by its file."""
    return dict(asked(run, "SELECT path, taken_at_s FROM shots"))


def processes_on(stage: Path) -> list[str]:
    """Command lines of processes that still work on a stage."""
    found = []
    for folder in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            words = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            if folder.name.isdigit() and str(stage) in words and int(folder.name) != os.getpid():
                found.append(words)
    return found
