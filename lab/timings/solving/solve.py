"""The light transport and the bounded solver on a synthetic stage, against memory bandwidth and the best objective."""

from __future__ import annotations

import time
from functools import partial

import numpy as np
from numba import prange

from controller.config.defaults import SMOOTHNESS
from controller.core.arrays import ByteImage, FloatImage
from controller.core.jit import compiled
from controller.optics.calibrate.values import Calibration
from controller.optics.solve.appearance import Base, StageLight, base_image, scale_frames, solve_base
from controller.optics.solve.bounded.engine import SolveContext
from controller.optics.solve.reach.drive_levels import DriveLevels
from controller.optics.solve.reach.feasibility import exposures, target_radiance
from controller.optics.solve.request import SolveOptions, aim_at, solve_appearance
from controller.optics.solve.scaling.dither import to_device
from controller.optics.solve.scaling.interactive import interactive
from controller.optics.solve.targets.values import Target
from controller.optics.transport import LightTransport, build_transport
from lab.timings import Row, Timing, at_most, peak_bytes, timed
from lab.timings.tools.synthetic import synthetic_calibration, synthetic_indirect, synthetic_target
from lab.timings.tools.traced import Sweep, Trace, traced

STREAMED_FLOATS = 1 << 27
NEAR_BEST = 1e-3
NEAR_ENOUGH = 1e-2
BASE_SWEEPS = 150
LONG_SWEEPS = 400
MOST_S = 110.0
"""Of a long run; a gap to its best is a lower bound of that to the optimum, the less so the longer it was."""


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
    transport = build_transport(calibration)
    build_s = time.perf_counter() - began
    build = at_most("light transport, build", build_s, None, unit="s", how="once, compiling included")
    return [build, *of_stage(transport, calibration, paper=size == "paper")]


def of_stage(transport: LightTransport, calibration: Calibration, *, paper: bool) -> list[Row]:
    """The same of a stage whose transport is there."""
    rows = _products(transport, paper=paper)
    reflectance = synthetic_target(transport.camera_shape)
    exposure, _ = exposures(DriveLevels.of_transport(transport), reflectance, calibration.black)
    target = target_radiance(reflectance, calibration.black, exposure)
    rows += _solve(transport, calibration, target, paper=paper)
    rows += _whole(transport, calibration, reflectance)
    return rows


def _products(transport: LightTransport, *, paper: bool) -> list[Row]:
    rng = np.random.default_rng(0)
    p = rng.random((3, transport.pixels), np.float32)
    light = np.empty((3, *transport.camera_shape), np.float32)
    back = np.empty_like(p)
    stream = np.ones(STREAMED_FLOATS, np.float32)
    read = timed(partial(_read, stream))
    forward = timed(lambda: transport.forward_planes(p, out=light))
    adjoint = timed(lambda: transport.adjoint_planes(light, out=back))
    again = timed(partial(_read, stream))
    bandwidth = stream.nbytes / min(read.minimum, again.minimum)
    stored = stored_bytes(transport)
    pair = Timing(*(a + b for a, b in zip(_values(forward), _values(adjoint), strict=True)))
    samples = stored_windows(transport)
    return [
        at_most("memory bandwidth, read", bandwidth / 1e9, None, unit="GB/s", how=f"512 MiB, {read} and {again}"),
        at_most("T p", forward.median, None, unit="s", how=str(forward)),
        at_most("T' r", adjoint.median, None, unit="s", how=str(adjoint)),
        at_most(
            "T p + T' r by one pass over all of T",
            pair.median * bandwidth / stored,
            8.0 if paper else None,
            unit="x",
            how=f"{stored / 1e6:.0f} MB, {stored / max(samples, 1):.1f} bytes a sample and projector; pair {pair}",
        ),
    ]


def stored_bytes(transport: LightTransport) -> int:
    """The size of what a product reads of T."""
    return sum(
        array.nbytes for name, array in transport.arrays().items() if name not in ("lit", "per_weight", "per_sum")
    )


def stored_windows(transport: LightTransport) -> int:
    """How many windows of camera samples T has; 0 where it is made of metapixels."""
    site = transport.arrays().get("site")
    return 0 if site is None else int(site.size)


def _values(timing: Timing) -> tuple[float, float, float]:
    return timing.minimum, timing.median, timing.maximum


