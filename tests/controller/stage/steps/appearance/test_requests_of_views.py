"""Appearances that look different from each camera's place, on a run of two cameras."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import skimage.data
from PIL import Image

from controller.core.arrays import FloatImage
from controller.core.colour import D65, reflectance_to_camera, srgb_to_linear
from controller.core.errors import UsageError
from controller.optics.solve.targets.values import Target
from controller.stage.artefacts.calibrated import Calibrated, all_views
from controller.stage.artefacts.geometry import read_geometry_figures
from controller.stage.artefacts.names import write_json
from controller.stage.artefacts.projectors import Light
from controller.stage.artefacts.solved import Registered
from controller.stage.artefacts.views import view_folder
from controller.stage.blender.run import find_blender
from controller.stage.steps.appearance.requests import requests_of
from lab.timings.tools.synthetic import TO_XYZ
from tests.controller.config.test_stage_file import STAGE, load
from tests.controller.stage.blender.test_render import PAINT_SCENE
from tests.controller.stage.two_views import (
    BENT,
    CAMERA,
    NAMES,
    POSES,
    VIEWS,
    Points,
    in_picture,
    on_wall,
    write_two_views,
)

RESTORATION = '\n[[appearances]]\nname = "x"\nkind = "restoration"\nfile = "t.png"\n'
WIDTH_M = 0.5
_ASTRONAUT: Any = skimage.data.astronaut
DEVICE = np.asarray(_ASTRONAUT()[:384], np.uint8)
PICTURE = srgb_to_linear(DEVICE)


def painted(places: Points) -> FloatImage:
    """The picture, faded, on the middle of the wall; grey around it."""
    by = PICTURE.shape[1] / WIDTH_M
    x, y = (np.moveaxis(places, -1, 0)[:2] * by).astype(np.float32)
    soft = cv2.GaussianBlur(PICTURE.astype(np.float32), (0, 0), 1.5)
    laid = cv2.remap(soft, x + PICTURE.shape[1] / 2, y + PICTURE.shape[0] / 2, cv2.INTER_LINEAR, borderValue=(-1,) * 3)
    return np.where(laid < 0, np.float32(0.4), 0.2 + 0.4 * laid).astype(np.float32)


@pytest.fixture
def calibrated(tmp_path: Path) -> Calibrated:
    write_two_views(tmp_path / "run", painted)
    Image.fromarray(DEVICE).save(tmp_path / "t.png")
    return all_views(tmp_path / "run", NAMES)


def shown(target: Target, calibrated: Calibrated, n: int) -> tuple[float, float]:
    """By how much a view's target differs from the picture on the wall, median, and how much of it has one."""
    view, wall = calibrated.views()[n], on_wall(POSES[VIEWS[n]], CAMERA)
    inside = np.all(np.abs(wall[..., :2]) < (0.3 * WIDTH_M, 0.25 * WIDTH_M), axis=-1)
    asked = (painted(wall) - 0.2) / 0.4 @ reflectance_to_camera(D65, TO_XYZ).T
    has = inside & view.part(target.mask)
    return float(np.median(np.abs(view.part(target.image) - asked)[has])), float(has.sum() / inside.sum())


def without_detail(folder: Path) -> None:
    """No feature of the picture is left in what a view saw."""
    for name in NAMES:
        light = Light.read(folder, name)
        soft = np.asarray(cv2.GaussianBlur(light.white, (0, 0), 9), np.float32)
        replace(light, white=soft).write(folder, name)


def test_a_restoration_lies_on_the_object_as_each_camera_sees_it(tmp_path: Path, calibrated: Calibrated) -> None:
    wish = requests_of(load(tmp_path, STAGE + RESTORATION), calibrated)[0]
    for n in range(2):
        off, share = shown(wish.target(), calibrated, n)
        assert off < 0.02
        assert share > 0.95
    said: list[str] = []
    context = SimpleNamespace(folder=calibrated.folder, reporter=SimpleNamespace(say=said.append))
    assert wish.prepare is not None
    wish.prepare(context)  # type: ignore[arg-type]
    assert "by the object's shape" not in said[0]
    for folder in calibrated.folders:
        kept = Registered.read(folder, "x")
        assert kept is not None
        assert kept.residual_px.shape == CAMERA


@pytest.mark.parametrize("points", [False, True])
def test_where_a_view_matches_no_restoration_it_lies_by_the_objects_shape(
    tmp_path: Path, calibrated: Calibrated, points: bool
) -> None:
    text = STAGE + RESTORATION
    if points:
        places = np.array([[0.15, 0.1], [0.15, -0.12], [-0.15, -0.1], [-0.13, 0.14]])
        at_px = (places + np.array([0.25, 0.1875])) * 512 / WIDTH_M
        wall = np.concatenate([places, 1 + BENT * (places**2).sum(axis=1, keepdims=True)], axis=1)
        seen_px = in_picture(wall, POSES["front"], CAMERA)
        text += f"points = {np.hstack([at_px, seen_px]).round(2).tolist()}\n"
    else:
        without_detail(view_folder(calibrated.folder, "side"))
    wish = requests_of(load(tmp_path, text), calibrated)[0]
    for n in range(2):
        off, share = shown(wish.target(), calibrated, n)
        assert off < 0.02
        assert share > 0.9
    said: list[str] = []
    assert wish.prepare is not None
    wish.prepare(SimpleNamespace(folder=calibrated.folder, reporter=SimpleNamespace(say=said.append)))  # type: ignore[arg-type]
    assert "In view side it lies by the object's shape" in said[0]


