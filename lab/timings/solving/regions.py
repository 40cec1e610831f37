"""The paper's regions against the global solver: time extrapolated from random regions, objective on a crop.

Everything is timed in one run on one thread a region, and on all threads for the global solver; regions are independent
within a phase, so their time is divided by the cores. The global solver is timed to 1e-3 of the optimum, and to where
regions of 16 end. Where OSQP or Clarabel is not installed, its rows are left out.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import statistics
import time
from typing import Final

import numpy as np

from controller.core.arrays import FloatImage
from controller.optics.calibrate.values import Calibration
from controller.optics.solve.bounded.equations import SolveSettings, build_problem, initial_point
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.reach.drive_levels import DriveLevels
from controller.optics.solve.reach.feasibility import exposures, target_radiance
from controller.optics.transport import LightTransport, build_transport
from hal.runtime.compute import usable_cpus
from lab.study.regions import (
    PHASES,
    SIZE_PX,
    BoxProblem,
    RegionCut,
    Regions,
    solve_box,
    solve_regions,
)
from lab.timings import Row, Timing, at_least, at_most
from lab.timings.tools.synthetic import crop_calibration, synthetic_calibration, synthetic_target
from lab.timings.tools.traced import traced

SAMPLE: Final = 30
LONG_SWEEPS: Final = 400
MOST_S: Final = 60.0
"""Of the run whose least objective counts as the best."""
CROPS: Final = 3
CROP_PX: Final = 64
SIZES_PX: Final = (8, 16, 32)
NEAR_BEST: Final = 1e-3
GOALS: Final = {"lsq_linear": 150.0, "osqp": 8.0, "clarabel": None}
"""Times as fast as the regions, at size paper."""


def measure(size: str) -> list[Row]:
    """Regions by every solver there is, with colours mixed and apart, and how near they come to the optimum."""
    calibration = synthetic_calibration(size)
    rows, gap = _nearness(calibration)
    for kind, mixed in (("colours mixed", True), ("each channel alone", False)):
        rows += _times(calibration if mixed else _unmixed(calibration), kind, gap, paper=size == "paper")
    return rows


def _unmixed(calibration: Calibration) -> Calibration:
    """The paper's case: mixing is taken out first, and the channels are solved one by one."""
    plain = [
        dataclasses.replace(part, radiometry=dataclasses.replace(part.radiometry, mixing=np.eye(3)))
        for part in calibration.projectors
    ]
    return dataclasses.replace(calibration, projectors=tuple(plain))


def _target(transport: LightTransport, black: FloatImage) -> FloatImage:
    reflectance = synthetic_target(transport.camera_shape)
    exposure, _ = exposures(DriveLevels.of_transport(transport), reflectance, black)
    return target_radiance(reflectance, black, exposure)


def _times(calibration: Calibration, kind: str, gap: float, *, paper: bool) -> list[Row]:
    transport = build_transport(calibration)
    target = _target(transport, calibration.black)
    traced(transport, target, calibration.black, 1)
    trace = traced(transport, target, calibration.black, LONG_SWEEPS, most_s=MOST_S)
    (near_sweeps, near), (same_sweeps, same) = (trace.reached(trace.best * (1 + above)) for above in (NEAR_BEST, gap))
    rows = [
        at_most(f"global solve to {above:.1e} above the best, {kind}", at.seconds, None, unit="s",
                how=f"{sweeps} sweeps, set-up included; best of {len(trace.sweeps)}")
        for above, sweeps, at in ((NEAR_BEST, near_sweeps, near), (gap, same_sweeps, same))
    ]  # fmt: skip
    regions = Regions(build_problem(transport, target, calibration.black, 0.001, None))
    count = sum(1 for phase in PHASES for _ in regions.of_phase(phase))
    sample, cut_s = _sampled(regions)
    cores = usable_cpus()
    unknowns = statistics.median(problem.start.size for parts in sample for problem in parts)
    rows.append(
        at_most(f"cutting out the equations of a region, {kind}", cut_s, None, unit="s",
                how=f"median of {SAMPLE} regions; {count} regions in all, {unknowns:g} unknowns a problem"),
    )  # fmt: skip
    for solver, goal in GOALS.items():
        if importlib.util.find_spec(solver) is None and solver != "lsq_linear":
            continue
        spent = _region_seconds(solver, sample)
        whole = statistics.mean(spent) * count / cores
        rows += [
            at_most(f"regions by {solver}, {kind}", whole, None, unit="s",
                    how=f"{count} regions on {cores} cores, from {SAMPLE}; each {_timing(spent)}"),
            at_least(f"regions by {solver} by global solve to {NEAR_BEST:g}, {kind}", whole / near.seconds,
                     goal if paper else None, unit="x", how="solving alone, without cutting out the equations"),
            at_least(f"regions by {solver} by global solve as near as they come, {kind}", whole / same.seconds,
                     None, unit="x", how=f"to {gap:.1e} above the best, what regions of 16 leave on a crop"),
        ]  # fmt: skip
    return rows


