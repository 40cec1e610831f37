"""How many photographs a calibration takes with each set of them, and what it loses: random stages, real devices.

Red and blue of every projector lie 0.3 px beside green. Each stage is calibrated three times: with all photographs
(`full`), with `few`, and with `fewest` from the map of the calibration before, where nothing moved. BENCH_STAGES says
how many stages (default 5, seeds 701 to 705), BENCH_SEEDS which seeds instead, and BENCH_MISCONVERGED_PX how far the
colours lie apart.

The grade compares a prediction with one photograph, so the noise of that photograph is in it. Two figures part them:
the same prediction against a picture without noise, and the photograph against that picture.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from controller.run.journal import Journal
from controller.run.progress import Silent
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.grade import worst_of
from controller.stage.services.calibrate import calibrate
from controller.stage.sessions.bench import BenchProcess
from controller.stage.sessions.check import check_stage
from controller.stage.sessions.session import OwnSession
from hal.errors import CodedError
from lab.emulated.bumps import Bump, write_bumps
from lab.timings import Row, at_least, at_most
from lab.timings.tools.judge import map_errors, noise_free, random_errors
from lab.timings.tools.stage import FIRST_SEED, over, prepared_stage
from lab.timings.tools.truth import Truth

MISCONVERGED_PX: Final = 0.3
SETS: Final = ("full", "few", "fewest")
MOST: Final = {"few": 20.0, "fewest": 15.0}
GRADE: Final = 1.3
IN_FOCUS: Final = 0.02
UNITS: Final = {
    "photographs a projector": "",
    "grade": "% rms",
    "grade without noise": "% rms",
    "noise of that photograph": "% rms",
    "off by more than 1 px": "%",
}
ROOMS: Final = ("dark", "room")


def measure(size: str) -> list[Row]:
    """For each room and set: photographs a projector, grade, and positions on the projector's image."""
    count = int(os.environ.get("BENCH_STAGES", "5"))
    named = os.environ.get("BENCH_SEEDS", "").split()
    seeds = [int(seed) for seed in named] or list(range(FIRST_SEED, FIRST_SEED + count))
    rooms = os.environ.get("BENCH_ROOMS", ",".join(ROOMS)).split(",")
    return [row for room in rooms for row in _of_room(size, room, seeds)]


def _of_room(size: str, room: str, seeds: Sequence[int]) -> Iterator[Row]:
    found: dict[tuple[str, str], list[float]] = {}
    failed: list[str] = []
    stages = len(seeds)
    for seed in seeds:
        try:
            for which, figure, values in _of_stage(size, seed, room):
                found.setdefault((which, figure), []).extend(values)
        except CodedError as error:
            failed.append(f"seed {seed}: {error.what}")
    done = stages - len(failed)
    yield at_least(f"{room}: stages calibrated", done, stages, unit=f"of {stages}", how="; ".join(failed))
    for (which, figure), values in found.items():
        goal = {"photographs a projector": MOST.get(which), "grade": GRADE, "in focus": IN_FOCUS}.get(figure)
        unit = UNITS.get(figure, "px rms")
        finite = [value for value in values if np.isfinite(value)]
        yield at_most(f"{room}, {which}: {figure}", max(finite), goal, unit=unit, how=over(finite))


def _of_stage(size: str, seed: int, room: str) -> Iterator[tuple[str, str, Sequence[float]]]:
    """Set, figure and values, as they are measured."""
    with prepared_stage(size, seed, room=room) as stage:
        names = check_stage(stage).names
        apart_px = float(os.environ.get("BENCH_MISCONVERGED_PX", MISCONVERGED_PX))
        write_bumps(stage, *[Bump("projector", name, misconverged_px=apart_px) for name in names])
        with BenchProcess(stage, cancel=threading.Event()):
            for which in SETS:
                for figure, values in _calibrated(stage, which).items():
                    yield which, figure, values


def _calibrated(stage: Path, which: str) -> dict[str, Sequence[float]]:
    cancel = threading.Event()
    done = calibrate(
        session=OwnSession(stage), reporter=Silent(), cancel=cancel, photographs=which, accept_grade=True
    )  # fmt: skip
    run, names, truth = Path(str(done["run"])), check_stage(stage).names, Truth(stage, bumps=True)
    with Journal(run) as journal:
        taken = journal.shot_count() / len(names)
    worst = worst_of(run)
    assert worst is not None
    calibrated = Calibrated(run, names)
    random = [random_errors(calibrated, n, noise_free(calibrated, truth, n)) for n in range(len(names))]
    places = [map_errors(truth, n, run, without_offset=True) for n in range(len(names))]
    return {
        "photographs a projector": [taken],
        "grade": [worst[1]],
        "grade without noise": [100 * max(one["random"] for one in random)],
        "noise of that photograph": [100 * max(one["random noise"] for one in random)],
        "in focus": [place["map in focus px"] for place in places],
        "all": [place["map px"] for place in places],
        "off by more than 1 px": [100 * place["map gross"] for place in places],
    }
