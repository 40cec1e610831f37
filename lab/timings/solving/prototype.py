"""The bounded solver beside an older one, a prototype outside this repository, in one run.

``VELATURA_REFERENCE`` names its folder; without it, a notice stands in place of the rows. The prototype makes a stage
of its own, and takes joint accelerated steps on it. Our solver gets the same arrays, the prototype's own products and
the same objective (squared residual and smoothness), and sweeps until it is as near. So that ratio is of the methods;
as many sweeps on a stage of ours, of the same size and with our products, are a row of their own.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import runpy
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from controller.core.arrays import FloatImage
from controller.core.errors import WorkError
from controller.optics.solve.appearance import base_image
from controller.optics.solve.bounded.engine import IterationControl, block_coordinate_descent
from controller.optics.solve.bounded.equations import EDGE_WEIGHT_STEPS, Problem, smoothness_term
from controller.optics.transport import LightTransport, build_transport
from controller.optics.transport.planes import CameraBox
from lab.timings import Row, at_least, at_most, timed
from lab.timings.tools.synthetic import synthetic_calibration
from lab.timings.tools.traced import traced

VARIABLE: Final = "VELATURA_REFERENCE"
FACTORS: Final = {"small": 0.2, "medium": 0.5, "paper": 1.0}
ITERATIONS: Final = 50
MOST_SWEEPS: Final = 60


def measure(size: str) -> list[Row]:
    """Seconds to the objective that the prototype has after ``ITERATIONS``, and of the products."""
    folder = os.environ.get(VARIABLE)
    if not folder:
        return [Row(f"left out: {VARIABLE} is not set", "", None, 0.0, None, "name the prototype's folder")]
    theirs, seconds = _prototype(Path(folder), FACTORS[size])
    objective = _objective(theirs, theirs["p"])
    transport = _Theirs.of(theirs)
    sweeps, ours_s, reached = _to_objective(transport, theirs, objective)
    goal = 2.0 if size == "paper" else None
    return [
        at_most(f"prototype, {ITERATIONS} joint iterations", seconds, None, unit="s", how=f"objective {objective:.6g}"),
        at_most("sweeps to the same objective", ours_s, None, unit="s",
                how=f"{sweeps} sweeps from equal shares, these included, with the prototype's products; {reached:.6g}"),
        at_least("as fast as the prototype, same products", seconds / ours_s, goal, unit="x", how="the method alone"),
        *_here(size, sweeps, seconds, goal),
    ]  # fmt: skip


@contextlib.contextmanager
def _arguments(folder: Path, *given: str) -> Iterator[None]:
    before, path = sys.argv, list(sys.path)
    sys.argv, sys.path = [str(folder), *given], [str(folder), *path]
    try:
        yield
    finally:
        sys.argv, sys.path = before, path


def _prototype(folder: Path, factor: float) -> tuple[dict[str, Any], float]:
    """What it leaves behind, and the seconds that its iterations took, without those of its own reports."""
    told = io.StringIO()
    with _arguments(folder, str(factor), str(ITERATIONS)), contextlib.redirect_stdout(told):
        theirs = runpy.run_path(str(folder / "solve.py"))
    whole = float(re.findall(rf"^{ITERATIONS} t ([\d.]+)", told.getvalue(), re.MULTILINE)[-1])
    report_s = timed(lambda: theirs["obj"](theirs["p"]), repeats=2).minimum
    return theirs, whole - report_s * (ITERATIONS // 10 - 1)


def _smooth(theirs: dict[str, Any]) -> tuple[FloatImage, FloatImage]:
    """Its smoothness weights as planes (3, pixels)."""
    across, down = (np.ascontiguousarray(theirs[name].T) for name in ("wh", "wv"))
    return across, down


def _objective(theirs: dict[str, Any], p: npt.NDArray[np.float32]) -> float:
    """Squared residual and smoothness at ``p`` (pixels, 3)."""
    squared = 2 * theirs["obj"](p)[0]
    shape = theirs["N"], theirs["ph"], theirs["pw"], 3
    frames, across, down = (theirs[name].reshape(shape) if name else p.reshape(shape) for name in ("", "wh", "wv"))
    for n in range(shape[0]):
        squared += float((across[n, :, :-1] * np.diff(frames[n], axis=1) ** 2).sum(dtype=np.float64))
        squared += float((down[n, :-1] * np.diff(frames[n], axis=0) ** 2).sum(dtype=np.float64))
    return float(squared)


@dataclass(frozen=True, eq=False, repr=False)
class _Theirs(LightTransport):
    """The prototype's T, by its own products; a sensor buffer is its picture (rows, columns, 3), flat."""

    theirs: dict[str, Any]

    @classmethod
    def of(cls, theirs: dict[str, Any]) -> _Theirs:
        size = int(theirs["ph"]), int(theirs["pw"])
        count = int(theirs["N"])
        lit = np.ones((count, theirs["H"], theirs["W"]), np.bool_)
        mixing = np.broadcast_to(np.eye(3, dtype=np.float32), (count, 3, 3)).copy()
        return cls(mixing, lit, np.ones(count * size[0] * size[1], np.float32), (size,) * count, theirs)

    def _part(self, n: int) -> tuple[Any, ...]:
        span = self.span(n)
        return tuple(self.theirs[name][span] for name in ("P", "X0", "Y0", "A"))

    def accumulate_forward(self, n: int, p: FloatImage, buffer: FloatImage) -> None:
        weights, left, top, amplitude = self._part(n)
        pixels = np.ascontiguousarray(p[:, self.span(n)].T)
        of, picture = self.theirs, buffer.reshape(*self.camera_shape, 3)
        of["fwd"](weights, left, top, pixels, amplitude, picture, of["K"], *self.sizes[n], 1, of["B"])

    def adjoint_of_buffer(self, n: int, buffer: FloatImage, out: FloatImage) -> None:
        weights, left, top, amplitude = self._part(n)
        pixels = np.empty((left.size, 3), np.float32)
        picture = buffer.reshape(*self.camera_shape, 3)
        self.theirs["adj"](weights, left, top, picture, amplitude, pixels, self.theirs["K"])
        out[:, self.span(n)] = pixels.T

    def normal_residual(
        self, buffer: FloatImage, weights: FloatImage, right_hand_side: FloatImage, out: FloatImage
    ) -> None:
        np.subtract(buffer, right_hand_side, out=out)

    def forward_planes(
        self, p: FloatImage, *, projectors: tuple[int, int] | None = None, out: FloatImage | None = None
    ) -> FloatImage:
        raise TypeError("the prototype's pictures are sensor buffers")

    def adjoint_planes(
        self, r: FloatImage, *, projectors: tuple[int, int] | None = None, out: FloatImage | None = None
    ) -> FloatImage:
        raise TypeError("the prototype's pictures are sensor buffers")

    def gaussian_mean_planes(self, image: FloatImage, *, projectors: tuple[int, int] | None = None) -> FloatImage:
        raise TypeError("the prototype has no means")

    def submatrix(
        self, box: CameraBox, pixels: npt.NDArray[np.int64], channels: tuple[int, ...]
    ) -> sp.csr_matrix[np.float64]:
        raise TypeError("the prototype writes out no equations")

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        return {}


