"""A ball on a stage with three places, small enough to plan in a second."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from controller.optics.plan.target_object import TargetObject, read_target_object
from controller.optics.plan.values import ProjectorModel


@pytest.fixture(scope="session")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("plan") / "ball.ply"
    trimesh.creation.icosphere(subdivisions=3, radius=2.0).export(path)
    return path


@pytest.fixture(scope="session")
def target_object(ball: Path) -> TargetObject:
    return read_target_object(ball, height_m=0.3, up="+y", front="+z")


@pytest.fixture(scope="session")
def model() -> ProjectorModel:
    return ProjectorModel("xga", (1024, 768), 2000.0, (1.5, 2.5), (0.0, 0.5), 0.02, 0.35)


EYE = np.array([[0.0, 0.0, -2.0]])
