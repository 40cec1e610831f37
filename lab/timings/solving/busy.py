"""A solve on an idle machine and beside as many busy programs as there are CPUs; each solve is a process of its own."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from hal.runtime.compute import usable_cpus
from lab.timings import Row, at_most

GOAL: Final = 2.5
REPEATS: Final = 5
SOLVE: Final = """
import sys, time
from lab.timings.tools.synthetic import synthetic_calibration, synthetic_target
from controller.optics.solve.appearance import base_image, solve_base
from controller.optics.solve.reach.drive_levels import DriveLevels
from controller.optics.solve.reach.feasibility import exposures, target_radiance
from controller.optics.transport import build_transport
calibration = synthetic_calibration(sys.argv[1])
transport = build_transport(calibration)
reflectance = synthetic_target(transport.camera_shape)
exposure, _ = exposures(DriveLevels.of_transport(transport), reflectance, calibration.black)
target = target_radiance(reflectance, calibration.black, exposure)
solve_base(transport, target, calibration.black)
for _ in sys.stdin:
    began = time.perf_counter()
    solve_base(transport, target, calibration.black)
    print(time.perf_counter() - began, flush=True)
"""


def measure(size: str) -> list[Row]:
    """Seconds of a solve, idle and busy in turn, for each way in which OpenMP's threads can wait."""
    rows = []
    for policy in ("passive", "active"):
        idle, busy = _in_turn(size, policy)
        how = f"medians of {REPEATS} in turn: idle {idle:.2f} s, beside {usable_cpus()} busy loops {busy:.2f} s"
        goal = GOAL if policy == "passive" else None
        rows.append(at_most(f"busy over idle, threads wait {policy}", busy / idle, goal, unit="x", how=how))
    return rows


def _in_turn(size: str, policy: str) -> tuple[float, float]:
    idle, busy = [], []
    environment = os.environ | {"OMP_WAIT_POLICY": policy, "PYTHONPATH": str(Path(__file__).parents[3])}
    with subprocess.Popen(
        [sys.executable, "-c", SOLVE, size], env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        for _ in range(REPEATS):
            idle.append(_one_solve(process))
            with _busy_loops(usable_cpus()):
                busy.append(_one_solve(process))
        process.communicate()
    return statistics.median(idle), statistics.median(busy)


def _one_solve(process: subprocess.Popen[str]) -> float:
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write("solve\n")
    process.stdin.flush()
    return float(process.stdout.readline())


@contextmanager
def _busy_loops(number: int) -> Iterator[None]:
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(number)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()