def _to_objective(transport: _Theirs, theirs: dict[str, Any], objective: float) -> tuple[int, float, float]:
    """Sweeps until the objective is no higher, their seconds without those of looking, and the objective then."""
    across, down = _smooth(theirs)
    majoriser = 2 * _edge_sums(transport, across, down)
    ones, light, reach = np.ones_like(majoriser), transport.sensor_buffer(), transport.sensor_buffer()
    data = np.zeros_like(majoriser)
    for n in range(len(transport.sizes)):
        light[:] = 0
        transport.accumulate_forward(n, ones, light)
        reach += light
        transport.adjoint_of_buffer(n, light, data)
    majoriser += data
    wanted: FloatImage = theirs["tgt"]
    strength_per_step = float(max(across.max(), down.max())) / EDGE_WEIGHT_STEPS
    right, below = (np.rint(part / np.float32(strength_per_step)).astype(np.uint16) for part in (across, down))
    weights = np.ones(transport.camera_shape, np.float32)
    problem = Problem(
        transport, wanted, np.zeros_like(wanted), weights, wanted.reshape(-1), np.zeros((3, 0, 0), np.float32), right,
        below, strength_per_step, majoriser,
    )  # fmt: skip
    start = _start(transport, wanted, reach)
    block_coordinate_descent(problem, start.copy(), IterationControl(0, 1))
    seen: list[tuple[int, float, float]] = []
    state = {"looked_s": 0.0, "began_s": time.perf_counter()}
    start = _start(transport, wanted, reach)

    def look(sweep: int, x: FloatImage) -> None:
        arrived_s = time.perf_counter()
        light = transport.sensor_buffer()
        for n in range(len(transport.sizes)):
            transport.accumulate_forward(n, x, light)
        found = float(((light - wanted.reshape(-1)).astype(np.float64) ** 2).sum()) + smoothness_term(problem, x)
        seen.append((sweep, arrived_s - state["began_s"] - state["looked_s"], found))
        state["looked_s"] += time.perf_counter() - arrived_s

    def enough() -> bool:
        return bool(seen) and seen[-1][2] <= objective

    with contextlib.suppress(WorkError):
        block_coordinate_descent(problem, start, IterationControl(0, MOST_SWEEPS, cancelled=enough, on_iterate=look))
    return seen[-1]


def _start(transport: _Theirs, wanted: FloatImage, reach: FloatImage) -> FloatImage:
    """All projectors at the same share of their light, as means over their pixels' light."""
    share, whole = np.empty((3, transport.pixels), np.float32), np.empty((3, transport.pixels), np.float32)
    for n in range(len(transport.sizes)):
        transport.adjoint_of_buffer(n, wanted.reshape(-1), share)
        transport.adjoint_of_buffer(n, reach, whole)
    return np.clip(share / np.maximum(whole, np.finfo(np.float32).tiny), 0, 1)


def _edge_sums(transport: _Theirs, across: FloatImage, down: FloatImage) -> FloatImage:
    """The sum of the weights of each pixel's edges (3, pixels)."""
    total = across + down
    for n, size in enumerate(transport.sizes):
        frame, right, below = (v[:, transport.span(n)].reshape(3, *size) for v in (total, across, down))
        frame[:, :, 1:] += right[:, :, :-1]
        frame[:, 1:] += below[:, :-1]
    return total


def _here(size: str, sweeps: int, prototype_s: float, goal: float | None) -> list[Row]:
    """So many sweeps and the set-up of ours, on the synthetic stage of the same size."""
    calibration = synthetic_calibration(size)
    transport = build_transport(calibration)
    image = base_image(calibration, "white")
    traced(transport, image, calibration.black, 1)
    trace = traced(transport, image, calibration.black, 8)
    whole = trace.setup.seconds + sweeps * trace.sweep.minimum
    return [
        at_least("as fast as the prototype, each on its own stage", prototype_s / whole, goal, unit="x",
                 how=f"as many sweeps on the synthetic stage of this size, set-up included: {whole:.3g} s; "
                 f"a sweep {trace.sweep}"),
    ]  # fmt: skip