def _sampled(regions: Regions) -> tuple[list[list[BoxProblem]], float]:
    """The problems of random regions of the first phase, which has most unknowns; and the seconds to cut one out."""
    problem = regions.problem
    x = initial_point(problem)
    light = problem.transport.forward_planes(x)
    nothing = np.zeros(x.shape[1], np.bool_)
    every = list(regions.of_phase(PHASES[0]))
    picked = np.random.default_rng(0).choice(len(every), SAMPLE, replace=len(every) < SAMPLE)
    sample, spent = [], []
    for i, j in (every[k] for k in picked):
        began = time.perf_counter()
        sample.append(regions.equations(i, j, regions.unknown(i, j, nothing), x, light))
        spent.append(time.perf_counter() - began)
    return sample, statistics.median(spent)


def _region_seconds(solver: str, sample: list[list[BoxProblem]]) -> list[float]:
    for part in sample[0]:
        solve_box(solver, part)
    spent = []
    for parts in sample:
        began = time.perf_counter()
        for part in parts:
            solve_box(solver, part)
        spent.append(time.perf_counter() - began)
    return spent


def _timing(seconds: list[float]) -> Timing:
    return Timing(min(seconds), statistics.median(seconds), max(seconds))


def _nearness(calibration: Calibration) -> tuple[list[Row], float]:
    """Crops of 64x64 camera pixels, solved exactly and by four phases; how far above the optimum regions of 16 end."""
    solver = "clarabel" if importlib.util.find_spec("clarabel") else "lsq_linear"
    apart, unknowns = [], 0
    above: dict[int, list[float]] = {size_px: [] for size_px in SIZES_PX}
    differing: dict[int, list[float]] = {size_px: [] for size_px in SIZES_PX}
    for crop in _crops(calibration):
        transport = build_transport(crop)
        target = _target(transport, crop.black)
        exact = solve_regions(transport, target, crop.black, cut=RegionCut(solver=solver, size_px=2 * CROP_PX))
        best = solve_bounded(transport, target, crop.black, SolveSettings(tolerance=1e-7, most_iterations=2000))
        apart.append(abs(best.objective / exact.objective - 1))
        unknowns = max(unknowns, exact.unknowns)
        for size_px in SIZES_PX:
            found = solve_regions(transport, target, crop.black, cut=RegionCut(solver=solver, size_px=size_px))
            above[size_px].append(found.objective / exact.objective - 1)
            differing[size_px].append(np.sqrt(np.mean((found.light - exact.light) ** 2) / np.mean(exact.light**2)))
    rows = [
        at_most("global objective apart from the exact one", max(apart), 1e-4, unit="",
                how=f"the worst of {CROPS} crops of {CROP_PX}x{CROP_PX} camera pixels by {solver}, "
                f"at most {unknowns} unknowns; median {statistics.median(apart):.1e}"),
    ]  # fmt: skip
    rows += [
        at_most(f"objective of regions of {size_px} above the optimum", statistics.median(above[size_px]), None,
                unit="", how=f"median of {CROPS} crops, worst {max(above[size_px]):.2g}; "
                f"their light differs by {statistics.median(differing[size_px]):.2%} rms")
        for size_px in SIZES_PX
    ]  # fmt: skip
    return rows, statistics.median(above[SIZE_PX])


def _crops(calibration: Calibration) -> list[Calibration]:
    """Random crops that lie wholly on the object."""
    random = np.random.default_rng(5)
    rows, columns = calibration.object_mask.shape
    crops: list[Calibration] = []
    while len(crops) < CROPS:
        top, left = (2 * int(random.integers(0, (side - CROP_PX) // 2)) for side in (rows, columns))
        if calibration.object_mask[top : top + CROP_PX, left : left + CROP_PX].all():
            crops.append(crop_calibration(calibration, top, left, CROP_PX))
    return crops
