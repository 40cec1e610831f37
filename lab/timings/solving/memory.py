"""Memory of a calibration, of the solve of its base image and of an appearance, by step; each size in its own process.

The calibration is written as a run writes it and read as a run reads it. ``BENCH_RUN=FOLDER`` measures a run that
exists instead. ``python -m lab.timings.solving.memory FOLDER NAME...`` is one process; it prints one line of JSON.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from controller.core.arrays import FloatImage
from controller.optics.calibrate.values import Calibration
from controller.optics.solve.appearance import Base, StageLight, base_image, prepare_base
from controller.optics.solve.bounded.engine import SolveContext
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.memory_need import solve_peak_bytes, stage_size
from controller.optics.solve.request import SolveOptions, solve_appearance
from controller.optics.solve.targets.values import Target
from controller.optics.transport import LightTransport, build_transport
from controller.stage.artefacts.calibration import read_calibration
from controller.stage.artefacts.geometry import projectors_of
from lab.timings import Row, at_most
from lab.timings.tools.synthetic import PROJECTOR, write_synthetic_run

SIZES: Final = tuple(PROJECTOR)
GOAL: Final = 240.0
OPTIONS: Final = SolveOptions(share=0.9, smoothness=1e-3, adapt=1.0)
WATCHED_EVERY_S: Final = 0.002
_PROCESS: Final = re.compile(r"^(RssAnon|RssFile|RssShmem):\s+(\d+)", re.MULTILINE)


def measure(size: str) -> list[Row]:
    """Bytes a projector pixel at the peak of each step, and what the run said that it would need."""
    found = solved_apart(size)
    pixels, rows = found["pixels"], []
    for step, peak, kept, seconds in found["steps"]:
        how = f"{peak / 1e9:.2f} GB; {kept / pixels:.0f} kept after it; {seconds:.1f} s"
        rows.append(at_most(f"{step}, peak", peak / pixels, None, unit="bytes a projector pixel", how=how))
    peak = max(step[1] for step in found["steps"])
    how = f"{peak / 1e9:.2f} GB of {found['projectors']} projectors, {pixels} pixels, camera of {found['camera']}"
    rows.append(at_most("arrays, largest", peak / pixels, GOAL, unit="bytes a projector pixel", how=how))
    resident = found["anonymous"]
    how = (
        f"{resident / 1e9:.2f} GB with program and kernels; {found['mapped'] / 1e9:.2f} GB of files resident beside it"
    )
    rows.append(
        at_most("process, without mapped files", resident / pixels, GOAL, unit="bytes a projector pixel", how=how)
    )
    told = found["told"]
    rows.append(at_most("told before it begins, by the process", told / resident, None, unit="x",
                        how=f"{told / 1e9:.2f} GB"))  # fmt: skip
    return rows


def solved_apart(size: str) -> dict[str, Any]:
    """What a process of its own found, as ``one_run``, on a stage of that size."""
    if run := os.environ.get("BENCH_RUN"):
        return _apart(Path(run), projectors_of(Path(run)))
    with tempfile.TemporaryDirectory(prefix="velatura-memory-", dir=os.environ.get("BENCH_FOLDER")) as folder:
        # made by a process of its own: formulas need more memory than a solve
        made = [sys.executable, "-m", "lab.timings.tools.synthetic", folder, size]
        return _apart(Path(folder), subprocess.run(made, check=True, capture_output=True, text=True).stdout.split())


def _apart(run: Path, names: list[str]) -> dict[str, Any]:
    command = [sys.executable, "-m", "lab.timings.solving.memory", str(run), *names]
    ran = subprocess.run(command, check=True, capture_output=True, text=True)
    found: dict[str, Any] = json.loads(ran.stdout.splitlines()[-1])
    return found


class _Watch:
    """The largest memory of this process that is not a mapped file, and the largest that is."""

    def __init__(self) -> None:
        self.anonymous = self.mapped = 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()

    def _look(self) -> None:
        while not self._ended.wait(WATCHED_EVERY_S):
            found = dict(_PROCESS.findall(Path("/proc/self/status").read_text()))
            self.anonymous = max(self.anonymous, 1024 * int(found["RssAnon"]))
            self.mapped = max(self.mapped, 1024 * (int(found["RssFile"]) + int(found["RssShmem"])))

    def end(self) -> None:
        self._ended.set()
        self._thread.join()


def one_run(run: Path, names: list[str]) -> dict[str, Any]:
    """Read, build, solve and prepare; the peak of arrays in each step, in bytes."""
    _warm()
    steps: list[tuple[str, int, int, float]] = []
    tracemalloc.start()
    watch = _Watch()

    def step(name: str, work: Callable[[], Any]) -> Any:
        tracemalloc.reset_peak()
        began = time.perf_counter()
        made = work()
        seconds = time.perf_counter() - began
        kept, peak = tracemalloc.get_traced_memory()
        steps.append((name, peak, kept, seconds))
        return made

    calibration = step("calibration read", lambda: read_calibration(run, names))
    told = solve_peak_bytes(stage_size(calibration))
    transport = step("transport", lambda: build_transport(calibration))
    black = calibration.black
    base = _base(step, calibration, transport).in_files(run)
    made = step(
        "appearance",
        lambda: solve_appearance(
            StageLight(transport, black), _target(black), OPTIONS, context=SolveContext(folder=run)
        ),
    )
    watch.end()
    return {
        "pixels": transport.pixels,
        "projectors": len(transport.sizes),
        "camera": transport.lit[0].size,
        "steps": steps,
        "anonymous": watch.anonymous,
        "mapped": watch.mapped,
        "told": told,
        "sweeps": [base.solution.iterations, made.figures["iterations"]],
    }


def _base(step: Callable[[str, Callable[[], Any]], Any], calibration: Calibration, transport: LightTransport) -> Base:
    image = step("base image", lambda: base_image(calibration, "white"))
    solution = step("solve", lambda: solve_bounded(transport, image, calibration.black))
    base: Base = step("ready to scale", lambda: prepare_base(transport, image, calibration.black, solution))
    return base


def _target(black: FloatImage) -> Target:
    """A picture of large dark and bright squares and fine colours, part of which is out of reach."""
    rows, columns = black.shape[:2]
    y, x = np.ogrid[0:rows, 0:columns]
    bright = (x // (columns // 9) + y // (rows // 6)) % 2 > 0
    fine = np.random.default_rng(1).random((rows, columns, 3), np.float32)
    fine *= np.where(bright, np.float32(0.9), np.float32(0.05))[..., None]
    return Target(fine, np.ones((rows, columns), np.bool_))


def _warm() -> None:
    """Load the compiled code, so that no compiler is in the figures."""
    with tempfile.TemporaryDirectory() as folder:
        names = write_synthetic_run(Path(folder), projector=(34, 44), camera=(82, 122))
        calibration = read_calibration(Path(folder), names)
        transport, image = build_transport(calibration), base_image(calibration, "white")
        prepare_base(transport, image, calibration.black, solve_bounded(transport, image, calibration.black))
        solve_appearance(StageLight(transport, calibration.black), _target(calibration.black), OPTIONS)
        np.percentile(image, 50)


if __name__ == "__main__":
    print(json.dumps(one_run(Path(sys.argv[1]), sys.argv[2:])))
