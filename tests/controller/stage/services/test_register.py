"""A known mesh is laid on what the camera measured, by itself or by clicks; what does not fit is named.

The measured points are made by trimesh's rays from a camera that is known.
"""

from __future__ import annotations

import functools
import json
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image

from controller.core.arrays import Float64, FloatImage, save_arrays
from controller.core.errors import VelaturaError
from controller.kiosk.api.folder import FolderKiosk
from controller.kiosk.preview.meshes import VIEWER, seen_from
from controller.optics.calibrate.mesh_alignment import Pose, SolidMesh
from controller.run.journal import Journal
from controller.run.progress import Silent
from controller.run.step_id import StepId
from controller.stage.artefacts.geometry import read_geometry
from controller.stage.artefacts.mesh import RegisteredMesh
from controller.stage.services.register import MeshOrder, register
from controller.stage.steps.mesh import carried_mesh
from hal.notices import Level

WIDTH, HEIGHT, FOCAL = 320, 240, 800.0
MATRIX = np.array([[FOCAL, 0, 160.0], [0, FOCAL, 119.0], [0, 0, 1]])
TRUTH = Pose(0.00102, cv2.Rodrigues(np.array([2.1, 0.7, -0.4]))[0].astype(np.float64), np.array([0.01, -0.008, 1.5]))
"""The mesh's file is in millimetres and 2 % too small."""


