"""A stage for the bench and for Mitsuba 3, a renderer by other authors."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from plugins.emulated.core.truth import BenchTruth, Focus, Lens, LightTruth, ObjectTruth, Pose, ProjectorTruth
from plugins.emulated.optics.objects import StageObject, corner_normals
from plugins.emulated.optics.rays import cast
from plugins.emulated.optics.render import Renderer
from plugins.emulated.optics.staging import random_truth

mi = pytest.importorskip("mitsuba")
mi.set_variant("scalar_rgb")

Image = npt.NDArray[np.float32]
CAMERA_PX, PROJECTOR_PX = (160, 120), (36, 28)


def object_of_mesh(mesh: trimesh.Trimesh, colours: npt.NDArray[np.float64]) -> StageObject:
    """A mesh whose colours are interpolated between its vertices."""
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32)
    return StageObject(
        vertices=vertices.astype(np.float32),
        faces=faces,
        normals=corner_normals(vertices, faces),
        paint="corners",
        corner_values=colours.astype(np.float32)[faces],
        texture=np.zeros(0, np.float32),
        parts=np.zeros(1, np.int32),
    )


def ideal_stage(stage_object: StageObject, *, axis_row_px: float = 13.5, aimed_at_y_m: float = 0.0) -> BenchTruth:
    """A stage without anything that Mitsuba's projector has not: sharp, linear, evenly lit, one projector."""
    drawn = random_truth("small", 5, stage_object, ObjectTruth("mesh", "", 5), (0, 0))
    camera = dataclasses.replace(
        drawn.camera,
        pose=facing((0.02, -0.13, -1.0), (0.0, 0.0, 0.0)),
        lens=Lens(CAMERA_PX, 340.0, (79.5, 59.5), (0.0, 0.0)),
        psf_sigma_px=0.0,
        vignetting=0.0,
    )
    light = LightTruth(
        brightness=1.3,
        reference_m=0.9,
        black_level=0.0,
        vignetting=0.0,
        fill_factor=1.0,
        gamma=(1.0, 1.0, 1.0),
        s_curve=(0.0, 0.0, 0.0),
        mixing=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    )
    projector = dataclasses.replace(
        drawn.projectors[0],
        pose=facing((-0.42, -0.16, -0.92), (0.0, aimed_at_y_m, 0.0)),
        lens=Lens(PROJECTOR_PX, 78.0, (17.5, axis_row_px), (0.0, 0.0)),
        focus=Focus(1.0, 0.0, 0.0),
        light=light,
    )
    return dataclasses.replace(drawn, camera=camera, projectors=(projector,), ambient=(0.0, 0.0, 0.0), subsamples=6)


def facing(position: tuple[float, float, float], target: tuple[float, float, float]) -> Pose:
    forward = np.subtract(target, position)
    forward /= np.linalg.norm(forward)
    right = np.cross((0.1, 1.0, 0.0), forward)
    right /= np.linalg.norm(right)
    vector = Rotation.from_matrix(np.stack((right, np.cross(forward, right), forward))).as_rotvec()
    return Pose(position, (float(vector[0]), float(vector[1]), float(vector[2])))


def ours(truth: BenchTruth, stage_object: StageObject, frame: npt.NDArray[np.uint8]) -> Image:
    return Renderer(truth, cast(truth, stage_object, lambda share: None)).light([frame], [1.0])


def mitsubas(truth: BenchTruth, shape: dict[str, Any], frame: npt.NDArray[np.uint8] | Image, finer: int = 1) -> Image:
    """Mitsuba's picture; ``frame``: bytes, or light in a panel whose pixels are ``finer`` by ``finer`` values."""
    return np.array(mi.render(mi.load_dict(scene_of(truth, shape, frame, finer))), dtype=np.float32)


