"""A stage smaller than any that the bench offers, whose light is the same in every life: for kills and for faults.

    python -m tests.campaigns.mini_stage STAGE [EXPOSURES]

serves its devices. A photograph's noise follows from what it shows and from how many photographs the run's journal
holds, so that one which is taken again after a kill is the same to the byte. Every exposure is a line of the file
EXPOSURES, and every strike that a real lamp would not have borne.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import sqlite3
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

import numpy as np
import numpy.typing as npt

from controller import demo as demo_stage
from plugins.emulated import bench
from plugins.emulated.core.shot import ShotFiles, ShotSettings
from plugins.emulated.optics import staging, world
from plugins.emulated.optics.layout import Stands
from plugins.emulated.optics.staging import Size
from plugins.emulated.optics.world import World
from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase, LampTiming

MINI: Final = Size((116, 88), (324, 216), 2)
PROJECTORS: Final = 2
TIME_SCALE: Final = 0.02
APPEARANCE: Final = "checkerboard"


def prepare_mini(out: Path, seed: int = 3, *, thing: str | None = None, projectors: int = PROJECTORS) -> Path:
    """The stage folder ``out/stage``: short exposures, and one appearance, or those of the built-in ``thing``."""
    its_bench = bench.EmulatedBench(Stands(projectors), built_in=thing)
    sizes = patch.object(staging, "SIZES", {**staging.SIZES, "mini": MINI})
    with sizes, patch.object(demo_stage, "bench_of", lambda folder, settings: its_bench):
        stage = demo_stage.prepare(out, demo_stage.DemoStage("mini", seed, thing, "dark", projectors))
    truth, known = stage / "bench.toml", stage / "stage.toml"
    truth.write_text(truth.read_text().replace("time_scale = 0.25", f"time_scale = {TIME_SCALE}"))
    if thing is not None:
        return stage
    head = known.read_text().partition("\n[[appearances]]")[0].rpartition("\n#")[0]
    table = f'[capture]\nsettle_s = 0.05\n\n[[appearances]]\nname = "{APPEARANCE}"\nkind = "checkerboard"\n'
    known.write_text(f"{head}\n\n{table}")
    return stage


def taken(stage: Path) -> int:
    """How many photographs the stage's journals hold."""
    count = 0
    for journal in (stage / "runs").glob("*/journal.sqlite"):
        opened = contextlib.closing(sqlite3.connect(f"file:{journal}?mode=ro", uri=True, timeout=5.0))
        with contextlib.suppress(sqlite3.OperationalError), opened as database:
            count += int(database.execute("SELECT count(*) FROM shots").fetchone()[0])
    return count


class SteadyWorld(World):
    """Whose noise is a function of what is photographed; ``exposures``: a file, or None."""

    exposures: Path | None = None

    def __init__(self, stage: Path, *arguments: Any, **settings: Any) -> None:
        super().__init__(stage, *arguments, **settings)
        self._folder = stage

    def _files(self, light: npt.NDArray[np.float32], settings: ShotSettings, taken_at: str) -> ShotFiles:
        count, digest = taken(self._folder), hashlib.blake2b(light.tobytes(), digest_size=8).hexdigest()
        self._rng = np.random.default_rng([int(digest, 16), round(1e6 * settings.exposure_s), count])
        note({"taken": count, "light": digest, "exposure_s": settings.exposure_s})
        return super()._files(light, settings, taken_at)


class HonestLamp(EmulatedLamp):
    """Tells what it should not have been asked to do."""

    def __init__(self, timing: LampTiming) -> None:
        super().__init__(timing)
        self.told: Callable[[str], None] = lambda sin: note({"sin": sin})

    def strike(self) -> bool:
        if self.phase is LampPhase.COOLING:
            self.told("struck while it cooled")
        return super().strike()


def note(record: dict[str, Any]) -> None:
    """A line of the file, at once."""
    if SteadyWorld.exposures is not None:
        with SteadyWorld.exposures.open("a", encoding="utf-8") as lines:
            lines.write(json.dumps(record) + "\n")


def serve(stage: Path, exposures: Path | None) -> int:
    """The devices, until a signal."""
    SteadyWorld.exposures = exposures
    vars(bench).update(EmulatedLamp=HonestLamp)
    vars(world).update(World=SteadyWorld)
    return bench.EmulatedBench().serve(stage, json_lines=True)


if __name__ == "__main__":
    sys.exit(serve(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else None))
