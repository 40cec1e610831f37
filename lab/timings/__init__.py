"""What is measured, and against what: one module an area, each with ``measure(size) -> list[Row]``."""

from __future__ import annotations

import os
import resource
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from hal.runtime.compute import usable_cpus

SIZES: Final = ("small", "medium", "paper")


@dataclass(frozen=True, slots=True)
class Row:
    """One figure. ``value`` and ``goal`` are in ``unit``; ``holds`` is None where there is no goal at this size."""

    figure: str
    unit: str
    goal: float | None
    value: float
    holds: bool | None
    how: str


def at_most(figure: str, value: float, goal: float | None, *, unit: str, how: str) -> Row:
    """A row whose value should not exceed its goal."""
    return Row(figure, unit, goal, value, None if goal is None else value <= goal, how)


def at_least(figure: str, value: float, goal: float | None, *, unit: str, how: str) -> Row:
    """A row whose value should reach its goal."""
    return Row(figure, unit, goal, value, None if goal is None else value >= goal, how)


@dataclass(frozen=True, slots=True)
class Timing:
    """Seconds over repeats, in one run, after one call that is not counted."""

    minimum: float
    median: float
    maximum: float

    def __str__(self) -> str:
        return f"min {self.minimum:.3g}, median {self.median:.3g}, max {self.maximum:.3g} s"


def timed(work: Callable[[], object], *, repeats: int = 5) -> Timing:
    """Time ``work``, called once before, so that it is compiled and its memory is there."""
    work()
    seconds = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - began)
    return Timing(min(seconds), statistics.median(seconds), max(seconds))


def peak_bytes() -> int:
    """The largest memory this process has had resident."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def machine() -> dict[str, int]:
    """What the figures were measured on."""
    pages = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return {"cores": usable_cpus(), "memory_bytes": pages}


def areas() -> dict[str, str]:
    """The module of each area by its name; those of ``lab.timings.tools`` are parts of others."""
    folder = Path(__file__).parent
    found = {file.stem: f"lab.timings.{file.parent.name}.{file.stem}" for file in folder.glob("*/[!_]*.py")}
    return {name: found[name] for name in sorted(found) if not found[name].startswith("lab.timings.tools.")}
