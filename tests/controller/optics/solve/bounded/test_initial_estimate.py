"""The frames a solve starts from: right where light is smooth, within reach and beyond."""

from __future__ import annotations

import dataclasses
import gc
import weakref
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from controller.config.defaults import SMOOTHNESS
from controller.core.arrays import FloatImage
from controller.optics.calibrate.values import Calibration
from controller.optics.solve.bounded.engine import IterationControl, block_coordinate_descent
from controller.optics.solve.bounded.equations import build_problem, initial_point
from controller.optics.solve.bounded.initial_estimate import white_light
from controller.optics.transport import LightTransport, build_transport
from controller.optics.transport.planes import plane_frames

Stage = Callable[..., Calibration]


def even_stage(stage: Stage) -> tuple[Calibration, LightTransport]:
    """Two projectors, of which the second spills between colours, evenly on a grey plane."""
    calibration = stage(spill=0.2, projector=(12, 16), camera=(36, 48))
    parts = tuple(
        dataclasses.replace(part, white=np.broadcast_to(np.array([0.5, 0.4, 0.3], np.float32), part.white.shape).copy())
        for part in calibration.projectors
    )
    calibration = dataclasses.replace(calibration, projectors=parts, black=np.zeros_like(calibration.black))
    return calibration, build_transport(calibration)


def guessed(calibration: Calibration, transport: LightTransport, target: FloatImage) -> list[FloatImage]:
    return plane_frames(
        initial_point(build_problem(transport, target, calibration.black, SMOOTHNESS, None)), transport.sizes
    )


def test_what_depends_on_the_stage_alone_is_calculated_once_and_ends_with_its_transport(stage: Stage) -> None:
    _, transport = even_stage(stage)
    known = white_light(transport)
    assert white_light(transport) is known
    for n, size in enumerate(transport.sizes):
        white = transport.forward_part(n, np.ones((*size, 3), np.float32))
        seen = plane_frames(known.observed[:, transport.span(n)], [size])[0]
        np.testing.assert_array_equal(seen, transport.gaussian_mean(white, n))
    kept = weakref.ref(known.observed)
    del transport, known
    gc.collect()
    assert kept() is None


def test_light_within_reach_is_shared_alike_whatever_spills(stage: Stage) -> None:
    calibration, transport = even_stage(stage)
    frame = np.broadcast_to(np.array([0.3, 0.6, 0.8], np.float32), (12, 16, 3)).copy()
    found = guessed(calibration, transport, transport.forward([frame, frame]))
    for one in found:
        np.testing.assert_allclose(one[3:-3, 3:-3], frame[3:-3, 3:-3], atol=2e-3)


@pytest.mark.parametrize("of_reach", [(1.1, 0.9, 0.5), (0.02, 0.9, 0.3), (1.3, 1.2, 0.1), (2.0, 2.0, 2.0)])
def test_light_beyond_reach_is_met_as_nearly_as_an_exact_solver_meets_it(
    stage: Stage, of_reach: tuple[float, float, float]
) -> None:
    calibration, transport = even_stage(stage)
    light = np.array(of_reach, np.float32) * transport.reach()[18, 24]
    found = guessed(calibration, transport, np.broadcast_to(light, (36, 48, 3)).copy())
    B = np.hstack([np.diag([0.5, 0.4, 0.3]) @ transport.mixing[n].astype(np.float64) for n in range(2)])
    p = np.concatenate([one[6, 8] for one in found]).astype(np.float64)
    exact = lsq_linear(B, light.astype(np.float64), (0, 1), tol=1e-12)
    assert ((B @ p - light) ** 2).sum() == pytest.approx(2 * exact.cost, rel=1e-2, abs=1e-7)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True)
@given(
    of_reach=st.tuples(*[st.floats(0, 2.5)] * 3),
    white=st.tuples(*[st.sampled_from([0.0, 0.003, 0.1, 0.5, 1.0])] * 3),
    spill=st.floats(0, 0.3),
)
def test_any_light_is_met_as_nearly_as_an_exact_solver_meets_it(
    stage: Stage, of_reach: tuple[float, ...], white: tuple[float, ...], spill: float
) -> None:
    """Projectors of other colours, hardly any light, far beyond reach, dark."""
    calibration = stage(spill=spill, projector=(12, 16), camera=(36, 48))
    colours = np.array([[0.5, 0.4, 0.3], white], np.float32)
    parts = tuple(
        dataclasses.replace(part, white=np.broadcast_to(colour, part.white.shape).copy())
        for part, colour in zip(calibration.projectors, colours, strict=True)
    )
    calibration = dataclasses.replace(calibration, projectors=parts, black=np.zeros_like(calibration.black))
    transport = build_transport(calibration)
    seen = transport.reach()[18, 24]
    light = np.array(of_reach, np.float32) * seen
    found = guessed(calibration, transport, np.broadcast_to(light, (36, 48, 3)).copy())
    lit = [np.diag(colours[n].astype(np.float64)) @ transport.mixing[n].astype(np.float64) for n in range(2)]
    B = np.hstack([one * float(transport.lit[n, 18, 24]) for n, one in enumerate(lit)])
    p = np.concatenate([one[6, 8] for one in found]).astype(np.float64)
    exact = lsq_linear(B, light.astype(np.float64), (0, 1), tol=1e-12)
    # the pull towards alike projectors is a ten-thousandth of their light, squared
    pull = 1e-4 * float((seen.astype(np.float64) ** 2).mean()) * len(p)
    assert ((B @ p - light) ** 2).sum() <= 2 * exact.cost * 1.01 + pull


def test_one_projector_gives_what_another_would_spill(stage: Stage) -> None:
    calibration, transport = even_stage(stage)
    wanted = np.array([1.1, 0.5, 0.5], np.float32) * transport.reach()[18, 24]
    clean, spilling = guessed(calibration, transport, np.broadcast_to(wanted, (36, 48, 3)).copy())
    # more red comes from the green and blue of the second projector alone
    assert clean[6, 8, 2] < 0.2 < 0.7 < spilling[6, 8, 2]


def test_a_solve_beyond_reach_starts_nearer_than_after_sweeps_from_even_shares(stage: Stage) -> None:
    calibration, transport = even_stage(stage)
    wanted = np.array([1.1, 0.6, 0.6], np.float32) * transport.reach()
    problem = build_problem(transport, wanted, calibration.black, SMOOTHNESS, None)
    even = np.full((3, transport.pixels), 0.6, np.float32)
    even[0] = 1
    start = initial_point(problem)
    best, _, _ = block_coordinate_descent(problem, start.copy(), IterationControl(1e-6, 2000))

    def apart(x: FloatImage) -> float:
        return float(((transport.forward_planes(x) - transport.forward_planes(best)) ** 2).sum())

    swept, _, _ = block_coordinate_descent(problem, even, IterationControl(0, 3))
    assert apart(start) < apart(swept)
