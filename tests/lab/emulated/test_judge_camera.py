"""The judge's camera: from the stage's own place it sees what the stage's camera sees, and it may stand anywhere."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from lab.emulated.judge_camera import JudgeCamera, carried
from plugins.emulated.core.truth import ObjectTruth, write_truth
from plugins.emulated.optics.objects import default_object
from plugins.emulated.optics.rays import project, samples_of
from plugins.emulated.optics.render import Renderer
from plugins.emulated.optics.staging import random_truth
from tests.plugins.emulated.conftest import shrunk


def test_a_carried_camera_has_the_object_in_the_middle_and_comes_back() -> None:
    truth = random_truth("small", 7, default_object(), ObjectTruth("vase-and-bust", "", 7), (0, 0))
    right = carried(truth.camera, 40.0)
    assert right.pose.position_m[0] > 0.5
    assert np.linalg.norm(right.pose.position_m) == pytest.approx(np.linalg.norm(truth.camera.pose.position_m))
    middle = np.zeros((1, 3))
    here, there = (project(one.pose, one.lens, middle)[0] for one in (truth.camera, right))
    assert there == pytest.approx(here, abs=1e-6)
    back = carried(right, -40.0).pose
    assert back.position_m == pytest.approx(truth.camera.pose.position_m)
    assert back.rotation == pytest.approx(truth.camera.pose.rotation)


def test_from_the_stages_own_place_it_sees_what_the_bench_renders(tmp_path: Path) -> None:
    thing = default_object()
    truth = shrunk(random_truth("small", 7, thing, ObjectTruth("vase-and-bust", "", 7), (0, 0)))
    write_truth(tmp_path, truth)
    first = truth.projectors[0]
    white = np.full((first.lens.size_px[1], first.lens.size_px[0], 3), 255, np.uint8)
    seen = JudgeCamera(tmp_path, truth.camera).light({first.name: white})
    black = [np.zeros((one.lens.size_px[1], one.lens.size_px[0], 3), np.uint8) for one in truth.projectors]
    expected = Renderer(truth, samples_of(truth, thing, None, lambda share: None)).light([white, *black[1:]], [1.0] * 3)
    np.testing.assert_allclose(seen, expected, rtol=1e-5, atol=1e-6)
    moved = dataclasses.replace(carried(truth.camera, 25.0))
    assert not np.allclose(JudgeCamera(tmp_path, moved).light({first.name: white}), seen, atol=1e-3)
