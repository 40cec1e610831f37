"""Light between surfaces against Mitsuba's path tracer, over lit pixels, with its noise taken off."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from hal.errors import DeviceError
from lab.emulated.paths import traced_transfer
from plugins.emulated.core.truth import BenchTruth
from plugins.emulated.optics.indirect.radiosity import scattering_of, transfer_of
from plugins.emulated.optics.indirect.transfers import IndirectTransfers
from plugins.emulated.optics.objects import StageObject
from plugins.emulated.optics.rays import cast
from plugins.emulated.optics.render import Renderer
from tests.plugins.emulated.optics.mitsuba_stage import (
    frame_of,
    ideal_stage,
    inside,
    mi,
    mitsuba_mesh,
    object_of_mesh,
    scene_of,
)

Image = npt.NDArray[np.float64]
pytestmark = pytest.mark.long
SIZE_PX = (80, 60)
BOUNCES = 12
SAMPLES = 256


def corner() -> StageObject:
    """Two walls and a floor in three colours."""
    left, back, right = np.array([(-0.19, 0.0, -0.05), (0.0, 0.0, 0.12), (0.19, 0.0, -0.05)])
    up, low = np.array([0.0, -0.14, 0.0]), np.array([0.0, 0.12, 0.0])
    walls = [(left + up, back + up, back + low, left + low), (back + up, right + up, right + low, back + low)]
    corners = np.concatenate([*walls, (left + low, back + low, right + low, left + low + right - back)])
    faces = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * n for n in range(3)])
    colours = np.repeat([(0.8, 0.3, 0.25), (0.75, 0.75, 0.7), (0.3, 0.6, 0.75)], 4, axis=0)
    found = object_of_mesh(trimesh.Trimesh(corners, faces, process=False), colours)
    flat = np.cross(corners[faces[:, 1]] - corners[faces[:, 0]], corners[faces[:, 2]] - corners[faces[:, 0]])
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    return dataclasses.replace(found, normals=np.repeat(flat[:, None], 3, axis=1).astype(np.float32))


def bowl() -> StageObject:
    """Half a ball, open towards the devices."""
    ball = trimesh.creation.icosphere(4, 0.16)
    half = trimesh.Trimesh(ball.vertices, ball.faces[ball.triangles_center[:, 2] > 0.0], process=False)
    half.remove_unreferenced_vertices()
    return object_of_mesh(half, np.full((len(half.vertices), 3), (0.8, 0.6, 0.4)))


def two_objects() -> StageObject:
    """A ball beside a box, a finger's width apart."""
    ball, box = trimesh.creation.icosphere(4, 0.085), trimesh.creation.box((0.15, 0.2, 0.15))
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec((0.0, 0.5, 0.0)).as_matrix()
    box.apply_transform(turn)
    box.unmerge_vertices()
    ball.apply_translation((-0.09, 0.02, 0.0))
    box.apply_translation((0.11, 0.0, 0.03))
    colours = np.repeat([(0.8, 0.7, 0.3), (0.3, 0.5, 0.8)], [len(ball.vertices), len(box.vertices)], axis=0)
    vertices = np.concatenate([ball.vertices, box.vertices])
    faces = np.concatenate([ball.faces, box.faces + len(ball.vertices)])
    return object_of_mesh(trimesh.Trimesh(vertices, faces, process=False), colours)


def stage_of(stage_object: StageObject) -> BenchTruth:
    truth = ideal_stage(stage_object)
    lens = dataclasses.replace(truth.camera.lens, size_px=SIZE_PX, focal_px=170.0, centre_px=(39.5, 29.5))
    camera = dataclasses.replace(truth.camera, lens=lens)
    return dataclasses.replace(truth, camera=camera, subsamples=8, engine="radiosity")


def path_traced(truth: BenchTruth, shape: dict[str, Any], frame: npt.NDArray[np.uint8], seed: int) -> Image:
    scene = scene_of(truth, shape, frame)
    scene["integrator"] = {"type": "path", "max_depth": BOUNCES, "rr_depth": 100}
    scene["sensor"]["film"] |= {"width": SIZE_PX[0], "height": SIZE_PX[1]}
    scene["sensor"]["sampler"] = {"type": "multijitter", "sample_count": SAMPLES, "seed": seed}
    return np.array(mi.render(mi.load_dict(scene)), dtype=np.float64)


@pytest.mark.slow
@pytest.mark.parametrize(("make", "least_share"), [(corner, 0.15), (bowl, 0.25), (two_objects, 0.01)])
def test_light_that_bounces_is_mitsubas(make: Callable[[], StageObject], least_share: float, tmp_path: Path) -> None:
    stage_object = make()
    truth, frame = stage_of(stage_object), frame_of(4)
    samples = cast(truth, stage_object, lambda share: None)
    engines = (
        transfer_of(truth, scattering_of(stage_object, truth.patches, truth.seed), samples.pixels),
        traced_transfer(truth, stage_object, samples.pixels, lambda share: None),
    )
    direct = Renderer(truth, samples).light([frame], [1.0])
    shape = mitsuba_mesh(stage_object, tmp_path)
    halves = [path_traced(truth, shape, frame, seed) for seed in (1, 2)]
    wanted = (halves[0] + halves[1]) / 2.0
    lit = inside(direct, wanted.astype(np.float32), around=3)
    noise = float(np.mean((halves[0] - halves[1])[lit] ** 2)) / 4.0
    level = float(np.mean(wanted[lit] ** 2))
    assert noise <= 0.015**2 * level
    for transfer in engines:
        found = Renderer(truth, samples, transfer).light([frame], [1.0]).astype(np.float64)
        assert np.mean((found - direct)[lit]) >= least_share * np.mean(wanted[lit])
        assert np.mean((found - wanted)[lit] ** 2) - noise <= 0.02**2 * level
        # Summed over the picture, noise and pixels at edges hardly count.
        assert found[lit].mean() == pytest.approx(wanted[lit].mean(), rel=0.005)


def test_a_mitsuba_that_can_not_run_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "absent.so"))
    stage_object = two_objects()
    truth = dataclasses.replace(stage_of(stage_object), engine="mitsuba")
    with pytest.raises(DeviceError) as refused:
        IndirectTransfers(stage_object, tmp_path).transfer(truth, np.arange(4, dtype=np.int32), print, keep=True)
    assert refused.value.code == "engine-missing"
    assert "radiosity" in refused.value.remedy


def test_what_was_traced_is_kept_for_the_very_same_stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stage_object = two_objects()
    truth = dataclasses.replace(stage_of(stage_object), engine="mitsuba", subsamples=1, paths=4)
    pixels = cast(truth, stage_object, lambda share: None).pixels
    sent = [np.random.default_rng(1).random((28, 36, 3)).astype(np.float32)]
    first = IndirectTransfers(stage_object, tmp_path).transfer(truth, pixels, lambda share: None, keep=True)
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "absent.so"))
    again = IndirectTransfers(stage_object, tmp_path).transfer(truth, pixels, lambda share: None, keep=True)
    assert first is not None
    assert again is not None
    np.testing.assert_array_equal(first.light(sent), again.light(sent))
    assert first.light(sent).max() > 0.0
    with pytest.raises(DeviceError):
        IndirectTransfers(stage_object, tmp_path).transfer(
            dataclasses.replace(truth, paths=5), pixels, lambda share: None, keep=True
        )
