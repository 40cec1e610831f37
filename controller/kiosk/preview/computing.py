"""Solves targets for previews: python -m controller.kiosk.preview.computing. Its parent is ``computed``.

The first line of its input is a ``Stage``, each further one a ``Task``, as JSON. To each task it answers with a line:
the values of a ``Computed`` without its pictures, or an error's code and sentences; before that with empty lines, as
long as it solves. It ends when its input ends, also in the middle of a solve.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TextIO

import cv2
import numpy as np

from controller.config.models import SolveTable
from controller.core.arrays import FloatImage
from controller.core.errors import SEND_DIAGNOSTICS, UsageError, VelaturaError
from controller.kiosk.preview.reach import write_picture
from controller.kiosk.store.targets import fitted, png_size
from controller.optics.solve.bounded.engine import SolveContext
from controller.optics.solve.engines import choose_engine
from controller.optics.solve.memory_need import check_memory, solve_peak_bytes, stage_size
from controller.optics.solve.request import AppearanceResult, solve_appearance
from controller.optics.solve.result.metrics import by_pixels, visible_object
from controller.optics.solve.targets.files import load_target
from controller.optics.solve.targets.values import Target
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.report.pictures import to_screen
from controller.stage.steps.appearance.solving import options_of
from hal.runtime.compute import free_bytes

NICENESS: Final = 5
"""What plays, and what is being calibrated, goes before previews."""
JUDGED_PX: Final = 960
"""About the longer side of what is judged and drawn: every so-many-th pixel of the camera."""


@dataclass(frozen=True, slots=True)
class Stage:
    """A finished calibration ``run`` of projectors ``names``, and [solve] of stage.toml."""

    run: str
    names: tuple[str, ...]
    solve: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Task:
    """The file ``target`` (PNG or EXR), and that for the ``picture`` of the result (JPEG)."""

    target: str
    picture: str


class Solver:
    """A calibration, read and kept. Raises what ``choose_engine`` and ``check_memory`` raise.

    Also where appearances are solved by regions, previews are not: both come near the same optimum, regions in minutes.
    """

    def __init__(self, stage: Stage) -> None:
        table = SolveTable.model_validate(stage.solve)
        self._engine = choose_engine(table.device, lambda note: None)
        self._options = options_of(table)
        self._calibrated = Calibrated(Path(stage.run), stage.names, self._engine)
        check_memory(solve_peak_bytes(stage_size(self._calibrated.calibration)), free_bytes())
        self._light = self._calibrated.light

    def answer(self, task: Task, progress: Callable[[int, float], None]) -> dict[str, Any]:
        """Solve a target and draw the result. Raises as ``solve_appearance`` and ``load_target``."""
        began_s = time.perf_counter()
        calibrated = self._calibrated
        calibration = calibrated.calibration
        made = solve_appearance(
            self._light,
            self._target(Path(task.target)),
            self._options,
            SolveContext(calibrated.engine, progress, folder=calibrated.folder),
        )
        seen = calibrated.predicted_light(made.frames) + calibration.black
        return {
            **self._judged(made, seen, Path(task.picture)),
            "seconds": time.perf_counter() - began_s,
            "device": self._engine.worked,
        }

    def _target(self, file: Path) -> Target:
        rows, columns = self._calibrated.transport.camera_shape
        picture = file.read_bytes()
        if file.suffix.lower() == ".exr" or png_size(picture) == (columns, rows):
            return load_target(file, (columns, rows))
        with tempfile.TemporaryDirectory() as scratch:
            # As the computation does with a picture of another size.
            whole = Path(scratch) / "target.png"
            whole.write_bytes(fitted(picture, (columns, rows)))
            return load_target(whole, (columns, rows))

    def _judged(self, made: AppearanceResult, seen: FloatImage, file: Path) -> dict[str, Any]:
        """Colour differences between what was asked for and what will be seen, at some pixels; draws the latter."""
        calibration, transport = self._calibrated.calibration, self._calibrated.transport
        step = max(1, round(max(transport.camera_shape) / JUDGED_PX))
        at = np.s_[::step, ::step]
        light, lit = np.ascontiguousarray(seen[at]), np.ascontiguousarray(transport.object_mask[at])
        exposure = float(made.figures["exposure"] or 0)
        sets = by_pixels(
            light, np.ascontiguousarray(made.asked[at]), calibration.camera_to_xyz, exposure,
            reachable=made.asked_reachable[at], valid=made.valid[at], lit=lit,
        )  # fmt: skip
        size_px = lit.shape[1], lit.shape[0]
        smooth: FloatImage = np.asarray(cv2.resize(seen, size_px, interpolation=cv2.INTER_AREA), np.float32)
        write_picture(file, to_screen(smooth, calibration.camera_to_xyz, white=exposure), visible_object(lit))
        whole, reached = sets["visible"], sets["in_reach"]
        return {
            "delta_e": whole.delta_e00_median,
            "delta_e_p95": whole.delta_e00_p95,
            "in_reach": reached.delta_e00_median,
            "in_reach_share": 1 - reached.left_out_share,
        }


def _lines(source: TextIO) -> Iterator[dict[str, Any]]:
    """Each line of ``source``; its end ends the process at once: a parent that is gone waits for no solve."""
    waiting: queue.SimpleQueue[str] = queue.SimpleQueue()

    def read() -> None:
        for line in source:
            waiting.put(line)
        os._exit(0)

    threading.Thread(target=read, name="input", daemon=True).start()
    while True:
        yield json.loads(waiting.get())


def _failed(error: VelaturaError) -> dict[str, Any]:
    usage = isinstance(error, UsageError)
    return {"error": {"usage": usage, "code": error.code, "what": error.what, "remedy": error.remedy}}


def serve(source: TextIO, out: TextIO) -> None:
    """Answer tasks, one after the other; the calibration is read before the first one comes."""
    lines = _lines(source)
    stage = Stage(**next(lines))
    solver: Solver | None = None
    with contextlib.suppress(Exception):  # the answer to a task reports it
        solver = Solver(stage)
    for line in lines:
        try:
            solver = solver or Solver(stage)
            answer = solver.answer(Task(**line), lambda sweep, kkt: print(file=out, flush=True))
        except VelaturaError as error:
            answer = _failed(error)
        except Exception as error:  # noqa: BLE001 - a driver's own errors are not known
            what = f"The preview failed: {type(error).__name__}: {error}."
            answer = _failed(VelaturaError("preview-failed", what=what, remedy=SEND_DIAGNOSTICS))
        print(json.dumps(answer), file=out, flush=True)


def main() -> None:
    os.nice(NICENESS)
    # Drivers print as they like: only answers go to the parent.
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    serve(sys.stdin, out)


if __name__ == "__main__":
    main()
