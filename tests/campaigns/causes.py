"""Causes that a refining names: none that is not so, over stages where nothing changed and where something did.

    python -m tests.campaigns.causes 80 [SEED]

Three appearances are refined through their steps on a stage of models. Every second stage is as it was calibrated; on
the others a lamp, a response, the room's light, light that comes back, or the focus is another, or persons, hands,
flashes and bumps disturb. Prints every cause that is named and is not so; ends with 1 if these are more than 2 %.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from controller.config.defaults import SMOOTHNESS
from controller.core.arrays import ByteImage, FloatImage
from controller.optics.solve.bounded.solver import solve_bounded
from controller.run.journal import Journal
from controller.run.runner import Runner
from controller.stage.artefacts.solved import Solved
from controller.stage.steps.appearance.refining import RefineOptions, refine_steps
from controller.stage.steps.appearance.solving import device_frames
from hal.deadline import in_seconds
from tests.campaigns.disturbances import DisturbedStage, World
from tests.controller.stage.steps.appearance.test_refining import CAMERA, EXPOSURE, NAMES

KINDS: Final = (
    "lamp", "response", "room", "indirect", "focus", "person", "body", "hand", "flash", "flicker", "bump",
)  # fmt: skip
MOST_WRONG: Final = 0.02
TITLES: Final = {"gold": "Gold", "marble": "Marble", "wood": "Wood"}
SMALL: Final = 0.005
"""A change of light by less is none."""


class ChangedWorld(World):
    """What is so of a stage: ``kind`` "nothing", or one of ``KINDS``."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.kind = "nothing" if seed % 2 == 0 else KINDS[seed // 2 % len(KINDS)]
        rng = np.random.default_rng(1000 + seed)
        self.gains, self.indirect, self.exponent, self.blur_px = np.ones(2), 0.0, 1.0, 0.0
        self.room = np.zeros(3)
        if self.kind == "lamp":
            self.gains[self.projector], self.kind = rng.choice([rng.uniform(0.6, 0.97), rng.uniform(1.03, 1.2)]), "dim"
        elif self.kind == "response":
            self.exponent = 1 + float(rng.choice([-1, 1]) * rng.uniform(0.03, 0.12))
        elif self.kind == "room":
            self.room = rng.uniform(0.3, 1, 3) * rng.uniform(0.01, 0.06)
        elif self.kind == "indirect":
            self.indirect = float(rng.uniform(0.02, 0.1))
        elif self.kind == "focus":
            self.blur_px = float(rng.uniform(0.6, 1.5))

    def seen(self, parts: Sequence[FloatImage], exposure: int | None) -> FloatImage:
        light = super().seen(parts, exposure)
        across = np.linspace(0.6, 1.4, light.shape[1])[None, :, None]
        light = light + (EXPOSURE * self.room * across).astype(np.float32)
        return np.asarray(cv2.GaussianBlur(light, (0, 0), self.blur_px) if self.blur_px else light, np.float32)

    def so(self, cause: dict[str, Any]) -> bool:
        """Whether a cause, as ``causes.json`` has it, is one of this world."""
        amount = cause["amount"]
        if cause["kind"] == "brightness":
            change = self.gains[NAMES.index(cause["projector"])] - 1
            return bool(abs(change) > SMALL and change * amount > 0)
        changes = {
            "response": (self.exponent - 1) * (cause["projector"] == NAMES[self.projector]),
            "indirect": self.indirect, "ambient": float(self.room.max()), "focus": self.blur_px,
        }  # fmt: skip
        return bool(abs(changes[cause["kind"]]) > SMALL and changes[cause["kind"]] * amount > 0)


class AskedStage(DisturbedStage):
    """Three appearances of different brightness, pattern and colour."""

    def __post_init__(self) -> None:
        super().__post_init__()
        y, x = np.mgrid[0 : CAMERA[0], 0 : CAMERA[1]].astype(np.float32)
        waves = {"marble": 0.3 + 0.15 * np.sin(x / 7) * np.sin(y / 5), "wood": 0.15 + 0.35 * (y > 35)}
        for (name, wave), tint in zip(waves.items(), ((0.6, 1.0, 0.9), (0.9, 0.7, 1.0)), strict=True):
            wanted = np.asarray(EXPOSURE * wave[..., None] * np.array(tint), np.float32)
            found = solve_bounded(self.calibrated.transport, wanted, self.calibrated.calibration.black).frames
            Solved(
                device_frames(self.calibrated.calibration, found), dict(zip(NAMES, found, strict=True)), wanted,
                self.solved.reachable, {"name": name, "title": TITLES[name], "exposure": EXPOSURE},
            ).write(self.calibrated.folder, name)  # fmt: skip

    def _parts(self, shown: Sequence[ByteImage]) -> list[FloatImage]:
        known, parts, world = self.camera.known, [], self.world
        for n, (part, frame) in enumerate(zip(known.projectors, shown, strict=True)):
            linear = np.stack([part.radiometry.response[c][frame[..., c]] for c in range(3)], -1).astype(np.float32)
            bent = world.exponent if isinstance(world, ChangedWorld) and n == world.projector else 1.0
            parts.append(self.camera.transport.forward_part(n, linear ** np.float32(bent)))
        return parts

    def causes(self) -> list[dict[str, Any]]:
        folder = self.folder / "runs" / "20260102-100000-refine"
        options = RefineOptions(1, SMOOTHNESS, 4.0)
        with Journal(folder) as journal:
            steps = refine_steps(self.rig, self.calibrated, TITLES, options)
            Runner(steps, journal, reporter=self.told).run("refine", deadline=in_seconds(300))
        return list(json.loads((folder / "causes.json").read_text())["causes"])


@dataclass(frozen=True, slots=True)
class Named:
    """``wrong`` of the causes that were ``named`` on the stage of a seed."""

    seed: int
    kind: str
    named: list[dict[str, Any]] = field(default_factory=list)
    wrong: list[dict[str, Any]] = field(default_factory=list)


def named(seed: int) -> Named:
    world = ChangedWorld(seed)
    with tempfile.TemporaryDirectory(prefix="velatura-causes-") as folder:
        stage = AskedStage(Path(folder))
        stage.in_world(world)
        found = stage.causes()
    return Named(seed, world.kind, found, [cause for cause in found if not world.so(cause)])


def main() -> int:
    count, first = (int(text) for text in [*sys.argv[1:], *("80", "0")[len(sys.argv) - 1 :]])
    wrong = 0
    kinds: dict[str, list[Named]] = {}
    for seed in range(first, first + count):
        one = named(seed)
        kinds.setdefault(one.kind, []).append(one)
        wrong += bool(one.wrong)
        for cause in one.wrong:
            print(f"seed {seed}, {one.kind}: {cause['kind']} {cause['projector']} {cause['colour']} "
                  f"{100 * cause['amount']:+.1f} %", flush=True)  # fmt: skip
    for kind, all_of in sorted(kinds.items()):
        print(f"{kind}: {len(all_of)}, named {sum(bool(one.named) for one in all_of)}, "
              f"wrong {sum(bool(one.wrong) for one in all_of)}")  # fmt: skip
    print(f"wrong: {wrong} of {count}")
    return int(wrong > MOST_WRONG * count)


if __name__ == "__main__":
    sys.exit(main())
