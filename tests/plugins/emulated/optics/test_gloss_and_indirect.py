"""Highlights and light that comes back: what they add to the picture, and where."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import trimesh

from hal.errors import DeviceError
from lab.emulated.bumps import bumped, read_bumps
from plugins.emulated.bench import EmulatedBench
from plugins.emulated.core.truth import BUMPS_FILE, BenchTruth
from plugins.emulated.optics.objects import StageObject, load_object
from plugins.emulated.optics.rays import cast, directions
from plugins.emulated.optics.render import Renderer

Changes = list[Mapping[str, Any]]


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> StageObject:
    path = tmp_path_factory.mktemp("ball") / "ball.ply"
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
    mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=np.full((len(mesh.vertices), 4), 128, np.uint8))
    mesh.export(path)
    return load_object(path)


def white(truth: BenchTruth) -> list[npt.NDArray[np.uint8]]:
    return [np.full((*p.lens.size_px[::-1], 3), 255, np.uint8) for p in truth.projectors]


def seen(truth: BenchTruth, stage_object: StageObject, levels: list[float]) -> npt.NDArray[np.float64]:
    image = Renderer(truth, cast(truth, stage_object, lambda share: None)).light(white(truth), levels)
    return np.asarray(image, np.float64)


def sharp(truth: BenchTruth) -> BenchTruth:
    return dataclasses.replace(truth, camera=dataclasses.replace(truth.camera, psf_sigma_px=0.0))


def test_a_highlight_is_where_the_ball_mirrors_the_lens_into_the_camera_and_white(
    tiny_truth: BenchTruth, ball: StageObject
) -> None:
    truth = sharp(tiny_truth)
    glossy = dataclasses.replace(truth, object=dataclasses.replace(truth.object, gloss=0.1, gloss_exponent=200.0))
    added = seen(glossy, ball, [1.0, 0.0, 0.0]) - seen(truth, ball, [1.0, 0.0, 0.0])
    assert added.min() >= -1e-6
    y, x = np.unravel_index(int(added.sum(axis=2).argmax()), added.shape[:2])
    camera = truth.camera
    ray = directions(camera.pose, camera.lens, np.array([float(x)]), np.array([float(y)]))[0]
    eye, radius = np.asarray(camera.pose.position_m), 0.15
    along = -(eye @ ray) - np.sqrt((eye @ ray) ** 2 - eye @ eye + radius**2)
    point = eye + along * ray
    towards = [place - point for place in (eye, np.asarray(truth.projectors[0].pose.position_m))]
    half = sum(part / np.linalg.norm(part) for part in towards)
    angle = np.degrees(np.arccos(half @ point / np.linalg.norm(half) / np.linalg.norm(point)))
    assert angle < 4.0  # a pixel of this tiny camera is about two degrees of the ball
    plain = seen(truth, ball, [1.0, 0.0, 0.0])
    share = added[y, x] / plain[y, x]
    np.testing.assert_allclose(share, share.mean(), rtol=0.01)
    small = added.sum(axis=2) > 0.1 * added.sum(axis=2).max()
    assert np.count_nonzero(small) < 0.1 * np.count_nonzero(plain.sum(axis=2))
    assert not (seen(glossy, ball, [0.0] * 3) - seen(truth, ball, [0.0] * 3)).any()


def test_light_that_comes_back_adds_its_share_evenly_where_nothing_shines_too(
    tiny_truth: BenchTruth, ball: StageObject
) -> None:
    truth = sharp(tiny_truth)
    returning = dataclasses.replace(truth, indirect=0.01)
    direct, more = (seen(one, ball, [1.0, 0.0, 0.0]) for one in (truth, returning))
    dark = seen(truth, ball, [0.0] * 3)
    added = more - direct
    shaded = (direct - dark).sum(axis=2) < 1e-4
    lit = dark.sum(axis=2) > 0
    ratio = added[lit] / dark[lit]
    np.testing.assert_allclose(ratio, np.broadcast_to(ratio.mean(axis=0), ratio.shape), rtol=0.01)
    assert added[shaded & lit].min() > 0
    light = (direct - dark).sum() / dark.sum() * np.mean(truth.ambient)
    assert added.sum() / dark.sum() * np.mean(truth.ambient) == pytest.approx(0.01 * light, rel=0.1)


def test_a_bench_is_disturbed_and_mended(tmp_path: Path) -> None:
    bench = EmulatedBench()
    bench.prepare(tmp_path, size="small", object_file=None, seed=2)
    from plugins.emulated.core.truth import read_truth

    truth = read_truth(tmp_path)
    changes: Changes = [
        {"what": "projector", "name": "left", "gamma": 1.1, "defocus_mm": 30.0, "flicker": 0.02, "shadow": 0.15},
        {"what": "projector", "name": "left", "white_segment": 0.25, "misconverged_px": 0.5},
        {"what": "camera", "noise": 3.0},
        {"what": "object", "gloss": 0.05},
        {"what": "ambient", "indirect": 0.01},
    ]
    bench.disturb(tmp_path, changes)
    now = bumped(truth, read_bumps(tmp_path / BUMPS_FILE, truth))
    before, after = truth.projectors[0], now.projectors[0]
    assert after.light.gamma == pytest.approx([1.1 * value for value in before.light.gamma])
    assert after.focus.distance_m == pytest.approx(before.focus.distance_m + 0.03)
    assert (after.lamp.flicker, after.light.shadow, after.light.white_segment) == (0.02, 0.15, 0.25)
    assert after.panels.shift_px == ((0.5, 0.0), (0.0, 0.0), (0.0, 0.5))
    assert now.projectors[1:] == truth.projectors[1:]
    assert now.camera.sensor.noise == 3.0
    assert (now.object.gloss, now.indirect) == (0.05, 0.01)
    bench.disturb(tmp_path, ())
    assert bumped(truth, read_bumps(tmp_path / BUMPS_FILE, truth)) == truth


@pytest.mark.parametrize(
    "change", [{"what": "wall"}, {"what": "projector", "name": "nobody"}, {"what": "camera", "colour": 1}, {}]
)
def test_a_change_that_the_bench_does_not_know_is_refused_and_changes_nothing(
    tmp_path: Path, change: Mapping[str, Any]
) -> None:
    bench = EmulatedBench()
    bench.prepare(tmp_path, size="small", object_file=None, seed=2)
    with pytest.raises(DeviceError) as refused:
        bench.disturb(tmp_path, [change])
    assert refused.value.code == "bumps-wrong"
    assert not (tmp_path / BUMPS_FILE).exists()
