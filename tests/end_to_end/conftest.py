"""What several of these tests share, because it costs a minute: a finished demo, and a stage that was prepared."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from tests.end_to_end.program import Command, Outcome, asked, lamps, processes_on, run_of, shots, velatura


@dataclass(frozen=True, slots=True)
class FinishedDemo:
    """A demo that was stopped once, while it solved, and then went on to its end.

    ``shots_then``, ``lamps_then``, ``last_event_then`` and ``processes_then``: what it had left when it was stopped.
    """

    out: Path
    stopped: Outcome
    shots_then: dict[str, float]
    lamps_then: dict[str, bool]
    last_event_then: str
    processes_then: list[str]
    ended: Outcome

    @property
    def stage(self) -> Path:
        return self.out / "stage"


@pytest.fixture(scope="session")
def finished_demo(tmp_path_factory: pytest.TempPathFactory) -> FinishedDemo:
    out = tmp_path_factory.mktemp("demo") / "out"
    stage = out / "stage"
    with Command("demo", "--out", out) as demo:
        demo.wait_for("Solving A checkerboard")
        stopped = demo.interrupt()
    run = run_of(stage)
    (last_event,) = asked(run, "SELECT text FROM events ORDER BY id DESC LIMIT 1")
    then = shots(run), lamps(stage), str(last_event[0]), processes_on(stage)
    return FinishedDemo(out, stopped, *then, velatura("demo", "--out", out))


@pytest.fixture(scope="session")
def prepared_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that ``velatura demo --prepare-only`` wrote; to be copied, not to be touched."""
    out = tmp_path_factory.mktemp("prepared") / "out"
    outcome = velatura("demo", "--prepare-only", "--out", out)
    assert outcome.code == 0
    return out


@pytest.fixture
def prepared(prepared_once: Path, tmp_path: Path) -> Path:
    """A stage folder, fresh for each test."""
    return Path(shutil.copytree(prepared_once / "stage", tmp_path / "out" / "stage"))


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
