"""Refinings that something disturbs: persons, hands, flashes, lamps, bumps. Never worse than before.

    python -m tests.campaigns.disturbances 200 [SEED]

A whole refining through its steps, on a stage of models. Persons, hands and flashes are gone afterwards; what lamps
and bumps change stays. A light that is on in every photograph is a change of the room to all who see only these: it
is counted apart (docs/how-to/appearances.md). The frames before and after are compared in the light that is left,
without noise. Prints every refining that made it worse; ends with 1 if there is one.
"""

from __future__ import annotations

import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from controller.core.arrays import ByteImage, FloatImage
from controller.optics.solve.result.metrics import compare
from controller.stage.artefacts.solved import Solved
from tests.controller.stage.steps.appearance.test_refining import CAMERA, EXPOSURE, NAMES, OUTPUTS, Light, Stage, target

KINDS = ("person", "body", "hand", "flash", "lamp", "flicker", "bump", "nothing")
WORSE = 0.1
"""CIEDE2000, median."""
SHOTS = 3
"""Exposures of one photograph of a result."""


class World:
    """The light of a stage, (projectors, rows, columns, 3), as it is while an exposure is taken, and as it stays."""

    def __init__(self, seed: int) -> None:
        rng = self.rng = np.random.default_rng(seed)
        self.kind = KINDS[seed % len(KINDS)]
        self.taken = 0
        self.gains = rng.uniform(0.95, 1.05, 2)
        self.indirect = rng.uniform(0, 0.06)
        self.projector = int(rng.integers(2))
        self.photographs = int(rng.choice([1, 1, 2, 3]))
        self.first = int(rng.choice([0, 0, 0, int(rng.integers(3 * SHOTS))]))
        if self.kind in ("lamp", "bump"):
            # what changes for good during the very last photograph can't be blamed on the loop
            self.first -= self.first % SHOTS
        self.last = self.first + int(rng.choice([1, SHOTS, SHOTS, 2 * SHOTS, 4 * SHOTS]))
        self.area = self._area(0.1 if self.kind == "hand" else rng.uniform(0.15, 0.95))
        self.depth = rng.uniform(0.7, 1.0)
        self.colour = EXPOSURE * rng.uniform(0.05, 0.6, 3).astype(np.float32)
        self.flash = EXPOSURE * rng.uniform(0.02, 0.4) * (self._area(0.5) if rng.random() < 0.5 else 1.0)
        self.shift = rng.uniform(-4, 4, 2)
        self.lamp = rng.uniform(0.5, 1.1)

    def _area(self, share: float) -> FloatImage:
        """(rows, columns, 1): 1 on about this share of the picture, a blob or all beyond an edge; a soft border."""
        height, width = CAMERA
        y, x = np.mgrid[0:height, 0:width].astype(np.float64)
        turn = self.rng.uniform(0, 2 * np.pi)
        far = np.cos(turn) * x / width + np.sin(turn) * y / height
        if share < 0.15 or self.rng.random() < 0.5:
            at = self.rng.uniform(0.2, 0.8, 2)
            far = np.hypot(x / width - at[0], y / height - at[1])
        area = (far <= np.quantile(far, share)).astype(np.float32)
        soft = cv2.GaussianBlur(area, (0, 0), float(self.rng.uniform(0.5, 2)))
        return np.asarray(soft[..., None], np.float32)

    def seen(self, parts: Sequence[FloatImage], exposure: int | None) -> FloatImage:
        """During an ``exposure``; None: when everybody is gone."""
        here = exposure is not None and self.first <= exposure < self.last
        self.taken = self.taken if exposure is None else exposure + 1
        stays = (self.taken if exposure is None else exposure + 1) > self.first
        lit = [np.asarray(part * gain, np.float32) for part, gain in zip(parts, self.gains, strict=True)]
        n = self.projector
        if self.kind == "lamp" and stays:
            lit[n] *= np.float32(self.lamp)
        if self.kind == "flicker" and exposure is not None:
            lit = [part * np.float32(self.rng.normal(1, 0.04)) for part in lit]
        if self.kind == "bump" and stays:
            moved = np.array([[1, 0, self.shift[0]], [0, 1, self.shift[1]]])
            there = cv2.warpAffine(lit[n], moved, CAMERA[::-1], borderMode=cv2.BORDER_REPLICATE)
            lit[n] = np.asarray(there, np.float32)
        if here and self.kind in ("person", "hand"):
            lit[n] = lit[n] * (1 - np.float32(self.depth) * self.area)
        light = lit[0] + lit[1]
        light = light + np.float32(self.indirect) * light.mean(axis=(0, 1))
        if here and self.kind in ("body", "hand"):
            light = light * (1 - self.area) + self.colour * self.area
        if here and self.kind == "flash":
            light = light + np.float32(1) * self.flash
        return np.asarray(light, np.float32)


