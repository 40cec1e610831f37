"""All that has a goal of a full appearance: its solves, a refinement's second one, growth, memory, the panel's result.

``BENCH_PREVIEW_RUN=FOLDER`` is a calibrated run of which the panel's result is calculated, not a synthetic one.
"""

from __future__ import annotations

import contextlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from controller.config.models import SolveTable
from controller.core.colour import linear_to_srgb
from controller.core.storage import runtime_folder
from controller.optics.calibrate.values import Calibration
from controller.optics.solve.bounded.equations import APPEARANCE_TOLERANCE, SolveSettings
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.reach.drive_levels import DriveLevels
from controller.optics.solve.reach.feasibility import exposures, target_radiance
from controller.optics.transport import LightTransport, build_transport
from controller.stage.artefacts.geometry import projectors_of
from controller.stage.sessions.bench import BenchProcess
from lab.timings import Row, at_most
from lab.timings.devices.serve import NAME, RATE_HZ, install_grey, service, wait_for
from lab.timings.solving import solve
from lab.timings.solving.memory import solved_apart
from lab.timings.tools.stage import FIRST_SEED, prepared_stage
from lab.timings.tools.synthetic import CAMERA, synthetic_calibration, synthetic_target
from lab.timings.tools.traced import traced
from tests.controller.play.wire import Wire

MODEL_ERROR: Final = 0.03
"""Of the light, smooth: what a photograph of a first result corrects."""
GROWN: Final = {"small": ("small",), "medium": ("small", "medium"), "paper": ("small", "paper", "uhd")}
UPLOADS: Final = 4


def measure(size: str) -> list[Row]:
    """Every goal of a full appearance at one size."""
    calibration = synthetic_calibration(size)
    transport = build_transport(calibration)
    paper = size == "paper"
    rows = solve.of_stage(transport, calibration, paper=paper) + _corrected(transport, calibration, paper=paper)
    del calibration, transport
    return [*rows, *_grown(size), *_uploaded(size)]


def _corrected(transport: LightTransport, calibration: Calibration, *, paper: bool) -> list[Row]:
    """The second solve of a refinement: from the first one's frames, to a target that has changed by a few per cent."""
    black, reflectance = calibration.black, synthetic_target(transport.camera_shape)
    exposure, _ = exposures(DriveLevels.of_transport(transport), reflectance, black)
    target = target_radiance(reflectance, black, exposure)
    first = solve_bounded(transport, target, black, SolveSettings(tolerance=APPEARANCE_TOLERANCE))
    y, x = (np.linspace(0, 1, size, dtype=np.float32) for size in transport.camera_shape)
    wave = MODEL_ERROR * np.sin(9 * y)[:, None] * np.cos(7 * x)
    later = np.asarray(target * (1 + wave[..., None]), np.float32)
    best = traced(transport, later, black, solve.LONG_SWEEPS, start=first.frames, most_s=solve.MOST_S).best
    enough = best * (1 + solve.NEAR_ENOUGH)
    number, at = traced(transport, later, black, 60, start=first.frames, enough=enough).reached(enough)
    how = f"{number} sweeps, set-up included; {at.processor_s:.3g} s of processor time"
    return [at_most("second solve of a refinement to 0.01 of the best", at.seconds, 0.7 if paper else None, unit="s",
                    how=how)]  # fmt: skip


def _grown(size: str) -> list[Row]:
    """Time of a base solve a sweep and camera sample, and the largest memory, each size in a process of its own."""
    rows, each = [], []
    for name in GROWN[size]:
        found = solved_apart(name)
        seconds = next(step[3] for step in found["steps"] if step[0] == "solve")
        each.append(1e9 * seconds / found["sweeps"][0] / found["camera"])
        rows.append(at_most(f"a sweep, {name}", each[-1], None, unit="ns a camera sample",
                            how=f"{seconds:.2f} s with set-up, {found['sweeps'][0]} sweeps"))  # fmt: skip
        goal = {"paper": 2.68, "uhd": 6.15}.get(name)
        arrays = max(step[1] for step in found["steps"]) / 1e9
        rows.append(at_most(f"peak memory, {name}", found["anonymous"] / 1e9, goal, unit="GB",
                            how=f"without mapped files; arrays {arrays:.2f} GB"))  # fmt: skip
    rows.append(at_most("time of a camera sample, most by least", max(each) / min(each), 1.3, unit="x", how=""))
    return rows


def _uploaded(size: str) -> list[Row]:
    """From a target to the panel's result by the panel's own process, while a kiosk plays pictures at 30 Hz."""
    with contextlib.ExitStack() as held:
        given = os.environ.get("BENCH_PREVIEW_RUN")
        if given:
            run, names = Path(given), projectors_of(Path(given))
        else:
            run = Path(held.enter_context(tempfile.TemporaryDirectory(prefix="velatura-full-")))
            made = [sys.executable, "-m", "lab.timings.tools.synthetic", str(run), size]
            names = subprocess.run(made, check=True, capture_output=True, text=True).stdout.split()
        target = run / "uploaded.png"
        shown = np.rint(255 * linear_to_srgb(synthetic_target(CAMERA[size]))).astype(np.uint8)
        cv2.imwrite(str(target), shown[..., ::-1])
        stage = held.enter_context(prepared_stage("small", FIRST_SEED))
        install_grey(stage)
        held.enter_context(BenchProcess(stage, cancel=threading.Event()))
        held.enter_context(service(stage))
        wait_for(stage, "playing")
        wire = held.enter_context(Wire(runtime_folder(stage) / "player.sock"))
        wire.ask("sequence", items=[[NAME, 1 / RATE_HZ]], rate_hz=RATE_HZ)
        cold, *warm = _answers(run, names, target)
        late = wire.ask("status")["late"]
    goal = 1.5 if size == "medium" else None
    return [
        at_most("upload to result, calibration read before", statistics.median(warm), goal, unit="s",
                how=f"median of {len(warm)}, most {max(warm):.2f} s; the first, which reads it, {cold:.2f} s"),
        at_most("swaps late meanwhile", float(late), 0.0, unit="", how=f"at {RATE_HZ:g} Hz, more than a tick"),
    ]  # fmt: skip


def _answers(run: Path, names: list[str], target: Path) -> Iterator[float]:
    """Seconds of each answer of a preview's process."""
    stage = {"run": str(run), "names": names, "solve": SolveTable().model_dump(mode="json")}
    task = {"target": str(target), "picture": str(run / "result.jpg")}
    command = [sys.executable, "-m", "controller.kiosk.preview.computing"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        print(json.dumps(stage), file=process.stdin)
        for _ in range(UPLOADS):
            began_s = time.perf_counter()
            print(json.dumps(task), file=process.stdin, flush=True)
            line = next(line for line in process.stdout if not line.isspace())
            answer: dict[str, Any] = json.loads(line)
            assert "error" not in answer, answer
            yield time.perf_counter() - began_s
        process.stdin.close()
