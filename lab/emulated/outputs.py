"""Projectors whose outputs have players of their own, or show everything later than the others."""

from __future__ import annotations

import itertools
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from plugins.emulated.core.truth import BenchTruth
from plugins.emulated.optics.outputs import VisibleFrames, VisibleFrameSet


class SeparateOutputs:
    """Used as ``VisibleFrames``: the sets that it gives are put together from those that each projector shows."""

    def __init__(self, stage: Path, truth: BenchTruth) -> None:
        self._sources = [
            (one.output, VisibleFrames(stage / (one.frames or truth.frames), truth.latency_s + one.late_s))
            for one in truth.projectors
        ]
        self._watched = ExitStack()

    def __enter__(self) -> SeparateOutputs:
        for _, visible in self._sources:
            self._watched.enter_context(visible)
        return self

    def __exit__(self, *_: object) -> None:
        self._watched.close()

    def during(self, start_s: float, end_s: float) -> list[tuple[float, VisibleFrameSet | None]]:
        """As that of ``VisibleFrames``. Each set is of the middle of the time in which no projector changed."""
        shown = [(output, visible.during(start_s, end_s)) for output, visible in self._sources]
        ends = [np.cumsum([share for share, _ in parts]) for _, parts in shown]
        edges = [0.0, *sorted({min(float(end), 1.0) for each in ends for end in each})]
        found: list[tuple[float, VisibleFrameSet | None]] = []
        for begin, end in itertools.pairwise(edges):
            frames = {}
            for (output, parts), each in zip(shown, ends, strict=True):
                at = min(int(np.searchsorted(each, (begin + end) / 2)), len(parts) - 1)
                if (there := parts[at][1]) is not None and output in there.frames:
                    frames[output] = there.frames[output]
            found.append((end - begin, VisibleFrameSet(0, 0.0, frames)))
        return found
