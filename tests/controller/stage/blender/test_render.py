"""A real Blender renders the reconstructed object: in the calibrated view, failing in words, stopped at once."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from controller.core.arrays import FloatImage, Mask, load_arrays
from controller.core.errors import UsageError, WorkError
from controller.optics.calibrate.values import Geometry, Pinhole
from controller.optics.solve.targets.files import read_picture
from controller.stage.blender.job import BUILTIN, RenderSettings, as_seen, own_paint, solid, write_job
from controller.stage.blender.run import Blender, find_blender, render

ROWS, COLUMNS = 90, 140
QUICK = RenderSettings(samples=4, denoise=False, threads=1)
PAINT_SCENE = """
import bpy, sys
bpy.ops.wm.read_factory_settings(use_empty=True)
mesh = bpy.data.meshes.new("stand-in")
body = bpy.data.objects.new("velatura", mesh)
bpy.context.scene.collection.objects.link(body)
material = bpy.data.materials.new("paint that shines")
material.use_nodes = True
nodes, links = material.node_tree.nodes, material.node_tree.links
nodes.clear()
paint, shine = nodes.new("ShaderNodeVertexColor"), nodes.new("ShaderNodeEmission")
paint.layer_name = "reflectance"
out = nodes.new("ShaderNodeOutputMaterial")
links.new(paint.outputs["Color"], shine.inputs["Color"])
links.new(shine.outputs["Emission"], out.inputs["Surface"])
mesh.materials.append(material)
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[1])
"""
"""A user's scene: whatever takes the object's place shines in the object's own paint."""


