"""How long a whole set-up takes with a camera that needs 3 s a picture: from stable lamps to the first appearance.

A stage of the bench is calibrated and its first appearance solved and published. BENCH_SETS: which sets of photographs,
one after the other (default "few fewest": cold, then recalibrating); BENCH_ROOM: the room of the bench.

The seconds of the clock hold all of it, and are too long on a loaded machine. Pictures times 3 s and the controller's
processor time together are then an estimate: it lacks the waits for the display before each picture, and has the work
of all cores as if one had done it, after the pictures. A part of it is done while the camera works.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from unittest.mock import patch

from controller.config.writer import KeyChange, rewrite_stage
from controller.demo import DEFAULT_ROOM
from controller.run.progress import Phase, Progress, Silent
from controller.stage.services.calibrate import AppearanceOrder, calibrate, make_appearances
from controller.stage.sessions.bench import BenchProcess
from controller.stage.sessions.session import OwnSession
from hal.deadline import Deadline
from hal.values import CapturedFile
from lab.timings import Row, at_most
from lab.timings.tools.stage import FIRST_SEED, prepared_stage
from plugins.emulated.core.truth import read_truth, write_truth
from plugins.ptp.still import PtpCamera

PICTURE_S: Final = 3.0
GOAL_S: Final = 240.0
SETS: Final = "few fewest"
APPEARANCE: Final = "photograph"
STEADY: Final = "Waiting for stable light"
"""The title of the step after which time counts."""
STABLE_S: Final = 90.0
"""Lamps of the bench are stable at once. Those of projectors take minutes, in which a set-up measures what it can."""


def measure(size: str) -> list[Row]:
    """For each set of photographs: pictures, seconds of the clock and of the processor."""
    with prepared_stage(size, FIRST_SEED, room=os.environ.get("BENCH_ROOM", DEFAULT_ROOM)) as stage:
        truth = read_truth(stage)
        write_truth(stage, dataclasses.replace(truth, camera=dataclasses.replace(truth.camera, picture_s=PICTURE_S)))
        rewrite_stage(stage / "stage.toml", [KeyChange(("safety",), "stable_s", STABLE_S)])
        with BenchProcess(stage, cancel=threading.Event()):
            return [row for which in os.environ.get("BENCH_SETS", SETS).split() for row in _of_set(stage, size, which)]


@dataclass(slots=True)
class Pictures:
    """How many the camera took, and the seconds of the clock until their files were there."""

    count: int = 0
    seconds: float = 0.0


class _FromSteady(Silent):
    """Notes the clock, the processor time and the ``pictures`` so far when the lamps have become stable."""

    def __init__(self, pictures: Pictures) -> None:
        self.clock_s = self.processor_s = float("nan")
        self.before = 0
        self._pictures = pictures

    def progress(self, now: Progress) -> None:
        if now.step == STEADY and now.phase is Phase.DONE:
            self.clock_s, self.processor_s = time.monotonic(), time.process_time()
            self.before, self._pictures.seconds = self._pictures.count, 0.0


def _of_set(stage: Path, size: str, which: str) -> Iterator[Row]:
    """Rows of one set-up. Compiled kernels come from the cache, or the time of compiling is in it."""
    cancel = threading.Event()
    with _counted() as pictures:
        reporter = _FromSteady(pictures)
        calibrate(session=OwnSession(stage), reporter=reporter, cancel=cancel, photographs=which, accept_grade=True)
    make_appearances(
        AppearanceOrder(names=[APPEARANCE], accept_grade=True),
        session=OwnSession(stage),
        reporter=Silent(),
        cancel=cancel,
    )
    clock_s, processor_s = time.monotonic() - reporter.clock_s, time.process_time() - reporter.processor_s
    goal = GOAL_S if size == "paper" else None
    count = pictures.count - reporter.before
    least_s = PICTURE_S * count
    before = f"and {reporter.before} before lamps were stable"
    yield at_most(f"{which}: pictures taken", count, None, unit="", how=f"trial exposures included; {before}")
    yield at_most(f"{which}: their time at 3 s", least_s, None, unit="s", how=f"measured {pictures.seconds:.0f} s")
    yield at_most(f"{which}: processor time", processor_s, None, unit="s", how="the controller's, over all cores")
    yield at_most(f"{which}: pictures and processor", least_s + processor_s, None, unit="s", how="one after another")
    yield at_most(f"{which}: seconds of the clock", clock_s, goal, unit="s", how="from stable lamps to the appearance")


@contextlib.contextmanager
def _counted() -> Iterator[Pictures]:
    """Count what the camera's driver takes."""
    found, take = Pictures(), PtpCamera.capture

    def counted(camera: PtpCamera, destination: Path, *, deadline: Deadline) -> list[CapturedFile]:
        began_s = time.monotonic()
        files = take(camera, destination, deadline=deadline)
        found.count += 1
        found.seconds += time.monotonic() - began_s
        return files

    with patch.object(PtpCamera, "capture", counted):
        yield found
