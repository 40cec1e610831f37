"""Random emulated stages, calibrated through real devices in processes of their own."""

from __future__ import annotations

import statistics
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from controller.demo import DEFAULT_ROOM, DemoStage, prepare
from controller.run.journal import Journal
from controller.run.progress import Silent
from controller.run.step_id import StepId
from controller.stage.services.calibrate import calibrate
from controller.stage.sessions.bench import BenchProcess
from controller.stage.sessions.check import check_stage
from controller.stage.sessions.session import OwnSession

FIRST_SEED = 701


@dataclass(frozen=True, slots=True)
class CalibratedStage:
    """A stage and the run folder of its calibration; ``seconds`` each step took, ``shots`` photographs kept."""

    folder: Path
    run: Path
    names: tuple[str, ...]
    seconds: dict[StepId, float]
    shots: int
    wall_s: float


@contextmanager
def prepared_stage(size: str, seed: int, *, room: str = DEFAULT_ROOM) -> Iterator[Path]:
    """A stage folder of a random truth, removed afterwards."""
    with tempfile.TemporaryDirectory(prefix="velatura-bench-") as folder:
        yield prepare(Path(folder), DemoStage(size, seed, room=room))


@contextmanager
def calibrated_stage(size: str, seed: int, *, room: str = DEFAULT_ROOM) -> Iterator[CalibratedStage]:
    """A stage calibrated as the command line would, its bench a process of its own; removed afterwards."""
    with prepared_stage(size, seed, room=room) as stage:
        cancel = threading.Event()
        began = time.perf_counter()
        with BenchProcess(stage, cancel=cancel):
            done = calibrate(session=OwnSession(stage), reporter=Silent(), cancel=cancel)
        wall_s = time.perf_counter() - began
        run = Path(str(done["run"]))
        with Journal(run) as journal:
            seconds, shots = journal.steps(), journal.shot_count()
        yield CalibratedStage(stage, run, check_stage(stage).names, seconds, shots, wall_s)


def over(values: Sequence[float], digits: int = 3) -> str:
    """Minimum, median and maximum in words."""
    low, middle, high = min(values), statistics.median(values), max(values)
    return f"min {low:.{digits}g}, median {middle:.{digits}g}, max {high:.{digits}g} over {len(values)}"
