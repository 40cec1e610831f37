"""The bench's optics against Mitsuba 3: same stage, same picture."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from plugins.emulated.core.truth import Focus
from plugins.emulated.optics.rays import cast
from tests.plugins.emulated.optics.mitsuba_stage import (
    diffuse,
    frame_of,
    ideal_stage,
    mi,
    mitsuba_mesh,
    mitsubas,
    object_of_mesh,
    ours,
    relative_rms,
)

TOLERANCE = 0.02
SPHERE = {"type": "sphere", "radius": 0.15, "bsdf": diffuse({"type": "rgb", "value": [0.7, 0.6, 0.5]})}


def test_a_plane_looks_as_in_mitsuba() -> None:
    corners = [(-0.25, -0.2, 0.0), (0.25, -0.2, 0.0), (0.25, 0.2, 0.0), (-0.25, 0.2, 0.0)]
    plane = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    tilt = np.eye(4)
    tilt[:3, :3] = Rotation.from_rotvec((0.35, 0.2, 0.1)).as_matrix()
    plane.apply_transform(tilt)
    stage_object = object_of_mesh(plane, np.full((4, 3), (0.8, 0.5, 0.3)))
    shape = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f(tilt).scale((0.25, 0.2, 1.0)),
        "bsdf": diffuse({"type": "rgb", "value": [0.8, 0.5, 0.3]}),
    }
    truth, frame = ideal_stage(stage_object), frame_of(1)
    assert relative_rms(ours(truth, stage_object, frame), mitsubas(truth, shape, frame)) <= TOLERANCE


def test_a_sphere_looks_as_mitsubas_exact_sphere() -> None:
    ball = trimesh.creation.icosphere(5, 0.15)
    stage_object = object_of_mesh(ball, np.full((len(ball.vertices), 3), (0.3, 0.6, 0.8)))
    shape = {"type": "sphere", "radius": 0.15, "bsdf": diffuse({"type": "rgb", "value": [0.3, 0.6, 0.8]})}
    truth, frame = ideal_stage(stage_object), frame_of(2)
    assert relative_rms(ours(truth, stage_object, frame), mitsubas(truth, shape, frame)) <= TOLERANCE


def test_a_coloured_mesh_that_shades_itself_under_a_shifted_lens_looks_as_in_mitsuba(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(5, 0.15)
    x, y, z = ball.vertices.T
    ball.vertices *= (1.0 + 0.15 * np.sin(50 * x) * np.cos(40 * y) + 0.1 * np.sin(60 * z))[:, None]
    stage_object = object_of_mesh(ball, 0.3 + 0.5 * np.random.default_rng(1).random((len(ball.vertices), 3)))
    truth, frame = ideal_stage(stage_object, axis_row_px=29.5, aimed_at_y_m=0.21), frame_of(3)
    picture = ours(truth, stage_object, frame)
    samples = cast(truth, stage_object, lambda share: None)
    assert 0.05 < np.mean(samples.gain[0] == 0.0) < 0.6, "the mesh must have shadows to compare"
    assert relative_rms(picture, mitsubas(truth, mitsuba_mesh(stage_object, tmp_path), frame)) <= TOLERANCE


def test_blur_fill_factor_response_and_mixing_look_as_in_mitsuba() -> None:
    """Mitsuba shows a finer bitmap: the panel as formulas draw it."""
    finer, sigma_px = 24, 0.45
    ball = trimesh.creation.icosphere(5, 0.15)
    stage_object = object_of_mesh(ball, np.full((len(ball.vertices), 3), (0.7, 0.6, 0.5)))
    ideal = ideal_stage(stage_object)
    light = dataclasses.replace(
        ideal.projectors[0].light,
        black_level=0.01,
        fill_factor=0.6944,
        gamma=(2.2, 2.3, 2.1),
        s_curve=(0.1, 0.2, 0.15),
        mixing=((0.8, 0.1, 0.05), (0.08, 0.85, 0.07), (0.02, 0.1, 0.75)),
    )
    projector = dataclasses.replace(ideal.projectors[0], focus=Focus(1.0, sigma_px, 0.0), light=light)
    truth, frame = dataclasses.replace(ideal, projectors=(projector,)), frame_of(6)
    power = (frame / 255.0) ** light.gamma
    bent = power + np.asarray(light.s_curve) * power * (1.0 - power) * (2.0 * power - 1.0)
    sent = (0.01 + 0.99 * bent) @ np.asarray(light.mixing).T
    pixel = np.zeros((finer, finer, 1))
    pixel[2:-2, 2:-2] = 1.0 / 0.6944
    panel = np.kron(sent, pixel).reshape(len(frame) * finer, -1, 3).astype(np.float32)
    blurred = cv2.GaussianBlur(panel, (0, 0), sigma_px * finer, borderType=cv2.BORDER_CONSTANT)
    wanted = mitsubas(truth, SPHERE, np.asarray(blurred, np.float32), finer)
    assert relative_rms(ours(truth, stage_object, frame), wanted) <= TOLERANCE