class DisturbedStage(Stage):
    """A stage whose camera sees a ``World``."""

    def in_world(self, world: World) -> None:
        camera, self.world = self.camera, world
        taken = camera.taken
        camera.lights = [lambda light: light]

        def seen(light: Light) -> FloatImage:
            shown = [self.display.shown[-1][output] for output in OUTPUTS]
            return world.seen(self._parts(shown), len(taken) - 1) + camera.known.black

        camera.seen = seen  # type: ignore[method-assign]

    def _parts(self, shown: Sequence[ByteImage]) -> list[FloatImage]:
        known, parts = self.camera.known, []
        for n, (part, frame) in enumerate(zip(known.projectors, shown, strict=True)):
            linear = np.stack([part.radiometry.response[c][frame[..., c]] for c in range(3)], -1).astype(np.float32)
            parts.append(self.camera.transport.forward_part(n, linear))
        return parts

    def left(self, solved: Solved) -> float:
        """The median CIEDE2000 of frames once everybody is gone, without noise."""
        parts = self._parts([solved.frames[name] for name in NAMES])
        light = self.world.seen(parts, None) + self.camera.known.black
        matrix = self.calibrated.calibration.camera_to_xyz
        return compare(light, target(), matrix, EXPOSURE, solved.reachable).delta_e00_median


@dataclass(frozen=True, slots=True)
class Outcome:
    seed: int
    kind: str
    before: float
    after: float
    figures: Any

    in_all: bool = False
    """A light is on in every photograph, and off afterwards."""

    @property
    def worse(self) -> bool:
        return self.after > self.before + WORSE and not self.in_all


def refined(seed: int) -> Outcome:
    world = World(seed)
    with tempfile.TemporaryDirectory(prefix="velatura-disturbed-") as folder:
        stage = DisturbedStage(Path(folder))
        stage.in_world(world)
        figures = stage.refine(world.photographs)
        in_all = world.kind == "flash" and world.first == 0 and world.last >= world.taken
        return Outcome(seed, world.kind, stage.left(stage.solved), stage.left(stage.present()), figures, in_all)


def main() -> int:
    count, first = (
        (int(text) for text in (*sys.argv[1:], "200", "0")[:2]) if len(sys.argv) != 2 else (int(sys.argv[1]), 0)
    )
    outcomes = [refined(seed) for seed in range(first, first + count)]
    for one in outcomes:
        if one.worse:
            print(f"seed {one.seed}, {one.kind}: {one.before:.2f} to {one.after:.2f}", one.figures)
    kinds = Counter(one.kind for one in outcomes)
    for kind in KINDS:
        of = [one for one in outcomes if one.kind == kind]
        better = sum(one.after < one.before - WORSE for one in of)
        refused = sum(any("refused" in row for row in one.figures["photographs"]) for one in of)
        print(f"{kind}: {kinds[kind]}, better {better}, refused {refused}, worse {sum(one.worse for one in of)}, "
              f"light in every photograph {sum(one.in_all for one in of)}")  # fmt: skip
    return int(any(one.worse for one in outcomes))


if __name__ == "__main__":
    sys.exit(main())