def scene_of(
    truth: BenchTruth, shape: dict[str, Any], frame: npt.NDArray[np.uint8] | Image, finer: int = 1
) -> dict[str, Any]:
    """Mitsuba scales its projector so that a white, facing diffuse plane at z = 1 has the bitmap's radiance.

    Its projector has no lens shift: here it is a taller one, dark below our frame, with its axis in the middle.
    """
    projector: ProjectorTruth = truth.projectors[0]
    light = projector.light
    shape_px = (round(2 * projector.lens.centre_px[1] + 1) * finer, PROJECTOR_PX[0] * finer, 3)
    tall = np.zeros(shape_px, np.float32)
    tall[: len(frame)] = frame / np.float32(255.0) if frame.dtype == np.uint8 else frame
    bitmap = mi.Bitmap(tall)
    return {
        "type": "scene",
        "integrator": {"type": "direct", "bsdf_samples": 0, "emitter_samples": 1},
        "sensor": {
            "type": "perspective",
            "to_world": to_world(truth.camera.pose),
            "fov": field_of_view(truth.camera.lens),
            "fov_axis": "x",
            "near_clip": 0.05,
            "film": {
                "type": "hdrfilm",
                "width": CAMERA_PX[0],
                "height": CAMERA_PX[1],
                "rfilter": {"type": "box"},
                "pixel_format": "rgb",
            },
            "sampler": {"type": "multijitter", "sample_count": 64, "seed": 1},
        },
        "projector": {
            "type": "projector",
            "to_world": to_world(projector.pose),
            "fov": field_of_view(projector.lens),
            "fov_axis": "x",
            "scale": light.brightness * light.reference_m**2,
            "irradiance": {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "nearest"},
        },
        "shape": shape,
    }


def to_world(pose: Pose) -> Any:
    """Mitsuba's devices look along z with x to the left and y up."""
    matrix = np.eye(4)
    matrix[:3, :3] = pose.rotation.T @ np.diag((-1.0, -1.0, 1.0))
    matrix[:3, 3] = pose.position_m
    return mi.ScalarTransform4f(matrix)


def field_of_view(lens: Lens) -> float:
    return float(np.rad2deg(2.0 * np.arctan(0.5 * lens.size_px[0] / lens.focal_px)))


def mitsuba_mesh(stage_object: StageObject, folder: Path) -> dict[str, Any]:
    """The same triangles, corner normals and corner colours, handed over as a file."""
    corners = stage_object.vertices[stage_object.faces].reshape(-1, 3)
    mesh = mi.Mesh("mesh", len(corners), len(stage_object.faces), has_vertex_normals=True)
    mesh.add_attribute("vertex_color", 3, stage_object.corner_values.ravel().tolist())
    values = mi.traverse(mesh)
    values["vertex_positions"] = corners.ravel()
    values["vertex_normals"] = stage_object.normals.ravel()
    values["faces"] = np.arange(len(corners), dtype=np.uint32)
    values.update()
    mesh.write_ply(str(folder / "mesh.ply"))
    colour = {"type": "mesh_attribute", "name": "vertex_color"}
    return {"type": "ply", "filename": str(folder / "mesh.ply"), "bsdf": diffuse(colour)}


def diffuse(reflectance: dict[str, Any]) -> dict[str, Any]:
    return {"type": "twosided", "material": {"type": "diffuse", "reflectance": reflectance}}


def frame_of(seed: int) -> npt.NDArray[np.uint8]:
    width, height = PROJECTOR_PX
    return np.random.default_rng(seed).integers(20, 256, (height, width, 3), dtype=np.uint8)


def inside(found: Image, wanted: Image, around: int = 5) -> npt.NDArray[np.bool_]:
    """Pixels that both call lit, clear of silhouettes and of shadows' edges."""
    lit = (wanted.sum(axis=2) > 0) & (found.sum(axis=2) > 0)
    clear = cv2.erode(lit.astype(np.uint8), np.ones((around, around), np.uint8)) > 0
    assert clear[lit].mean() > 0.5
    return np.asarray(clear)


def relative_rms(found: Image, wanted: Image) -> float:
    """Over lit pixels, relative to their own rms."""
    clear = inside(found, wanted)
    return float(np.sqrt(np.mean((found - wanted)[clear] ** 2) / np.mean(wanted[clear] ** 2)))