def ball(k1: float = 0.0) -> tuple[Geometry, FloatImage]:
    """A ball of 20 cm before a camera with a shifted centre and unequal focal lengths; the light of one projector that
    stands where the camera does, on paint that says where it is."""
    matrix = np.array([[400.0, 0, 61.3], [0, 380.0, 50.2], [0, 0, 1]])
    y, x = np.mgrid[0:ROWS, 0:COLUMNS].astype(np.float64)
    distorted = np.stack([(x - matrix[0, 2]) / matrix[0, 0], (y - matrix[1, 2]) / matrix[1, 1]], axis=-1)
    ideal = distorted.copy()
    for _ in range(20):
        ideal = distorted / (1 + k1 * np.sum(ideal**2, axis=-1, keepdims=True))
    ray = np.concatenate([ideal, np.ones((ROWS, COLUMNS, 1))], axis=-1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    centre, radius = np.array([0.02, -0.01, 1.0]), 0.1
    along = ray @ centre
    inside = along**2 - (centre @ centre - radius**2)
    distance = along - np.sqrt(np.where(inside > 0, inside, np.nan))
    points = ray * distance[..., None]
    normals = (points - centre) / radius
    towards = -points
    arrives = np.sum(towards * normals, axis=-1) / np.linalg.norm(towards, axis=-1) ** 3
    paint = np.stack([0.2 + 0.6 * x / COLUMNS, 0.2 + 0.6 * y / ROWS, np.full_like(x, 0.5)], axis=-1)
    light = np.nan_to_num(paint * np.maximum(arrives, 0)[..., None])
    eye = Pinhole(matrix, np.array([k1, 0.0]), np.eye(3), np.zeros(3), (COLUMNS, ROWS))
    geometry = Geometry(eye, (eye,), points.astype(np.float32), normals.astype(np.float32), 0.1, scale_known=True)
    return geometry, light.astype(np.float32)


def known(geometry: Geometry) -> Mask:
    return np.asarray(np.isfinite(geometry.points_m).all(axis=2))


@pytest.fixture(scope="module")
def blender() -> Blender:
    return find_blender()


@pytest.fixture(scope="module")
def paint_scene(tmp_path_factory: pytest.TempPathFactory, blender: Blender) -> Path:
    folder = tmp_path_factory.mktemp("scene")
    (folder / "make.py").write_text(PAINT_SCENE)
    subprocess.run([blender.command[0], str(folder / "make.py"), str(folder / "paint.blend")], check=True, timeout=120)
    return folder / "paint.blend"


def no_progress(share: float, note: str) -> None:
    assert 0 <= share <= 1
    assert note


@pytest.mark.parametrize("k1", [0.0, -0.4])
def test_blender_sees_what_the_calibrated_camera_sees(
    tmp_path: Path, blender: Blender, paint_scene: Path, k1: float
) -> None:
    geometry, light = ball(k1)
    mask = known(geometry)
    write_job(tmp_path, geometry, mask, own_paint(geometry, light), scene=paint_scene, settings=QUICK)
    target = as_seen([read_picture(render(blender, tmp_path, no_progress))], [geometry.camera], [mask])[0]
    y, x = np.mgrid[0:ROWS, 0:COLUMNS]
    facing = mask & (np.sum(geometry.points_m * -geometry.normals, axis=2) > 0.5)
    red, green, blue = target.image[facing].T
    # The paint names its own pixel.
    column = (red / blue * 0.5 - 0.2) / 0.6 * COLUMNS - x[facing]
    row = (green / blue * 0.5 - 0.2) / 0.6 * ROWS - y[facing]
    assert np.abs([np.median(column), np.median(row)]).max() < 0.1
    assert np.sqrt([np.mean(column**2), np.mean(row**2)]).max() < 0.35
    assert not target.image[~mask].any()


MOVED = """
body.keyframe_insert("location", frame=1)
body.location = (5, 0, 0)
body.keyframe_insert("location", frame=1)
body.parent = bpy.data.objects.new("turntable", None)
body.hide_render = True
bpy.context.scene.unit_settings.scale_length = 0.001
bpy.context.scene.view_settings.view_transform = "AgX"
"""
PLAIN = 'bpy.context.scene.view_settings.view_transform = "Standard"\n'
LAMP = """
unit = 1 / bpy.context.scene.unit_settings.scale_length
lamp = bpy.data.lights.new("lamp", "POINT")
lamp.energy, lamp.shadow_soft_size = 10 * unit**2, 0.01 * unit
place = bpy.data.objects.new("lamp", lamp)
place.location = (0.2 * unit, 0, 0.2 * unit)
bpy.context.scene.collection.objects.link(place)
links.new(nodes.new("ShaderNodeBsdfDiffuse").outputs["BSDF"], out.inputs["Surface"])
"""
"""A lamp of one strength on the object, whatever the scene's unit."""
MISSING = """
picture = nodes.new("ShaderNodeTexImage")
picture.image = bpy.data.images.new("wood", 4, 4)
picture.image.source = "FILE"
picture.image.filepath = "/nowhere/wood.png"
"""
SAVE = "bpy.ops.wm.save_as_mainfile"


def told_of(notes: list[tuple[str, str]], name: str, share: float, note: str) -> None:
    notes.append((name, note))


def test_a_scene_that_moves_hides_or_scales_the_placeholder_shows_the_object_where_it_stands_as_bright(
    tmp_path: Path, blender: Blender
) -> None:
    geometry, light = ball()
    mask, seen = known(geometry), []
    notes: list[tuple[str, str]] = []
    for name, changes in (("metres", PLAIN), ("millimetres", MOVED)):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "make.py").write_text(PAINT_SCENE.replace(SAVE, f"{changes}{LAMP}{SAVE}"))
        subprocess.run([blender.command[0], str(folder / "make.py"), str(folder / "own.blend")], check=True)
        write_job(folder, geometry, mask, own_paint(geometry, light), scene=folder / "own.blend", settings=QUICK)
        rendered = render(blender, folder, partial(told_of, notes, name))
        target = as_seen([read_picture(rendered)], [geometry.camera], [mask])[0]
        seen.append(target.image[mask].max(axis=1))
    assert all((one > 0).mean() > 0.95 for one in seen)
    both = (seen[0] > 0) & (seen[1] > 0)
    assert np.median(seen[1][both] / seen[0][both]) == pytest.approx(1, abs=0.02)
    assert {name for name, note in notes if "omitted: view transform" in note} == {"millimetres"}


def test_a_scene_without_its_pictures_is_refused_by_their_name(tmp_path: Path, blender: Blender) -> None:
    geometry, light = ball()
    (tmp_path / "make.py").write_text(PAINT_SCENE.replace(SAVE, f"{MISSING}{SAVE}"))
    subprocess.run([blender.command[0], str(tmp_path / "make.py"), str(tmp_path / "bare.blend")], check=True)
    write_job(
        tmp_path, geometry, known(geometry), own_paint(geometry, light), scene=tmp_path / "bare.blend", settings=QUICK
    )
    with pytest.raises(WorkError, match=r"/nowhere/wood\.png does not exist"):
        render(blender, tmp_path, no_progress)


def test_every_scene_that_comes_along_covers_the_object_and_differs_from_the_others(
    tmp_path: Path, blender: Blender
) -> None:
    geometry, light = ball()
    mask = known(geometry)
    seen = {}
    for name in BUILTIN:
        folder = tmp_path / name
        folder.mkdir()
        write_job(folder, geometry, mask, own_paint(geometry, light), scene=name, settings=QUICK)
        target = as_seen([read_picture(render(blender, folder, no_progress))], [geometry.camera], [mask])[0]
        assert np.isfinite(target.image).all()
        assert target.image.min() >= 0
        assert (target.image[mask].max(axis=1) > 0).mean() > 0.9
        seen[name] = target.image[mask].mean(axis=0) / target.image[mask].mean()
    red_over_blue = {name: colour[0] / colour[2] for name, colour in seen.items()}
    assert red_over_blue["glazed"] < 0.8 < red_over_blue["marble"] < 1.3 < red_over_blue["gold"]


