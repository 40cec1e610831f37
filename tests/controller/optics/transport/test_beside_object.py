"""Light that would fall beside the object: which projector pixels make it, and that no solve uses them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.core.arrays import FloatImage, Mask
from controller.optics.calibrate.values import Calibration, Metapixels, PhaseMap, ProjectorCalibration, Radiometry
from controller.optics.solve.bounded.equations import SolveSettings
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.transport import build_transport
from controller.optics.transport.factory import beside_object

CAMERA, PIXELS = (90, 120), (30, 40)
TIMES = 3
"""Camera pixels along a projector pixel."""


def flat_stage(middle: tuple[int, int], radius: int, room: float) -> Calibration:
    """A round object before a wall, seen and lit from the front; its border has pixels with the wall's places.

    ``room``: the wall's albedo; the object's is 0.6. The wall's places begin 7 projector pixels away from the object's:
    between them is what the object hides from the camera.
    """
    y, x = np.mgrid[0 : CAMERA[0], 0 : CAMERA[1]]
    away = np.hypot(y - middle[0], x - middle[1])
    mask = away < radius
    sees_wall = away >= radius - 1.5
    outwards = np.stack([x - middle[1], y - middle[0]], -1) / np.maximum(away, 1e-9)[..., None]
    at = (np.stack([x, y], -1) + 0.5) / TIMES - 0.5 + 7 * sees_wall[..., None] * outwards
    white = np.where(sees_wall, room, 0.6)[..., None] * np.ones(3)
    known = white.max(axis=2) > 0.01
    phases = np.where(known[..., None], at, np.nan).astype(np.float32)
    spread = np.tile(np.array([0.3, 0.0, 0.3], np.float32), (*PIXELS, 1))
    metapixels = Metapixels(
        np.zeros((*PIXELS, 2), np.float32), np.ones((*PIXELS, 3), np.float32), np.ones(PIXELS, np.bool_)
    )
    radiometry = Radiometry(np.tile(np.linspace(0, 1, 256), (3, 1)), np.eye(3))
    part = ProjectorCalibration("left", metapixels, radiometry, white.astype(np.float32), PhaseMap(phases, spread))
    return Calibration((part,), np.zeros((*CAMERA, 3), np.float32), mask, np.eye(3))


def lit_pixels(calibration: Calibration, camera: Mask) -> Mask:
    """(rows, columns): projector pixels at which camera pixels look."""
    phase_map = calibration.projectors[0].phase_map
    assert phase_map is not None
    at = np.rint(phase_map.projector_px[camera]).astype(int)
    at = at[((at >= 0) & (at < PIXELS[::-1])).all(axis=1)]
    found = np.zeros(PIXELS, np.bool_)
    found[at[:, 1], at[:, 0]] = True
    return found


@given(st.integers(36, 52), st.integers(40, 70), st.integers(18, 26), st.floats(0.1, 0.9))
@settings(max_examples=20, deadline=None)
def test_what_the_camera_sees_of_the_room_says_which_pixels_light_it(
    row: int, column: int, radius: int, room: float
) -> None:
    calibration = flat_stage((row, column), radius, room)
    beside = beside_object(calibration)
    assert beside is not None
    pixels = beside.pixels.reshape(PIXELS)
    y, x = np.mgrid[0 : CAMERA[0], 0 : CAMERA[1]]
    away = np.hypot(y - row, x - column)
    on_object = lit_pixels(calibration, away < radius - 6)
    only_wall = lit_pixels(calibration, away > radius + 6)
    assert not pixels[on_object].any()
    assert pixels[only_wall].mean() > 0.97


def test_nothing_is_beside_an_object_in_the_dark() -> None:
    assert beside_object(flat_stage((45, 60), 24, 0.0)) is None
    assert build_transport(flat_stage((45, 60), 24, 0.0)).beside is None


@pytest.mark.parametrize("target", [0.2, 0.5])
def test_a_solve_lights_the_object_and_leaves_the_room_dark(target: float) -> None:
    calibration = flat_stage((45, 60), 24, 0.5)
    transport = build_transport(calibration)
    assert transport.beside is not None
    wanted = np.full((*CAMERA, 3), target, np.float32)
    solved = solve_bounded(transport, wanted, calibration.black)
    beside = transport.beside.reshape(PIXELS)
    assert (solved.frames[0][beside] == 0).all()
    inner = np.hypot(*(np.mgrid[0 : CAMERA[0], 0 : CAMERA[1]] - np.array([[[45]], [[60]]]))) < 20
    assert np.abs(transport.forward(solved.frames)[inner] / target - 1).max() < 0.02

    def from_start(frames: FloatImage) -> FloatImage:
        return solve_bounded(transport, wanted, calibration.black, SolveSettings(start=[frames])).frames[0]

    assert (from_start(np.ones((*PIXELS, 3), np.float32))[beside] == 0).all()
    lavish = dataclasses.replace(transport, beside=None, lit=calibration.object_mask[None])
    assert solve_bounded(lavish, wanted, calibration.black).frames[0][beside].max() > 0.1, "without it, it would"