def test_a_view_that_matches_no_restoration_is_named_where_no_shape_carries_it(
    tmp_path: Path, calibrated: Calibrated
) -> None:
    side = view_folder(calibrated.folder, "side")
    without_detail(side)
    figures = read_geometry_figures(side)
    del figures["from_first"]
    write_json(side / "geometry.json", figures)
    with pytest.raises(UsageError, match="View side: The picture does not fit") as refused:
        requests_of(load(tmp_path, STAGE + RESTORATION), calibrated)
    assert refused.value.code == "restoration-not-matched"


LIT = """
lamp = bpy.data.lights.new("lamp", "POINT")
lamp.energy, lamp.shadow_soft_size = 10, 0.01
place = bpy.data.objects.new("lamp", lamp)
place.location = (0.3, 0.2, 0.2)
bpy.context.scene.collection.objects.link(place)
diffuse = nodes.new("ShaderNodeBsdfDiffuse")
links.new(paint.outputs["Color"], diffuse.inputs["Color"])
links.new(diffuse.outputs["BSDF"], out.inputs["Surface"])
"""
"""In the user's scene: the object in its own paint, under a lamp at its right."""


@pytest.mark.slow
def test_blender_renders_one_scene_for_each_camera(tmp_path: Path, calibrated: Calibrated) -> None:
    blender = find_blender()
    save = "bpy.ops.wm.save_as_mainfile"
    (tmp_path / "make.py").write_text(PAINT_SCENE.replace(save, LIT + save))
    subprocess.run([blender.command[0], str(tmp_path / "make.py"), str(tmp_path / "own.blend")], check=True)
    table = '\n[[appearances]]\nname = "x"\nkind = "blender"\nscene = "own.blend"\nsamples = 8\n'
    wish = requests_of(load(tmp_path, STAGE + table), calibrated)[0]
    assert wish.prepare is not None
    shares: list[float] = []
    context = SimpleNamespace(folder=calibrated.folder, advance=lambda share, note: shares.append(share))
    wish.prepare(context)  # type: ignore[arg-type]
    assert shares == sorted(shares)
    target, (front, side) = wish.target(), calibrated.views()
    at = calibrated.places_in(1, 0)
    assert at is not None
    x, y = np.moveaxis(np.nan_to_num(at, nan=-1), 2, 0)
    there = cv2.remap(np.asarray(front.part(target.image)), x, y, cv2.INTER_LINEAR)
    seen = cv2.remap(front.part(target.mask).astype(np.uint8), x, y, cv2.INTER_NEAREST) > 0
    both = cv2.erode((seen & side.part(target.mask)).astype(np.uint8), np.ones((15, 15), np.uint8)) > 0
    assert both.sum() > 5000
    here = side.part(target.image)
    off = np.abs(here - there)[both].mean(axis=1) / here[both].mean()
    assert np.median(off) < 0.03
    assert here[both].std() > 0.15 * here[both].mean(), "there is something to compare"


def test_a_highlight_that_one_camera_sees_is_no_paint(tmp_path: Path) -> None:
    grey = np.array([0.5, 0.4, 0.3])
    made = []
    for gloss in (0.0, 0.8):
        run = tmp_path / f"{gloss}"
        write_two_views(run, lambda wall: np.broadcast_to(grey, wall.shape).astype(np.float32), gloss)
        together, alone = all_views(run, NAMES), Calibrated(view_folder(run, "side"), NAMES)
        table = '\n[[appearances]]\nname = "x"\nkind = "recolour"\ntint = [1.0, 1.0, 1.0]\n'
        stage = load(tmp_path, STAGE + table)
        side = together.views()[1].part
        targets = side(requests_of(stage, together)[0].target().image), requests_of(stage, alone)[0].target().image
        made.append((side(together.reflectance), alone.reflectance, *targets))
    wall = on_wall(POSES["side"], CAMERA)
    peak = np.hypot(wall[..., 0] + 0.05, wall[..., 1]) < 0.02
    matt, shining = ([np.nanmedian(image[peak]) / np.nanmedian(image) for image in images] for images in made)
    bent = np.array(shining) / matt - 1
    assert bent[[1, 3]].min() > 0.25, "one camera alone takes it for paint"
    assert np.abs(bent[[0, 2]]).max() < 0.06
    for images in list(zip(*made, strict=True))[::2]:
        away = np.hypot(wall[..., 0] + 0.05, wall[..., 1]) > 0.12
        known = away & np.isfinite(images[0][..., 0]) & (images[0][..., 0] > 0)
        assert np.median(np.abs(images[1][known] / images[0][known] - 1)) < 0.02