def test_an_object_is_closed_at_its_back_and_stays_a_surface() -> None:
    square = np.array([[0, 2, 1], [1, 2, 3]], np.int32)
    triangles = solid(square, 4)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    directed, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 1).all()
    # each edge is used once in either direction: closed, and turned the same way round everywhere
    assert {tuple(edge) for edge in directed} == {tuple(edge[::-1]) for edge in directed}


def test_a_stop_ends_blender_at_once(tmp_path: Path, blender: Blender) -> None:
    geometry, light = ball()
    mask = known(geometry)
    slow = dataclasses.replace(QUICK, samples=4096)
    write_job(tmp_path, geometry, mask, own_paint(geometry, light), scene="marble", settings=slow)

    class Stopped(Exception):
        pass

    def stop(share: float, note: str) -> None:
        raise Stopped

    with pytest.raises(Stopped):
        render(blender, tmp_path, stop)
    running = [p for p in Path("/proc").glob("[0-9]*/cmdline") if os.fsencode(tmp_path) in _read(p)]
    assert not running
    assert not (tmp_path / "picture.exr").exists()


def test_progress_of_a_large_picture_counts_all_its_parts(tmp_path: Path, blender: Blender, paint_scene: Path) -> None:
    geometry, light = ball()
    settings = dataclasses.replace(QUICK, samples=2)
    write_job(tmp_path, geometry, known(geometry), own_paint(geometry, light), scene=paint_scene, settings=settings)
    job = json.loads((tmp_path / "job.json").read_text())
    job["camera"]["resolution"] = [4096, 1100]  # more than one of Blender's tiles holds
    (tmp_path / "job.json").write_text(json.dumps(job))
    seen: list[tuple[float, str]] = []
    render(blender, tmp_path, lambda share, note: seen.append((share, note)))
    assert [share for share, _ in seen] == sorted(share for share, _ in seen)
    second = [share for share, note in seen if note.startswith("part 2 of 2, sample ")]
    assert 0.5 <= min(second) < 0.6


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:
        return b""


def test_a_scene_that_blender_cannot_open_is_told_in_blenders_words(tmp_path: Path, blender: Blender) -> None:
    geometry, light = ball()
    mask = known(geometry)
    broken = tmp_path / "broken.blend"
    broken.write_bytes(b"not a scene")
    write_job(tmp_path, geometry, mask, own_paint(geometry, light), scene=broken, settings=QUICK)
    with pytest.raises(WorkError, match="did not render the target") as raised:
        render(blender, tmp_path, no_progress)
    assert raised.value.code == "blender-failed"
    assert "rror" in raised.value.what


def test_an_object_without_shape_is_refused_before_blender_starts(tmp_path: Path) -> None:
    geometry, light = ball()
    nowhere = dataclasses.replace(geometry, points_m=np.full_like(geometry.points_m, np.nan))
    with pytest.raises(WorkError, match="shape") as raised:
        write_job(
            tmp_path, nowhere, np.ones((ROWS, COLUMNS), bool), light,
            scene="gold", settings=QUICK,
        )  # fmt: skip
    assert raised.value.code == "target-no-geometry"


def test_a_blender_that_is_named_and_not_there_is_said_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VELATURA_BLENDER", "/nowhere/blender")
    with pytest.raises(UsageError, match="VELATURA_BLENDER names /nowhere/blender") as raised:
        find_blender()
    assert raised.value.code == "blender-missing"


def test_the_objects_own_paint_is_found_whatever_the_light(tmp_path: Path) -> None:
    geometry, light = ball()
    mask = known(geometry)
    write_job(tmp_path, geometry, mask, own_paint(geometry, light), scene="lowered-head", settings=QUICK)
    found = load_arrays(tmp_path / "mesh.npz")
    front = len(found["reflectance"]) // 2
    u, v = found["uv"][:front].T
    ratio = found["reflectance"][:front]
    column, row = u * COLUMNS - 0.5, (1 - v) * ROWS - 0.5
    expected = np.stack([0.2 + 0.6 * column / COLUMNS, 0.2 + 0.6 * row / ROWS], axis=1) / 0.5
    paler_than_the_scale = (ratio > 0.949).any(axis=1)
    assert paler_than_the_scale.mean() < 0.05
    assert np.abs(ratio[:, :2] / ratio[:, 2:] - expected)[~paler_than_the_scale].max() < 1e-3
