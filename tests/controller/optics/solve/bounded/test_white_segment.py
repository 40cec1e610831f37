"""Projectors whose white has light of its own: saturated colours end earlier than greys."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import LinearConstraint, minimize

from controller.core.arrays import Float64, FloatImage
from controller.optics.calibrate.values import Calibration, Radiometry
from controller.optics.solve.appearance import base_image, scale_frames, solve_base
from controller.optics.solve.bounded.equations import SolveSettings
from controller.optics.solve.bounded.gradient import within_segment
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.reach.drive_levels import DriveLevels
from controller.optics.transport import LightTransport, build_transport

Stage = Callable[..., Calibration]
light = st.floats(0.015625, 1.0, width=32)
weight = st.floats(0.125, 8.0, width=32)


@settings(max_examples=150, deadline=None)
@given(st.tuples(light, light, light), st.tuples(weight, weight, weight), st.floats(0.03125, 0.625, width=32))
def test_the_nearest_colour_is_that_of_a_general_solver(
    colour: tuple[float, ...], majoriser: tuple[float, ...], segment: float
) -> None:
    found = np.empty(3, np.float32)
    p, d = np.array(colour, np.float32), np.array(majoriser, np.float32)
    within_segment(p, np.float32(segment), d, found)
    assert (found <= 1 - segment + segment * found.min() + 1e-6).all()
    # p_c - s p_k <= 1 - s for every pair is the same set
    pairs = [(c, k) for c in range(3) for k in range(3) if c != k]
    rows = np.array([[float(i == c) - segment * float(i == k) for i in range(3)] for c, k in pairs])

    def away(q: Float64) -> tuple[float, Float64]:
        return float(d @ (q - p) ** 2), 2 * d * (q - p)

    nearest = minimize(
        away, np.full(3, 0.1), jac=True, method="SLSQP", bounds=[(0, 1)] * 3,
        constraints=LinearConstraint(rows, np.full(len(rows), -np.inf), np.full(len(rows), 1 - segment)),
        options={"ftol": 1e-12},
    )  # fmt: skip
    assert d @ (found - p) ** 2 == pytest.approx(nearest.fun, abs=2e-5)


def with_segment(calibration: Calibration, segment: float) -> Calibration:
    parts = tuple(
        dataclasses.replace(part, radiometry=Radiometry(part.radiometry.response, part.radiometry.mixing, segment))
        for part in calibration.projectors
    )
    return dataclasses.replace(calibration, projectors=parts)


def orange(calibration: Calibration) -> FloatImage:
    white = base_image(calibration, "white")
    return np.asarray(calibration.black + white * np.array([1.0, 0.5, 0.15], np.float32), np.float32)


@pytest.mark.parametrize("segment", [0.2, 0.4])
def test_frames_are_such_as_the_projector_can_show(stage: Stage, segment: float) -> None:
    calibration = with_segment(stage(), segment)
    transport = build_transport(calibration)
    solved = solve_bounded(transport, orange(calibration), calibration.black, SolveSettings(tolerance=1e-4))
    assert solved.converged
    base = solve_base(transport, base_image(calibration, "white"), calibration.black, SolveSettings(tolerance=1e-3))
    scaled = scale_frames(transport, base, orange(calibration), calibration.black)
    for frames in (solved.frames, scaled):
        for frame, part in zip(frames, calibration.projectors, strict=True):
            own = part.radiometry.channels(frame)
            assert own.max() <= 1 + 1e-5
            assert own.max() > 0.99


def test_a_solve_knows_that_saturated_colours_are_darker(stage: Stage) -> None:
    """Against cutting off what the projector can't show, by the light that the frames then really make."""
    calibration = with_segment(stage(), 0.3)
    transport = build_transport(calibration)
    plain = dataclasses.replace(transport, segments=())
    target = orange(calibration)

    def missed(which: LightTransport) -> float:
        frames = solve_bounded(which, target, calibration.black, SolveSettings(smoothness=0.0, tolerance=1e-4)).frames
        shown = [
            np.asarray(part.radiometry.emitted(np.clip(part.radiometry.channels(frame), 0, 1)), np.float32)
            for frame, part in zip(frames, calibration.projectors, strict=True)
        ]
        off = (transport.forward(shown) + calibration.black - target)[transport.object_mask]
        return float((off**2).sum())

    assert missed(transport) < missed(plain)


def test_what_is_in_reach_ends_where_the_projectors_do(stage: Stage) -> None:
    calibration = with_segment(stage(), 0.25)
    transport = build_transport(calibration)
    drive = DriveLevels.of_transport(transport)
    inside = drive.mask
    levels = np.broadcast_to(np.array([0.9, 0.4, 0.2], np.float32), (*inside.shape, 3))
    own = np.asarray(calibration.projectors[0].radiometry.emitted(levels), np.float32)
    frames = [np.broadcast_to(own[0, 0], (*size, 3)).astype(np.float32) for size in transport.sizes]
    np.testing.assert_allclose(drive.of(transport.forward(frames))[inside], levels[inside], rtol=2e-3)
    pure = [np.full_like(frame, [1.0, 0.0, 0.0]) for frame in frames]
    np.testing.assert_allclose(drive.of(transport.forward(pure))[inside].max(axis=1), 1 / 0.75, rtol=1e-3)


def test_where_a_colour_is_never_seen_no_level_makes_it(stage: Stage) -> None:
    calibration = with_segment(stage(), 0.25)
    parts = []
    for part in calibration.projectors:
        white = part.white.copy()
        white[20:40, 20:40, 0] = 0
        parts.append(dataclasses.replace(part, white=white))
    drive = DriveLevels.of_transport(build_transport(dataclasses.replace(calibration, projectors=tuple(parts))))
    levels = drive.of(np.full((*drive.mask.shape, 3), 0.1, np.float32))
    dark = np.zeros_like(drive.mask)
    dark[22:38, 22:38] = True
    assert np.isposinf(levels[dark & drive.mask]).all()
    assert not np.isnan(levels).any()
