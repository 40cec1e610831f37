"""What several of these tests share, because it costs a minute: a finished demo, and a stage that was prepared."""

from __future__ import annotations

import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.end_to_end.kernel_copy import compiled_calls, kernels_of_the_tables
from tests.end_to_end.kiosk import with_ports_of_its_own
from tests.end_to_end.program import Command, Outcome, asked, lamps, processes_on, run_of, shots, velatura
from tests.shared import made_once


@dataclass(frozen=True, slots=True)
class FinishedDemo:
    """A demo that was stopped once, while it solved, and then went on to its end. All workers share it: copy its stage.

    ``shots_then``, ``lamps_then``, ``last_event_then`` and ``processes_then``: what it had left when it was stopped.
    ``compiled``: calls of kernels that it compiled itself, because the tables of kernels lack them.
    """

    out: Path
    stopped: Outcome
    shots_then: dict[str, float]
    lamps_then: dict[str, bool]
    last_event_then: str
    processes_then: list[str]
    compiled: list[str]
    ended: Outcome

    @property
    def stage(self) -> Path:
        return self.out / "stage"


@pytest.fixture(scope="session")
def finished_demo(tmp_path_factory: pytest.TempPathFactory) -> FinishedDemo:
    folder, kept = made_once(tmp_path_factory, "demo", finish_a_demo)
    kept |= {name: Outcome(**kept[name]) for name in ("stopped", "ended")}
    return FinishedDemo(folder / "out", **kept)


def finish_a_demo(folder: Path) -> dict[str, Any]:
    """All that ``FinishedDemo`` has but its folder, ``out`` in ``folder``."""
    out, cache = folder / "out", folder / "cache"
    kernels, stage = cache / "kernels", out / "stage"
    kernels.mkdir(parents=True)
    kernels_of_the_tables(kernels)
    compiled, environment = compiled_calls(kernels), {"VELATURA_CACHE": str(cache)}
    with Command("demo", "--out", out, more=environment) as demo:
        demo.wait_for("Solving A checkerboard")
        stopped = demo.interrupt()
    run = run_of(stage)
    (last_event,) = asked(run, "SELECT text FROM events ORDER BY id DESC LIMIT 1")
    return {
        "stopped": asdict(stopped),
        "shots_then": shots(run),
        "lamps_then": lamps(stage),
        "last_event_then": str(last_event[0]),
        "processes_then": processes_on(stage),
        "ended": asdict(Command("demo", "--out", out, more=environment).outcome()),
        "compiled": sorted(compiled_calls(kernels) - compiled),
    }


@pytest.fixture(scope="session")
def prepared_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that ``velatura demo --prepare-only --room dark`` wrote; to be copied, not to be touched.

    In the dark a bench is ready at once: for tests that are not about light.
    """

    def prepare(folder: Path) -> None:
        assert velatura("demo", "--prepare-only", "--room", "dark", "--out", folder / "out").code == 0

    folder, _ = made_once(tmp_path_factory, "prepared", prepare)
    return folder / "out"


@pytest.fixture
def prepared(prepared_once: Path, tmp_path: Path) -> Path:
    """A stage folder, fresh for each test."""
    return with_ports_of_its_own(Path(shutil.copytree(prepared_once / "stage", tmp_path / "out" / "stage")))


@pytest.fixture(scope="session")
def bumpy_ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A mesh file that is no object of ours."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
    x, y, z = ball.vertices.T
    ball.vertices *= (1 + 0.08 * np.sin(5 * x) * np.cos(4 * y) + 0.05 * np.sin(7 * z))[:, None]
    path = tmp_path_factory.mktemp("mesh") / "bumpy ball.obj"
    ball.export(path)
    return path
