"""The light transport and the bounded solver on a synthetic stage, against memory bandwidth and the best objective."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial

import numpy as np
from numba import prange

from benchmarks import Row, Timing, at_most, peak_bytes, timed
from benchmarks._synthetic import synthetic_calibration, synthetic_target
from controller.arrays import ByteImage, FloatImage
from controller.calibrate.values import Calibration
from controller.compiled import compiled
from controller.solve.appearance import Base, base_image, scale_frames, solve_base
from controller.solve.bounded import TOLERANCE, Solution, solve_bounded
from controller.solve.dither import to_device
from controller.solve.feasibility import choose_exposure, target_radiance
from controller.solve.interactive import interactive
from controller.transport import LightTransport
from controller.transport.window_transport import WindowTransport

STREAMED_FLOATS = 1 << 27
NEAR_BEST = 1e-3
NEAR_ENOUGH = 1e-2
LOOSE = 4e-4
SMALLEST = 1e-6


@compiled(parallel=True, fastmath=True)
def _read(values: FloatImage) -> float:
    total = np.float32(0)
    for i in prange(values.size):
        total += values[i]
    return float(total)


def measure(size: str) -> list[Row]:
    """Products against bandwidth, time to within 1e-3 of the best objective, memory."""
    calibration = synthetic_calibration(size)
    began = time.perf_counter()
    transport = LightTransport.build(calibration)
    build_s = time.perf_counter() - began
    paper = size == "paper"
    rows = [at_most("light transport, build", build_s, None, unit="s", how="once, compiling included")]
    rows += _products(transport, paper=paper)
    reflectance = synthetic_target(transport.shape)
    exposure = choose_exposure(transport, reflectance, calibration.black)
    target = target_radiance(reflectance, calibration.black, exposure)
    rows += _solve(transport, calibration, target, paper=paper)
    return rows


def _products(transport: LightTransport, *, paper: bool) -> list[Row]:
    rng = np.random.default_rng(0)
    p = rng.random((3, transport.pixels), np.float32)
    light = np.empty((3, *transport.shape), np.float32)
    back = np.empty_like(p)
    stream = np.ones(STREAMED_FLOATS, np.float32)
    read = timed(partial(_read, stream))
    forward = timed(lambda: transport.forward_planes(p, out=light))
    adjoint = timed(lambda: transport.adjoint_planes(light, out=back))
    again = timed(partial(_read, stream))
    bandwidth = stream.nbytes / min(read.minimum, again.minimum)
    stored = transport.stored_bytes
    pair = Timing(*(a + b for a, b in zip(_values(forward), _values(adjoint), strict=True)))
    samples = int(transport.windows.site.size) if isinstance(transport, WindowTransport) else 0
    return [
        at_most("memory bandwidth, read", bandwidth / 1e9, None, unit="GB/s", how=f"512 MiB, {read} and {again}"),
        at_most("T p", forward.median, None, unit="s", how=str(forward)),
        at_most("T' r", adjoint.median, None, unit="s", how=str(adjoint)),
        at_most(
            "T p + T' r by one pass over all of T",
            pair.median * bandwidth / stored,
            5.0 if paper else None,
            unit="x",
            how=f"{stored / 1e6:.0f} MB, {stored / max(samples, 1):.1f} bytes a sample and projector; pair {pair}",
        ),
    ]


def _values(timing: Timing) -> tuple[float, float, float]:
    return timing.minimum, timing.median, timing.maximum


def _solve(transport: LightTransport, calibration: Calibration, target: FloatImage, *, paper: bool) -> list[Row]:
    """A cold solve of ``target``, far beyond need for the best objective, then as far as 1e-3 and 1e-2 of it."""
    black = calibration.black
    solve_bounded(transport, target, black, most_iterations=1)
    at: list[float] = []
    best = solve_bounded(
        transport,
        target,
        black,
        tolerance=2e-6,
        most_iterations=400,
        progress=lambda iteration, kkt: at.append(time.perf_counter()),
    )
    sweep = Timing(*(float(f(np.diff(at))) for f in (np.min, np.median, np.max)))
    near = _until(transport, target, black, best.objective * (1 + NEAR_BEST), TOLERANCE)
    memory = peak_bytes()
    rows = [
        at_most("one sweep over the projectors", sweep.minimum, None, unit="s", how=str(sweep)),
        at_most(
            "solve to 1e-3 of the best objective",
            near.seconds,
            15.0 if paper else None,
            unit="s",
            how=f"{near.iterations} sweeps, KKT residual {near.kkt:.2g}; best of {best.iterations}, {best.kkt:.2g}",
        ),
        at_most(
            "peak memory of the process",
            memory / 1e9,
            3.0 if paper else None,
            unit="GB",
            how="the calibration, its pictures and the solves, resident",
        ),
    ]
    base = solve_base(transport, base_image(calibration, "white"), black)
    rows.append(at_most("base solve", base.solution.seconds, None, unit="s", how=f"{base.solution.iterations} sweeps"))
    start = scale_frames(transport, base, target, black)
    warm = _until(transport, target, black, best.objective * (1 + NEAR_ENOUGH), LOOSE, start)
    rows.append(
        at_most(
            "full solve from base x scale to 1e-2",
            warm.seconds,
            5.0 if paper else None,
            unit="s",
            how=f"{warm.iterations} sweeps",
        )
    )
    ready = interactive(transport, base, black, [part.radiometry for part in calibration.projectors])
    shown = timed(lambda: ready.frames(target), repeats=15)
    slow = timed(lambda: _reference(transport, base, target, calibration), repeats=2)
    rows.append(
        at_most("new appearance, float picture to 8-bit frames", shown.minimum, 0.1 if paper else None, unit="s",
                how=f"{shown}; by every sample and error diffusion {slow}")
    )  # fmt: skip
    return rows


def _reference(transport: LightTransport, base: Base, target: FloatImage, calibration: Calibration) -> list[ByteImage]:
    frames = scale_frames(transport, base, target, calibration.black)
    return [to_device(frame, part.radiometry) for frame, part in zip(frames, calibration.projectors, strict=True)]


def _until(
    transport: LightTransport,
    target: FloatImage,
    black: FloatImage,
    objective: float,
    tolerance: float,
    start: Sequence[FloatImage] | None = None,
) -> Solution:
    """A solve that stops by a KKT residual small enough for ``objective``, found by lowering it by a fifth."""
    while True:
        found = solve_bounded(transport, target, black, tolerance=tolerance, start=start)
        if found.objective <= objective or tolerance < SMALLEST:
            return found
        tolerance *= 0.8
