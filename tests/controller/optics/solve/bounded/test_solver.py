"""The bounded solver against an exact one, and on stages where something is missing."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import clarabel
import numpy as np
import numpy.typing as npt
import pytest
import scipy.sparse as sp
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from controller.config.defaults import SMOOTHNESS
from controller.core.errors import UsageError, WorkError
from controller.optics.calibrate.values import Calibration, Metapixels
from controller.optics.solve.bounded.engine import SolveContext, kkt_residual
from controller.optics.solve.bounded.equations import (
    EDGE_WEIGHT_STEPS,
    Solution,
    SolveSettings,
    build_problem,
    smoothness_term,
    squared_edge_weights,
)
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.transport import LightTransport, build_transport
from controller.optics.transport.planes import frame_planes, image_planes, plane_frames
from tests.controller.optics.solve.bounded.smoothness_reference import smoothness_weights

Stage = Callable[..., Calibration]
Matrix = npt.NDArray[np.float64]
HALF_A_STEP = 0.5 / EDGE_WEIGHT_STEPS
few = settings(
    max_examples=4, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True
)


def random_target(transport: LightTransport, seed: int) -> npt.NDArray[np.float32]:
    """Some of it brighter than the projectors can make, some darker than black."""
    return (
        np.random.default_rng(seed).uniform(0, 1.2, (*transport.camera_shape, 3)).astype(np.float32) * transport.reach()
    )


def dense(transport: LightTransport, *, absolute: bool = False) -> Matrix:
    """T column by column."""
    columns = []
    shapes = [(*size, 3) for size in transport.sizes]
    source = transport.with_absolute_mixing() if absolute else transport
    for n, shape in enumerate(shapes):
        for i in range(int(np.prod(shape))):
            frames = [np.zeros(s, np.float32) for s in shapes]
            frames[n].ravel()[i] = 1
            columns.append(source.forward(frames).ravel().astype(np.float64))
    return np.stack(columns, 1)


def smoothness_rows(calibration: Calibration, transport: LightTransport, target: npt.NDArray[np.float32]) -> Matrix:
    """One row alpha (p_i - p_j) for each pair of adjacent pixels (paper eq. 3)."""
    wanted = np.maximum(target - calibration.black, 0)
    count = sum(3 * a * b for a, b in transport.sizes)
    rows, first = [], 0
    for n, (a, b) in enumerate(transport.sizes):
        white = transport.forward_part(n, np.ones((a, b, 3), np.float32))
        edges = smoothness_weights(transport.gaussian_mean(wanted, n), transport.gaussian_mean(white, n))
        index = first + np.arange(a * b * 3).reshape(a, b, 3)
        for alpha, i, j in ((edges.across, index[:, 1:], index[:, :-1]), (edges.down, index[1:], index[:-1])):
            for weight, one, other in zip(alpha.ravel(), i.ravel(), j.ravel(), strict=True):
                row = np.zeros(count)
                row[one], row[other] = weight, -weight
                rows.append(row)
        first += a * b * 3
    return np.array(rows) if rows else np.zeros((0, count))


def exact(A: Matrix, b: Matrix) -> float:
    """min |A p - b|^2 for 0 <= p <= 1, by an interior-point method (Clarabel)."""
    quadratic = sp.csc_matrix(np.triu(2 * A.T @ A))
    count = A.shape[1]
    constraints = sp.vstack([sp.identity(count), -sp.identity(count)]).tocsc()
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    bounds = np.r_[np.ones(count), np.zeros(count)]
    cones = [clarabel.NonnegativeConeT(2 * count)]
    solver = clarabel.DefaultSolver(quadratic, -2 * A.T @ b, constraints, bounds, cones, settings)
    p = np.clip(np.array(solver.solve().x), 0, 1)
    return float(((A @ p - b) ** 2).sum())


@few
@given(seed=st.integers(0, 1000), smoothness=st.sampled_from([0.0, 0.005, 0.3]), weighted=st.booleans())
def test_the_objective_agrees_with_an_exact_solver(stage: Stage, seed: int, smoothness: float, weighted: bool) -> None:
    calibration = stage(seed, projector=(5, 6), camera=(14, 18), spill=0.15)
    transport = build_transport(calibration)
    target = random_target(transport, seed)
    weights = (
        np.random.default_rng(seed).uniform(0.1, 3, transport.camera_shape).astype(np.float32) if weighted else None
    )
    solution = solve_bounded(
        transport,
        target,
        calibration.black,
        SolveSettings(smoothness=smoothness, weights=weights, tolerance=1e-7, most_iterations=5000),
    )
    T, magnitude = dense(transport), dense(transport, absolute=True)
    counted = transport.object_mask.astype(np.float64) * (1.0 if weights is None else weights)
    w = np.repeat(counted.ravel(), 3)
    diagonal = magnitude.T @ (w * magnitude.sum(1))
    strength = smoothness * diagonal[diagonal > 0].mean()
    S = smoothness_rows(calibration, transport, target)
    b = np.maximum(target - calibration.black, 0).ravel().astype(np.float64)
    A = np.vstack([np.sqrt(w)[:, None] * T, np.sqrt(strength) * S])
    best = exact(A, np.r_[np.sqrt(w) * b, np.zeros(len(S))])
    assert solution.objective == pytest.approx(best, rel=1e-4)
    p = np.concatenate([frame.ravel() for frame in solution.frames]).astype(np.float64)
    residual = A @ p - np.r_[np.sqrt(w) * b, np.zeros(len(S))]
    assert solution.objective == pytest.approx(float(residual @ residual), rel=1e-4)


def solved(calibration: Calibration, target: npt.NDArray[np.float32] | None = None) -> tuple[LightTransport, Solution]:
    transport = build_transport(calibration)
    wanted = random_target(transport, 1) if target is None else target
    return transport, solve_bounded(transport, wanted, calibration.black)


def test_a_reachable_target_is_reached(stage: Stage) -> None:
    calibration = stage()
    transport = build_transport(calibration)
    y, x = np.mgrid[0:20, 0:26].astype(np.float32)
    smooth = np.repeat((0.4 + 0.2 * np.sin(x / 5) * np.cos(y / 4))[..., None], 3, -1).astype(np.float32)
    target = transport.forward([smooth, smooth]) + calibration.black
    solution = solve_bounded(transport, target, calibration.black)
    error = (transport.forward(solution.frames) + calibration.black - target)[transport.object_mask]
    assert solution.converged
    assert np.sqrt((error**2).mean()) < 0.01 * target.max()


def test_a_target_brighter_than_reachable_gives_white_within_bounds(stage: Stage) -> None:
    _, solution = solved(stage(), np.full((60, 80, 3), 50, np.float32))
    for frame in solution.frames:
        assert frame.min() >= 0
        assert frame.max() <= 1
        assert np.median(frame) > 0.99


def test_a_target_darker_than_black_gives_dark_projectors(stage: Stage) -> None:
    _, solution = solved(stage(), np.zeros((60, 80, 3), np.float32))
    assert max(float(frame.max()) for frame in solution.frames) < 1e-5


def test_a_dead_projector_stays_dark_and_the_other_does_the_work(stage: Stage) -> None:
    calibration = stage()
    dead = dataclasses.replace(calibration.projectors[0], white=np.zeros_like(calibration.projectors[0].white))
    calibration = dataclasses.replace(calibration, projectors=(dead, calibration.projectors[1]))
    _, solution = solved(calibration, calibration.projectors[1].white * 0.5)
    assert not solution.frames[0].any()
    assert 0.3 < np.median(solution.frames[1]) < 0.7


def test_an_all_black_object_solves_to_dark_frames(stage: Stage) -> None:
    calibration = stage()
    projectors = tuple(dataclasses.replace(p, white=np.zeros_like(p.white)) for p in calibration.projectors)
    _, solution = solved(dataclasses.replace(calibration, projectors=projectors), np.full((60, 80, 3), 1, np.float32))
    assert not any(frame.any() for frame in solution.frames)


def test_one_camera_pixel_and_one_projector_pixel(stage: Stage) -> None:
    calibration = stage(projector=(1, 1), camera=(1, 1), projectors=1)
    metapixels = Metapixels(
        np.zeros((1, 1, 2), np.float32), np.array([[[1, 0, 1]]], np.float32), np.ones((1, 1), np.bool_)
    )
    projector = dataclasses.replace(calibration.projectors[0], metapixels=metapixels)
    calibration = dataclasses.replace(calibration, projectors=(projector,), black=np.zeros((1, 1, 3), np.float32))
    transport = build_transport(calibration)
    frame = np.array([[[0.2, 0.5, 0.8]]], np.float32)
    solution = solve_bounded(transport, transport.forward([frame]), calibration.black, SolveSettings(tolerance=1e-6))
    np.testing.assert_allclose(solution.frames[0], frame, atol=1e-3)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_target_that_is_not_finite_is_refused(stage: Stage, bad: float) -> None:
    target = np.full((60, 80, 3), 0.1, np.float32)
    target[3, 4, 1] = bad
    with pytest.raises(UsageError) as refused:
        solved(stage(), target)
    assert refused.value.code == "target-not-finite"


def test_a_target_of_another_size_is_refused(stage: Stage) -> None:
    with pytest.raises(UsageError) as refused:
        solved(stage(), np.zeros((80, 60, 3), np.float32))
    assert refused.value.code == "image-wrong-size"


def test_weights_that_are_negative_are_refused(stage: Stage) -> None:
    calibration = stage()
    transport = build_transport(calibration)
    with pytest.raises(UsageError) as refused:
        solve_bounded(
            transport,
            calibration.black,
            calibration.black,
            SolveSettings(weights=np.full(transport.camera_shape, -1, np.float32)),
        )
    assert refused.value.code == "solve-arguments"


def test_a_warm_start_needs_fewer_iterations_for_the_same_answer(stage: Stage) -> None:
    calibration = stage()
    transport = build_transport(calibration)
    target = random_target(transport, 4)
    cold = solve_bounded(transport, target, calibration.black)
    warm = solve_bounded(transport, target * 1.01, calibration.black, SolveSettings(start=cold.frames))
    again = solve_bounded(transport, target * 1.01, calibration.black)
    assert warm.iterations < again.iterations
    assert warm.objective == pytest.approx(again.objective, rel=1e-3)


def test_momentum_reaches_the_tolerance_several_times_sooner_than_sweeps_alone(stage: Stage) -> None:
    calibration = stage(3)
    transport = build_transport(calibration)
    target = 0.75 * random_target(transport, 3)
    found = solve_bounded(transport, target, calibration.black, SolveSettings(smoothness=1e-4, tolerance=1e-4))
    assert found.iterations < 80, "without momentum more than 300"


def test_light_does_not_drift_from_the_frames_in_many_sweeps(stage: Stage) -> None:
    calibration = stage(3)
    transport = build_transport(calibration)
    target = 0.75 * random_target(transport, 3)
    settings = SolveSettings(smoothness=1e-4, tolerance=1e-12, most_iterations=600)
    found = solve_bounded(transport, target, calibration.black, settings)
    problem = build_problem(transport, target, calibration.black, 1e-4, None)
    assert kkt_residual(problem, frame_planes(found.frames)) < 4e-6


def test_the_same_problem_gives_the_same_bytes(stage: Stage) -> None:
    (_, first), (_, second) = solved(stage()), solved(stage())
    np.testing.assert_array_equal(frame_planes(first.frames), frame_planes(second.frames))


def test_a_solve_reports_progress_and_stops_when_asked(stage: Stage) -> None:
    calibration = stage()
    transport = build_transport(calibration)
    seen: list[int] = []
    with pytest.raises(WorkError) as stopped:
        solve_bounded(
            transport,
            random_target(transport, 5),
            calibration.black,
            context=SolveContext(
                progress=lambda iteration, kkt: seen.append(iteration), cancelled=lambda: len(seen) >= 3
            ),
        )
    assert stopped.value.code == "solve-cancelled"
    assert seen == [1, 2, 3]


def test_more_smoothness_makes_smoother_frames(stage: Stage) -> None:
    calibration = stage()
    transport = build_transport(calibration)
    target = random_target(transport, 6)
    rough, smooth = (
        solve_bounded(transport, target, calibration.black, SolveSettings(smoothness=s)).frames[0] for s in (1e-4, 0.3)
    )
    assert np.abs(np.diff(smooth, axis=1)).mean() < 0.7 * np.abs(np.diff(rough, axis=1)).mean()


@few
@given(seed=st.integers(0, 2**31))
def test_the_weights_of_the_smoothness_equations_are_those_of_the_paper(stage: Stage, seed: int) -> None:
    calibration = stage(seed % 7)
    transport = build_transport(calibration)
    wanted = random_target(transport, seed)
    wanted[:, : wanted.shape[1] // 3] *= np.float32(0.05)
    across, down = squared_edge_weights(transport, image_planes(wanted))
    for n, size in enumerate(transport.sizes):
        white = transport.forward_part(n, np.ones((*size, 3), np.float32))
        edges = smoothness_weights(transport.gaussian_mean(wanted, n), transport.gaussian_mean(white, n))
        kept = (part[:, transport.span(n)].astype(np.float32) for part in (across, down))
        right, below = (plane_frames(part, [size])[0] for part in kept)
        np.testing.assert_allclose(
            right[:, :-1] / EDGE_WEIGHT_STEPS, edges.across**2, rtol=1e-4, atol=HALF_A_STEP + 1e-6
        )
        np.testing.assert_allclose(below[:-1] / EDGE_WEIGHT_STEPS, edges.down**2, rtol=1e-4, atol=HALF_A_STEP + 1e-6)
        assert not right[:, -1].any()
        assert not below[-1].any()


@pytest.mark.parametrize("axis", [0, 1])
def test_a_pixel_in_shadow_ties_neither_the_pixel_before_it_nor_the_one_after(stage: Stage, axis: int) -> None:
    calibration = stage()
    size = build_transport(calibration).sizes[0]
    places = np.indices(size)[axis]
    dark = places == size[axis] // 2
    part = calibration.projectors[0]
    valid = part.metapixels.valid & ~dark
    lit = dataclasses.replace(part, metapixels=dataclasses.replace(part.metapixels, valid=valid))
    transport = build_transport(dataclasses.replace(calibration, projectors=(lit, *calibration.projectors[1:])))
    edges = squared_edge_weights(transport, image_planes(random_target(transport, 1)))[1 - axis]
    (own,) = plane_frames(edges[:, transport.span(0)].astype(np.float32), [size])
    assert not own[dark].any(), "from the dark pixel to the next"
    assert not own[places == size[axis] // 2 - 1].any(), "from the one before it"
    assert own[places == size[axis] // 2 - 2].any()


def test_the_reference_lets_go_where_the_target_has_an_edge_or_a_shadow() -> None:
    target = np.full((4, 6, 3), 0.5, np.float32)
    target[:, 3:] = 0.1
    observed = np.ones_like(target)
    observed[0] = 0
    edges = smoothness_weights(target, observed)
    np.testing.assert_allclose(edges.across[1:, [0, 1, 3, 4]], 1)
    np.testing.assert_allclose(edges.across[1:, 2], 0.2, rtol=1e-5)
    assert not edges.across[0].any()
    assert not edges.down[0].any()


@few
@given(seed=st.integers(0, 2**31))
def test_weights_in_steps_change_the_objective_by_half_a_step_of_each_difference(stage: Stage, seed: int) -> None:
    calibration = stage(seed % 7)
    transport = build_transport(calibration)
    wanted = random_target(transport, seed)
    problem = build_problem(transport, wanted, calibration.black, SMOOTHNESS, None)
    x = np.random.default_rng(seed).random((3, transport.pixels), np.float32)
    light = np.maximum(wanted - calibration.black, 0)
    exact = most = 0.0
    for n, size in enumerate(transport.sizes):
        white = transport.forward_part(n, np.ones((*size, 3), np.float32))
        edges = smoothness_weights(transport.gaussian_mean(light, n), transport.gaussian_mean(white, n))
        (frame,) = plane_frames(x[:, transport.span(n)], [size])
        own = (problem.majoriser[:, transport.span(n)] > 0).astype(np.float32)
        (lights,) = plane_frames(own, [size])
        for alpha, axis in ((edges.across, 1), (edges.down, 0)):
            apart = np.diff(frame.astype(np.float64), axis=axis) ** 2
            lit = (np.delete(lights, 0, axis) > 0) & (np.delete(lights, -1, axis) > 0)
            exact += float((lit * alpha.astype(np.float64) ** 2 * apart).sum())
            most += float(apart.sum())
    strength = problem.strength_per_step * EDGE_WEIGHT_STEPS
    assert abs(smoothness_term(problem, x) - strength * exact) <= strength * (HALF_A_STEP * most + 1e-5 * exact)
