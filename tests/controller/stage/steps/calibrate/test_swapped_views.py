"""Cameras that were swapped or turned are named; a camera that only sees other light is not."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from controller.core.arrays import FloatImage
from controller.stage.artefacts.names import write_json
from controller.stage.artefacts.projectors import Light
from controller.stage.steps.calibrate.drift import swapped_views


def scene(seed: int, size: tuple[int, int] = (90, 120)) -> FloatImage:
    """(rows, columns, 3): an object in soft light before a dark room."""
    noise = np.random.default_rng(seed).random((*size, 1), np.float32)
    soft = cv2.GaussianBlur(noise, (0, 0), 5.0)[..., None]
    return np.repeat((soft - soft.min()) / np.ptp(soft), 3, axis=2).astype(np.float32)


def view(folder: Path, white: FloatImage) -> Path:
    folder.mkdir(parents=True)
    write_json(folder / "geometry.json", {"projectors": {"left": {}}})
    identity = np.eye(3)
    Light(np.zeros((3, 256)), identity, white, np.zeros_like(white), identity).write(folder, "left")
    return folder


@pytest.fixture
def before(tmp_path: Path) -> dict[str, Path]:
    return {name: view(tmp_path / "before" / name, scene(n)) for n, name in enumerate(("back", "front", "side"))}


def now(tmp_path: Path, **whites: FloatImage) -> dict[str, Path]:
    return {name: view(tmp_path / "now" / name, white) for name, white in whites.items()}


def test_cameras_in_their_places_are_not_named_with_less_light_and_another_size(
    tmp_path: Path, before: dict[str, Path]
) -> None:
    larger = cv2.resize(scene(1), (240, 180), interpolation=cv2.INTER_LINEAR).astype(np.float32)
    assert swapped_views(now(tmp_path, back=0.7 * scene(0), front=larger), before) == []


def test_two_swapped_cameras_are_named_once(tmp_path: Path, before: dict[str, Path]) -> None:
    (said,) = swapped_views(now(tmp_path, back=scene(1), front=scene(0), side=scene(2)), before)
    assert "views back and front are swapped" in said


def test_a_camera_that_is_upside_down_is_named(tmp_path: Path, before: dict[str, Path]) -> None:
    (said,) = swapped_views(now(tmp_path, back=scene(0), front=scene(1)[::-1, ::-1].copy()), before)
    assert "view front is upside down" in said


def test_nothing_is_said_of_the_only_camera(tmp_path: Path, before: dict[str, Path]) -> None:
    assert swapped_views(now(tmp_path, front=scene(1)[::-1, ::-1].copy()), before) == []


def test_another_object_and_a_new_view_are_neither(tmp_path: Path, before: dict[str, Path]) -> None:
    assert swapped_views(now(tmp_path, back=scene(7), front=scene(8), new=scene(0)), before) == []