@functools.cache
def stone() -> Any:
    """A round stone with dents, about 250 units long and like itself in one pose alone."""
    made = trimesh.creation.icosphere(subdivisions=4)
    rng = np.random.default_rng(11)
    ways = rng.normal(size=(9, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    lobes = np.exp(-12 * (1 - made.vertices @ ways.T)) @ rng.uniform(-0.35, 0.45, 9)
    made.vertices = made.vertices * (100 * (1 + lobes))[:, None] * (1.2, 1.0, 0.85)
    return made


def placed(mesh: Any, pose: Pose) -> Any:
    return trimesh.Trimesh(pose.placed(np.asarray(mesh.vertices)), mesh.faces, process=False)


def px_of(points_m: Float64) -> Float64:
    return np.asarray((points_m @ MATRIX.T)[:, :2] / points_m[:, 2:])


@functools.cache
def measured() -> FloatImage:
    """(rows, columns, 3): the stone before a wall, with noise of 0.1 mm; NaN where the light grazes, in a corner."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    rays = np.stack([(x - 160) / FOCAL, (y - 119) / FOCAL, np.ones(x.shape)], axis=2).reshape(-1, 3)
    stood = placed(stone(), TRUTH)
    at, ray, face = stood.ray.intersects_location(np.zeros_like(rays), rays, multiple_hits=False)
    points = rays * 2.0
    points[ray] = at * (1 + 1e-4 / 1.5 * np.random.default_rng(0).standard_normal((len(at), 1)))
    facing = -np.sum(stood.face_normals[face] * rays[ray], axis=1)
    points[ray[facing < 0.25]] = np.nan
    image = points.reshape(HEIGHT, WIDTH, 3).astype(np.float32)
    rows, columns = np.unravel_index(ray, (HEIGHT, WIDTH))
    image[rows.min() : rows.min() + 40, columns.min() : int(columns.mean())] = np.nan
    return image


def write_run(stage: Path, name: str, points_m: FloatImage) -> Path:
    run = stage / "runs" / name
    with Journal(run) as journal:
        journal.complete(StepId("calibrated"), {}, [], began_at_s=time.time())
    normals = np.broadcast_to(np.array([0, 0, -1], np.float32), points_m.shape)
    save_arrays(run / "geometry.npz", {"points_m": points_m, "normals": np.ascontiguousarray(normals)})
    camera = {
        "matrix": MATRIX.tolist(), "distortion": [0.0, 0.0], "rotation": np.eye(3).tolist(),
        "translation_m": [0.0, 0.0, 0.0], "size_px": [WIDTH, HEIGHT],
    }  # fmt: skip
    figures = {"camera": camera, "projectors": {}, "reprojection_rms_px": 0.03, "scale_known": True}
    (run / "geometry.json").write_text(json.dumps(figures))
    return run


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    write_run(tmp_path / "stage", "20260101-000000-calibrate", measured())
    return tmp_path / "stage"


class Said(Silent):
    def __init__(self) -> None:
        self.warnings: list[str] = []

    def say(self, text: str, level: Level = Level.INFO) -> None:
        self.warnings += [text] if level is Level.WARNING else []


def file_of(folder: Path, vertices: Float64, faces: Any = None, name: str = "stone.ply") -> Path:
    trimesh.Trimesh(vertices, stone().faces if faces is None else faces, process=False).export(folder / name)
    return folder / name


def refused(stage: Path, order: MeshOrder) -> VelaturaError:
    with pytest.raises(VelaturaError) as error:
        register(stage, order, Silent())
    assert not list((stage / "runs").glob("*/mesh*")), "nothing is written"
    return error.value


def off_px(stage: Path, factor: float = 1.0) -> Float64:
    """Of each vertex, between the pose that was found and the true one; the file was ``factor`` times as large."""
    mesh = RegisteredMesh.read(next((stage / "runs").glob("*")))
    assert mesh is not None
    vertices = np.asarray(stone().vertices)
    assert mesh.pose.scale * factor == pytest.approx(TRUTH.scale, rel=2e-3)
    return np.asarray(
        np.linalg.norm(px_of(mesh.pose.placed(factor * vertices)) - px_of(TRUTH.placed(vertices)), axis=1)
    )


def test_a_mesh_finds_its_place_by_itself(stage: Path, tmp_path: Path) -> None:
    figures = register(stage, MeshOrder(file_of(tmp_path, np.asarray(stone().vertices), name="stone.glb")), Silent())
    assert np.median(off_px(stage)) < 0.1
    assert "in mm, 0.980" in figures["size"]
    assert figures["map"].is_file()


def clicked(rng: np.random.Generator, vertices: Float64) -> list[list[float]]:
    """Four places that the camera sees, far from each other, each clicked 5 pixels beside."""
    at = TRUTH.placed(np.asarray(stone().vertices))
    px = px_of(at)
    seen = measured()[px[:, 1].round().astype(int), px[:, 0].round().astype(int)]
    seen = np.flatnonzero(np.linalg.norm(seen - at, axis=1) < 2e-3)
    order = seen[np.argsort(np.arctan2(*(px[seen] - px[seen].mean(axis=0)).T))]
    some = [int(part[len(part) // 2]) for part in np.array_split(order, 4)]
    beside = 5 * np.exp(1j * rng.uniform(0, 2 * np.pi, 4))
    return [[*vertices[n], px[n, 0] + one.real, px[n, 1] + one.imag] for n, one in zip(some, beside, strict=True)]


def pairs_file(folder: Path, pairs: Any) -> Path:
    (folder / "pairs.json").write_text(json.dumps(np.asarray(pairs).tolist()))
    return folder / "pairs.json"


def clicks(folder: Path, vertices: Float64) -> Path:
    return pairs_file(folder, clicked(np.random.default_rng(5), vertices))


@pytest.mark.parametrize("seed", range(3))
def test_clicks_that_are_off_by_5_pixels_are_enough(stage: Path, tmp_path: Path, seed: int) -> None:
    vertices = 1.02 * np.asarray(stone().vertices)
    pairs = pairs_file(tmp_path, clicked(np.random.default_rng(seed), vertices))
    register(stage, MeshOrder(file_of(tmp_path, vertices), pairs=pairs), Silent())
    assert np.median(off_px(stage, 1.02)) < 0.1


def test_places_chosen_in_the_panel_lay_a_mesh(stage: Path) -> None:
    kiosk, vertices = FolderKiosk(stage), 1.02 * np.asarray(stone().vertices)
    (stage / "meshes").mkdir()
    file_of(stage / "meshes", vertices)
    assert kiosk.meshes() == ("stone.ply",)
    solid = SolidMesh(vertices, np.asarray(stone().faces, np.int32))
    side = min(range(32), key=lambda one: TRUTH.degrees_from(seen_from(solid, one)))
    chosen = np.array(clicked(np.random.default_rng(2), vertices))
    on_picture = seen_from(solid, side).placed(chosen[:, :3]) @ VIEWER.matrix.T
    on_picture = on_picture[:, :2] / on_picture[:, 2:]
    with Image.open(kiosk.mesh_picture("stone.ply", side)) as picture:
        alpha = np.asarray(picture.getchannel("A"))
    assert alpha[*on_picture.round().astype(int).T[::-1]].all(), "each is on the mesh in its picture"
    assert 0.3 < (alpha > 0).mean() < 0.9
    shares = np.hstack([(on_picture + 0.5) / alpha.shape[::-1], (chosen[:, 3:] + 0.5) / (WIDTH, HEIGHT)])
    kiosk.lay_mesh("stone.ply", side, json.dumps(shares.tolist()))
    assert np.median(off_px(stage, 1.02)) < 0.1
    laid = kiosk.laid_mesh()
    assert laid is not None
    with Image.open(laid.pictures["laid"]) as picture:
        seen = np.asarray(picture.getchannel("A")) > 0
    of_object = np.nan_to_num(measured()[..., 2], nan=2.0) < 1.9
    assert (seen & of_object).sum() > 0.99 * of_object.sum()
    assert seen.sum() < 1.5 * of_object.sum()


@pytest.mark.parametrize("points", ["[[0.5, 0.5]]", "{", "[" * 9000, "[1e999]", '["a"]'])
def test_places_that_are_none_are_named(stage: Path, points: str) -> None:
    (stage / "meshes").mkdir()
    file_of(stage / "meshes", np.asarray(stone().vertices))
    with pytest.raises(VelaturaError) as error:
        FolderKiosk(stage).lay_mesh("stone.ply", 0, points)
    assert error.value.code == "mesh-pairs-file"
    with pytest.raises(VelaturaError) as error:
        FolderKiosk(stage).lay_mesh("stone.ply", 0, json.dumps([[0, 0, 0.5, 0.5]] * 4))
    assert error.value.code == "mesh-pair-beside"


SCANS = sorted((Path(os.environ.get("VELATURA_DATA", "no data")) / "mesh").glob("*.obj"))


if SCANS:  # public scans of VELATURA_DATA: nothing here depends on them

    @pytest.mark.parametrize("file", SCANS, ids=lambda file: file.stem)
    def test_a_public_scan_finds_its_place_by_itself(tmp_path: Path, file: Path) -> None:
        scan: Any = trimesh.load(file, force="mesh", process=False)
        size = float(np.linalg.norm(scan.extents))
        turn, middle = cv2.Rodrigues(np.array([2.8, 0.5, -0.3]))[0].astype(np.float64), scan.bounds.mean(axis=0)
        truth = Pose(0.4 / size, turn, np.array([0.0, 0.0, 1.5]) - 0.4 / size * turn @ middle)
        y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
        rays = np.stack([(x - 160) / FOCAL, (y - 119) / FOCAL, np.ones(x.shape)], axis=2).reshape(-1, 3)
        at, ray, _ = placed(scan, truth).ray.intersects_location(np.zeros_like(rays), rays, multiple_hits=False)
        points = rays * 2.0
        points[ray] = at * (1 + 1e-4 * np.random.default_rng(0).standard_normal((len(at), 1)))
        write_run(tmp_path / "stage", "20260101-000000-calibrate", points.reshape(HEIGHT, WIDTH, 3).astype(np.float32))
        register(tmp_path / "stage", MeshOrder(file), Silent())
        mesh = RegisteredMesh.read(next((tmp_path / "stage" / "runs").glob("*")))
        assert mesh is not None
        vertices = np.asarray(scan.vertices)
        off = np.linalg.norm(px_of(mesh.pose.placed(vertices)) - px_of(truth.placed(vertices)), axis=1)
        assert np.median(off) < 0.3
        assert mesh.pose.scale == pytest.approx(truth.scale, rel=2e-3)


def test_a_mesh_that_is_like_itself_needs_clicks(tmp_path: Path) -> None:
    jar = trimesh.creation.revolve(
        1.6 * np.array([[0, -90], [60, -90], [75, -20], [35, 40], [50, 90], [0, 90]]), sections=90
    )
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    rays = np.stack([(x - 160) / FOCAL, (y - 119) / FOCAL, np.ones(x.shape)], axis=2).reshape(-1, 3)
    at, ray, _ = placed(jar, TRUTH).ray.intersects_location(np.zeros_like(rays), rays, multiple_hits=False)
    points = rays * 2.0
    points[ray] = at
    stage = tmp_path / "stage"
    write_run(stage, "20260101-000000-calibrate", points.reshape(HEIGHT, WIDTH, 3).astype(np.float32))
    file = file_of(tmp_path, np.asarray(jar.vertices), jar.faces)
    assert refused(stage, MeshOrder(file)).code == "mesh-ambiguous"
    some = [
        ray[(np.abs(px_of(at) - place).sum(axis=1)).argmin()]
        for place in ((160, 100), (150, 130), (170, 140), (165, 85))
    ]
    spots = points[some]
    file_places = (spots - TRUTH.shift_m) @ TRUTH.rotation / TRUTH.scale
    pairs = pairs_file(tmp_path, np.hstack([file_places, px_of(spots)]))
    register(stage, MeshOrder(file, pairs=pairs), Silent())
    mesh = RegisteredMesh.read(next((stage / "runs").glob("*")))
    assert mesh is not None
    assert np.abs(px_of(mesh.pose.placed(file_places)) - px_of(spots)).max() < 0.5


def test_a_mesh_of_another_object_is_refused_with_the_place(stage: Path, tmp_path: Path) -> None:
    other = np.asarray(trimesh.creation.icosphere(subdivisions=4).vertices) * (90, 140, 60)
    error = refused(stage, MeshOrder(file_of(tmp_path, other)))
    assert error.code == "mesh-does-not-fit"
    assert "mm off" in error.what
    assert "camera pixel (" in error.what


def test_a_mirrored_mesh_is_named(stage: Path, tmp_path: Path) -> None:
    mirror = np.asarray(stone().vertices) * (1, -1, 1)
    assert refused(stage, MeshOrder(file_of(tmp_path, mirror))).code == "mesh-mirrored"


def test_a_wrong_unit_is_told_with_the_right_one(stage: Path, tmp_path: Path) -> None:
    inches = np.asarray(stone().vertices) / 25.4
    order = MeshOrder(file_of(tmp_path, inches), unit="mm", pairs=clicks(tmp_path, inches))
    error = refused(stage, order)
    assert (error.code, "inch" in error.remedy) == ("mesh-unit-wrong", True)
    assert "in inch" in register(stage, replace(order, unit=None), Silent())["size"]


def test_flipped_faces_and_holes_are_told_and_do_no_harm(stage: Path, tmp_path: Path) -> None:
    vertices, faces = np.asarray(stone().vertices), np.asarray(stone().faces)
    facing = np.linalg.norm(TRUTH.placed(vertices)[faces].mean(axis=1) - TRUTH.shift_m + (0, 0, 0.09), axis=1)
    said = Said()
    register(
        stage,
        MeshOrder(file_of(tmp_path, vertices, faces[facing > 0.035, ::-1]), pairs=clicks(tmp_path, vertices)),
        said,
    )
    assert np.median(off_px(stage)) < 0.1
    assert any("inwards" in text for text in said.warnings)
    assert any("holes" in text for text in said.warnings)
    assert any("no UV" in text for text in said.warnings)


def test_what_is_not_measured_is_filled_only_when_asked_and_only_where_both_agree(stage: Path, tmp_path: Path) -> None:
    run = next((stage / "runs").glob("*"))
    changed = measured().copy()
    changed[110:130, 150:170] *= np.float32(0.98)  # something stands on the object that the mesh does not have
    changed[118:122, 158:162] = np.nan
    write_run(stage, run.name, changed)
    vertices = np.asarray(stone().vertices)
    order = MeshOrder(file_of(tmp_path, vertices), pairs=clicks(tmp_path, vertices))
    said = Said()
    register(stage, order, said)
    assert any("the measurement counts" in text for text in said.warnings)
    np.testing.assert_array_equal(read_geometry(run).points_m, changed)
    filled = register(stage, replace(order, fill=True), Silent())["filled_pixels"]
    points_m, new = read_geometry(run).points_m, ~np.isfinite(changed[..., 2])
    new &= np.isfinite(points_m[..., 2])
    assert filled == np.count_nonzero(new) > 300
    np.testing.assert_array_equal(points_m[~new], changed[~new])
    assert not new[118:122, 158:162].any()
    # the ray of each pixel, by trimesh
    stood, rays = placed(stone(), TRUTH), points_m[new].astype(np.float64)
    at, ray, _ = stood.ray.intersects_location(np.zeros_like(rays), rays, multiple_hits=False)
    assert len(at) > 0.98 * len(rays)
    assert np.percentile(np.linalg.norm(at - rays[ray], axis=1), 95) < 1e-3


def test_a_later_calibration_takes_the_mesh_over(stage: Path, tmp_path: Path) -> None:
    vertices = np.asarray(stone().vertices)
    register(stage, MeshOrder(file_of(tmp_path, vertices), pairs=clicks(tmp_path, vertices)), Silent())
    later = write_run(stage, "20260102-000000-recalibrate", measured() * np.float32(1.005))
    mesh = carried_mesh(later)
    assert mesh is not None
    np.testing.assert_allclose(mesh.pose.shift_m, 1.005 * TRUTH.shift_m, atol=4e-4)
    assert mesh.pose.scale == pytest.approx(1.005 * TRUTH.scale, rel=1e-3)
    again = RegisteredMesh.read(later)
    assert again is not None
    assert again.figures["file"] == "stone.ply"


@pytest.mark.parametrize(
    ("text", "code"),
    [("solid x\nendsolid x\n", "mesh-unreadable"), ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "mesh-no-faces")],
)
def test_a_file_without_a_surface_is_named(stage: Path, tmp_path: Path, text: str, code: str) -> None:
    path = tmp_path / ("a.stl" if "solid" in text else "a.obj")
    path.write_text(text)
    assert refused(stage, MeshOrder(path)).code in (code, "mesh-no-faces")


def test_pairs_that_are_none_are_named(stage: Path, tmp_path: Path) -> None:
    vertices, path = np.asarray(stone().vertices), tmp_path / "pairs.json"
    order = MeshOrder(file_of(tmp_path, vertices), pairs=path)
    assert refused(stage, order).code == "mesh-pairs-file", "it is missing"
    for text in (
        "",
        "[]",
        "[[1, 2, 3], [1, 2, 3], [1, 2, 3]]",
        '{"a": 1}',
        '[["a"], ["b"], ["c"]]',
        "[[1, 2, 3, 4, NaN]]",
    ):
        path.write_text(text)
        assert refused(stage, order).code == "mesh-pairs-file", text
    pairs_file(tmp_path, [[0, 0, 0, 5, 5], [1, 0, 0, 9, 5], [0, 1, 0, 9, 9]])
    assert refused(stage, order).code == "mesh-pair-beside"
    right = clicked(np.random.default_rng(5), vertices)
    pairs_file(tmp_path, right[:2])
    assert refused(stage, order).code == "mesh-pairs-file"
    pairs_file(tmp_path, np.hstack([np.array(right)[:, :3], np.roll(right, 1, axis=0)[:, 3:]]))
    assert refused(stage, order).code in ("mesh-pairs-wrong", "mesh-mirrored")