def _solve(transport: LightTransport, calibration: Calibration, target: FloatImage, *, paper: bool) -> list[Row]:
    """A base, an appearance far beyond need for its best objective, and the same again from base x scale."""
    black = calibration.black
    traced(transport, target, black, 1)
    image = base_image(calibration, "white")
    of_base = traced(transport, image, black, BASE_SWEEPS, most_s=MOST_S)
    rows = _near("base solve", of_base, NEAR_BEST, 4.0 if paper else None)
    rows.append(at_most("one sweep over the projectors", of_base.sweep.minimum, None, unit="s", how=str(of_base.sweep)))
    rows.append(at_most("before the first sweep", of_base.setup.seconds, None, unit="s", how=_processor(of_base.setup)))
    whole = traced(transport, target, black, LONG_SWEEPS, most_s=MOST_S)
    rows += _near("appearance", whole, NEAR_BEST, 3.0 if paper else None)
    rows += _near("appearance", whole, NEAR_ENOUGH, 1.0 if paper else None)
    rows.append(at_most("peak memory of the process", peak_bytes() / 1e9, 3.0 if paper else None, unit="GB",
                        how="the calibration, its pictures and the solves, resident"))  # fmt: skip
    base = solve_base(transport, image, black)
    solution = base.solution
    near = f"KKT residual {solution.kkt:.2g}, {solution.objective / of_base.best - 1:.1e} above the best"
    rows.append(at_most("base solve as it stops by itself", solution.seconds, None, unit="s",
                        how=f"{solution.iterations} sweeps, {near}"))  # fmt: skip
    start = scale_frames(transport, base, target, black)
    warm = traced(transport, target, black, 60, start=start, enough=whole.best * (1 + NEAR_ENOUGH))
    number, at = warm.reached(whole.best * (1 + NEAR_ENOUGH))
    rows.append(at_most("appearance from base x scale to 0.01 of the best", at.seconds, None, unit="s",
                        how=f"{number} sweeps, no longer done: decision 8; {_processor(at)}"))  # fmt: skip
    ready = interactive(transport, base, black, [part.radiometry for part in calibration.projectors])
    shown = timed(lambda: ready.frames(target), repeats=15)
    slow = timed(lambda: _reference(transport, base, target, calibration), repeats=2)
    rows.append(
        at_most("new appearance, float picture to 8-bit frames", shown.minimum, 0.1 if paper else None, unit="s",
                how=f"{shown}; by every sample and error diffusion {slow}")
    )  # fmt: skip
    return rows


def _whole(transport: LightTransport, calibration: Calibration, reflectance: FloatImage) -> list[Row]:
    """A warm appearance with indirect light as the program makes it, in processor time: by the share of its parts."""
    drive, indirect = DriveLevels.of_transport(transport), synthetic_indirect(calibration, transport.object_mask)
    light = StageLight(transport, calibration.black, indirect, drive)
    target = Target(reflectance, np.ones(reflectance.shape[:2], np.bool_))
    options, sweeps, spent, aims = SolveOptions(share=0.9, smoothness=SMOOTHNESS, adapt=1.0), [0], [], []
    context = SolveContext(progress=lambda number, kkt: sweeps.append(number))
    for _ in range(3):
        began = time.process_time()
        aim_at(drive, light.black, indirect, target.image, options)
        aims.append(time.process_time() - began)
        began, sweeps[:] = time.process_time(), [0]
        solve_appearance(light, target, options, context)
        spent.append(time.process_time() - began)
    whole, aim = min(spent), min(aims)
    how = f"{len(sweeps) - 1} sweeps of two solves; the least of {len(spent)}"
    return [
        at_most("a warm appearance with indirect light", whole, None, unit="s of processor time", how=how),
        at_most("of it before the solves", aim / whole, None, unit="", how="exposure, indirect light, adaptation"),
    ]


def _near(what: str, trace: Trace, gap: float, goal: float | None) -> list[Row]:
    number, at = trace.reached(trace.best * (1 + gap))
    last = trace.sweeps[-1]
    how = f"{number} sweeps, set-up included, KKT residual {at.kkt:.2g}; {_processor(at)}; best of {len(trace.sweeps)}"
    return [at_most(f"{what} to {gap:g} of the best", at.seconds, goal, unit="s", how=f"{how}, {last.kkt:.2g}")]


def _processor(at: Sweep) -> str:
    return f"{at.processor_s:.3g} s of processor time"


def _reference(transport: LightTransport, base: Base, target: FloatImage, calibration: Calibration) -> list[ByteImage]:
    frames = scale_frames(transport, base, target, calibration.black)
    return [to_device(frame, part.radiometry) for frame, part in zip(frames, calibration.projectors, strict=True)]
