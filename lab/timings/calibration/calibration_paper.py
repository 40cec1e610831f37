"""Time and memory of the numeric steps at the paper's size: one projector of 1400x1050 seen by 3888x2592 pixels.

The photographs are made one at a time from a phase map in closed form when a step asks for one; their making is taken
off. They are no test of accuracy. The geometry gets correspondences from the rays of an emulated stage of that size.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from controller.core.arrays import FloatImage
from controller.optics.calibrate.correspondence.decode import decode
from controller.optics.calibrate.metapixels.from_phase import fit_pixels
from controller.optics.calibrate.values import Correspondence
from controller.optics.capture.pattern_frames import frame
from controller.optics.capture.patterns import PatternPlan, plan_patterns
from lab.timings import Row, at_most, peak_bytes
from lab.timings.calibration.geometry import FIRST_SEED, geometry_seconds
from lab.timings.tools.synthetic import CAMERA, PROJECTOR, synthetic_calibration

NOISE = 0.002
BLACK = 0.002
REPEATS = 3


class Photographs(Mapping[str, FloatImage]):
    """Photographs (rows, columns, 3) by pattern name, made when asked for; ``spent`` wall and CPU seconds on it."""

    def __init__(self, plan: PatternPlan, projector_px: FloatImage, white: FloatImage) -> None:
        self._plan = {pattern.name: pattern for pattern in plan}
        self._size_px = plan.size_px
        self._x = np.nan_to_num(projector_px[..., 0], nan=-99.0)
        self._y = np.nan_to_num(projector_px[..., 1], nan=-99.0)
        self._white = white
        random = np.random.default_rng(1)
        self._noise = random.normal(BLACK, NOISE, (*white.shape[:2], 1)).astype(np.float32)
        self.spent = np.zeros(2)

    def __getitem__(self, name: str) -> FloatImage:
        began = _now()
        shown = np.atleast_3d(frame(self._plan[name], self._size_px))
        seen = np.atleast_3d(cv2.remap(shown, self._x, self._y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT))
        image = seen * self._white + np.roll(self._noise, len(name) * 7 + ord(name[-1]), axis=1)
        self.spent += _now() - began
        return np.asarray(image, np.float32)

    def __iter__(self) -> Iterator[str]:
        return iter(self._plan)

    def __len__(self) -> int:
        return len(self._plan)


@dataclass(frozen=True, slots=True)
class Spent:
    """Wall and CPU seconds of the fastest of some repeats."""

    wall_s: float
    cpu_s: float

    def __str__(self) -> str:
        return f"{self.cpu_s:.3g} s of processor time over all cores; fastest of {REPEATS}; photographs taken off"


def measure(size: str) -> list[Row]:
    """Decoding, metapixels and geometry; goals stand at ``paper``."""
    rows, columns = PROJECTOR[size]
    plan = plan_patterns((columns, rows))
    part = synthetic_calibration(size).projectors[0]
    assert part.phase_map is not None
    photographs = Photographs(plan, part.phase_map.projector_px, part.white)
    del part
    before = peak_bytes()
    found: list[Correspondence] = []
    decoding = _spent(photographs, lambda: found.append(decode(photographs, plan, camera_blur_px=0.8)))
    decoded = peak_bytes()
    pixels = _spent(photographs, lambda: fit_pixels(photographs, plan, found[-1]))
    fitted = peak_bytes()
    seconds, cpu_s = geometry_seconds(size, FIRST_SEED)
    paper = size == "paper"
    camera = f"{CAMERA[size][1]}x{CAMERA[size][0]}"
    return [
        at_most("decoding, a projector", decoding.wall_s, 5.0 if paper else None, unit="s",
                how=f"camera {camera}; {decoding}"),
        at_most("peak memory, decoding", decoded / 1e9, 3.0 if paper else None, unit="GB",
                how=f"{before / 1e9:.2f} GB of it before: the stage is made here"),
        at_most("metapixels and phase map, a projector", pixels.wall_s, 8.0 if paper else None, unit="s",
                how=str(pixels)),
        at_most("peak memory, metapixels", fitted / 1e9, 3.0 if paper else None, unit="GB", how="the same process"),
        at_most("geometry, N = 3", seconds, 60.0 if paper else None, unit="s",
                how=f"{cpu_s:.3g} s of processor time over all cores; once, compiled before or read from the cache"),
    ]  # fmt: skip


def _spent(photographs: Photographs, work: Callable[[], object]) -> Spent:
    work()
    found = []
    for _ in range(REPEATS):
        photographs.spent[:] = 0
        began = _now()
        work()
        found.append(_now() - began - photographs.spent)
    wall_s, cpu_s = np.min(found, axis=0)
    return Spent(float(wall_s), float(cpu_s))


def _now() -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.array([time.perf_counter(), time.process_time()])


__all__ = ("measure",)
