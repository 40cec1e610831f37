"""The four-phase regions against exact solvers, the global solver and the transport itself."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.core.arrays import FloatImage
from controller.core.errors import UsageError, WorkError
from controller.optics.calibrate.values import Calibration
from controller.optics.solve.bounded.engine import SolveContext
from controller.optics.solve.bounded.equations import SolveSettings, build_problem
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.transport import LightTransport, build_transport
from controller.optics.transport.planes import CameraBox
from lab.study.regions import (
    SOLVERS,
    BoxProblem,
    RegionCut,
    Regions,
    solve_box,
    solve_regions,
)
from lab.timings.tools.synthetic import crop_calibration, synthetic_calibration
from tests.controller.optics.solve.conftest import plane_calibration

pytestmark = pytest.mark.slow

Stage = Callable[..., Calibration]
FAST = "clarabel"


@pytest.fixture
def stage() -> Stage:
    return plane_calibration


def crop(stage: Stage, *, blurred: bool = False, mixed: bool = True, seed: int = 0) -> Calibration:
    """64x64 camera pixels and about as many projector pixels as on a real stage."""
    calibration = stage(seed, projector=(24, 24), camera=(64, 64))
    if not mixed:
        plain = [
            dataclasses.replace(part, radiometry=dataclasses.replace(part.radiometry, mixing=np.eye(3)))
            for part in calibration.projectors
        ]
        calibration = dataclasses.replace(calibration, projectors=tuple(plain))
    return dataclasses.replace(calibration, camera_blur_px=(0.6, 0.5, 0.6)) if blurred else calibration


def windowed(*, mosaic: bool) -> LightTransport:
    """Three small projectors whose phase maps are known."""
    calibration = synthetic_calibration(projector=(24, 26), camera=(64, 66))
    return build_transport(calibration if mosaic else dataclasses.replace(calibration, mosaic=None))


def picture(transport: LightTransport) -> FloatImage:
    """Waves and squares, mostly reachable."""
    y, x = np.mgrid[0 : transport.camera_shape[0], 0 : transport.camera_shape[1]].astype(np.float32)
    share = 0.5 + 0.2 * np.sin(x / 9) * np.cos(y / 7) + 0.15 * ((x // 12 + y // 12) % 2)
    return np.asarray(transport.reach() * share[..., None], np.float32)


@pytest.mark.parametrize("blurred", [False, True], ids=["sharp camera", "blurred camera"])
def test_the_equations_of_a_region_are_those_of_the_transport(stage: Stage, blurred: bool) -> None:
    transport = build_transport(crop(stage, blurred=blurred))
    box = CameraBox(20, 28, 40, 48)
    count = transport.pixels
    random = np.random.default_rng(2)
    unknown = np.sort(random.choice(count, 300, replace=False))
    values = random.random((3, unknown.size))
    planes = np.zeros((3, count), np.float32)
    planes[:, unknown] = values
    whole = np.asarray(transport.forward_planes(planes)[(slice(None), *box.window)])
    together = np.asarray(transport.submatrix(box, unknown, (0, 1, 2)) @ values.ravel())
    np.testing.assert_allclose(together, whole.ravel(), atol=2e-6 * float(whole.max()), rtol=1e-5)


@pytest.mark.parametrize("mosaic", [True, False], ids=["bayer camera", "three colours a pixel"])
def test_the_equations_of_a_region_are_those_of_a_transport_by_camera_samples(mosaic: bool) -> None:
    transport = windowed(mosaic=mosaic)
    box = CameraBox(20, 28, 40, 49)
    random = np.random.default_rng(2)
    unknown = np.sort(random.choice(transport.pixels, 300, replace=False))
    values = random.random((3, unknown.size))
    planes = np.zeros((3, transport.pixels), np.float32)
    planes[:, unknown] = values
    whole = np.asarray(transport.forward_planes(planes)[(slice(None), *box.window)])
    assert whole.any()
    together = np.asarray(transport.submatrix(box, unknown, (0, 1, 2)) @ values.ravel())
    np.testing.assert_allclose(together, whole.ravel(), atol=3e-6 * float(whole.max()), rtol=1e-5)


def test_one_region_over_a_crop_by_camera_samples_gives_the_global_optimum() -> None:
    calibration = crop_calibration(synthetic_calibration("small"), 200, 300, 40)
    transport = build_transport(calibration)
    target = picture(transport)
    exact = solve_regions(transport, target, calibration.black, cut=RegionCut(solver=FAST, size_px=128))
    best = solve_bounded(transport, target, calibration.black, SolveSettings(tolerance=1e-6, most_iterations=6000))
    assert exact.regions == 1
    assert best.objective == pytest.approx(exact.objective, rel=1e-4)
    phases = solve_regions(transport, target, calibration.black, cut=RegionCut(solver=FAST))
    assert -1e-4 < phases.objective / exact.objective - 1 < 0.02


@pytest.mark.parametrize(("blurred", "mixed"), [(False, True), (True, True), (True, False)])
def test_one_region_over_the_whole_image_gives_the_global_optimum(stage: Stage, blurred: bool, mixed: bool) -> None:
    calibration = crop(stage, blurred=blurred, mixed=mixed)
    transport = build_transport(calibration)
    target = picture(transport)
    weights = np.random.default_rng(1).uniform(0, 2, transport.camera_shape).astype(np.float32)
    weights[20:24] = 0
    exact = solve_regions(
        transport, target, calibration.black, SolveSettings(weights=weights), cut=RegionCut(solver=FAST, size_px=100)
    )
    best = solve_bounded(
        transport, target, calibration.black, SolveSettings(weights=weights, tolerance=1e-6, most_iterations=6000)
    )
    assert exact.regions == 1
    assert best.objective == pytest.approx(exact.objective, rel=1e-4)


def test_four_phases_come_near_the_global_optimum_and_never_below_it(stage: Stage) -> None:
    calibration = crop(stage, blurred=True)
    transport = build_transport(calibration)
    target = picture(transport)
    best = solve_bounded(transport, target, calibration.black, SolveSettings(tolerance=1e-6, most_iterations=6000))
    found = solve_regions(transport, target, calibration.black, cut=RegionCut(solver=FAST))
    assert found.regions == 16
    assert -1e-4 < found.objective / best.objective - 1 < 0.06
    light = transport.forward(best.frames)
    difference = np.sqrt(np.mean((found.light - light) ** 2) / np.mean(light**2))
    assert difference < 0.012
    np.testing.assert_allclose(found.light, transport.forward(found.frames), atol=1e-6)
    for frame in found.frames:
        assert 0 <= frame.min() <= frame.max() <= 1


def test_larger_regions_come_nearer(stage: Stage) -> None:
    calibration = crop(stage)
    transport = build_transport(calibration)
    target = picture(transport)
    small, large = (
        solve_regions(transport, target, calibration.black, cut=RegionCut(solver=FAST, size_px=size)).objective
        for size in (8, 32)
    )
    assert large < small


def test_the_reference_solver_and_the_fast_one_agree(stage: Stage) -> None:
    calibration = stage(1, projector=(14, 14), camera=(36, 36))
    transport = build_transport(calibration)
    target = picture(transport)
    reference = solve_regions(transport, target, calibration.black)
    fast = solve_regions(transport, target, calibration.black, cut=RegionCut(solver=FAST))
    assert (fast.regions, fast.unknowns) == (reference.regions, reference.unknowns)
    assert fast.objective == pytest.approx(reference.objective, rel=3e-4)


@settings(max_examples=15, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10_000), rows=st.integers(3, 40), columns=st.integers(1, 20))
def test_every_solver_finds_the_same_bounded_minimum(seed: int, rows: int, columns: int) -> None:
    random = np.random.default_rng(seed)
    A = sp.csr_matrix(np.where(random.random((rows, columns)) < 0.4, random.random((rows, columns)), 0.0))
    problem = BoxProblem(A, random.uniform(-0.3, 1.5, rows), np.full(columns, 0.5))
    objectives = []
    for name in ("lsq_linear", "clarabel"):
        x = solve_box(name, problem)
        assert x.min() >= 0
        assert x.max() <= 1
        objectives.append(problem.objective(x))
    assert objectives[0] == pytest.approx(objectives[1], rel=1e-5, abs=1e-8)


def test_osqp_agrees_where_it_is_installed(stage: Stage) -> None:
    pytest.importorskip("osqp")
    calibration = stage(1, projector=(14, 14), camera=(36, 36))
    transport = build_transport(calibration)
    target = picture(transport)
    splitting, exact = (
        solve_regions(transport, target, calibration.black, cut=RegionCut(solver=name)).objective
        for name in ("osqp", FAST)
    )
    assert splitting == pytest.approx(exact, rel=2e-3)


def test_regions_of_a_phase_share_no_pixel_and_all_together_hold_every_pixel(stage: Stage) -> None:
    calibration = crop(stage)
    transport = build_transport(calibration)
    problem = build_problem(transport, picture(transport), calibration.black, 0.001, None)
    regions = Regions(problem)
    nothing = np.zeros(transport.pixels, np.bool_)
    held = np.zeros(nothing.size, int)
    for phase in ((0, 0), (0, 1), (1, 0), (1, 1)):
        unknown = [regions.unknown(i, j, nothing) for i, j in regions.of_phase(phase)]
        assert np.unique(np.concatenate(unknown)).size == sum(map(len, unknown))
        for i, j in regions.of_phase(phase):
            held[regions.core(i, j)] += 1
    np.testing.assert_array_equal(held[problem.majoriser.max(axis=0) > 0], 1)


def test_a_dead_projector_stays_dark_and_an_object_in_the_middle_is_enough(stage: Stage) -> None:
    calibration = crop(stage)
    dead = dataclasses.replace(calibration.projectors[0], white=np.zeros_like(calibration.projectors[0].white))
    mask = np.zeros((64, 64), np.bool_)
    mask[20:30, 22:50] = True
    calibration = dataclasses.replace(calibration, projectors=(dead, calibration.projectors[1]), object_mask=mask)
    transport = build_transport(calibration)
    found = solve_regions(transport, picture(transport), calibration.black, cut=RegionCut(solver=FAST))
    assert 0 < found.regions < 16
    assert not found.frames[0].any()
    assert found.frames[1].any()


def test_wrong_use_is_told_and_a_stop_takes_hold(stage: Stage) -> None:
    calibration = stage(projector=(10, 10), camera=(40, 40))
    transport = build_transport(calibration)
    target = picture(transport)
    for arguments in ({"overlap": 1.0}, {"overlap": -0.1}, {"size_px": 0}):
        with pytest.raises(UsageError) as refused:
            solve_regions(transport, target, calibration.black, cut=RegionCut(**arguments))
        assert refused.value.code == "solve-arguments"
    with pytest.raises(UsageError) as refused:
        solve_regions(transport, target, calibration.black, cut=RegionCut(solver="guess"))
    assert refused.value.code == "solver-unknown"
    seen: list[int] = []
    with pytest.raises(WorkError) as stopped:
        solve_regions(
            transport,
            target,
            calibration.black,
            context=SolveContext(progress=lambda done, left: seen.append(done), cancelled=lambda: len(seen) == 2),
            cut=RegionCut(solver=FAST),
        )
    assert stopped.value.code == "solve-cancelled"
    assert len(seen) == 2


def test_a_solver_that_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> object:
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr("lab.study.regions.importlib.import_module", absent)
    problem = BoxProblem(sp.csr_matrix(np.eye(2)), np.ones(2), np.zeros(2))
    for name in set(SOLVERS) - {"lsq_linear"}:
        with pytest.raises(UsageError) as refused:
            solve_box(name, problem)
        assert refused.value.code == "solver-missing"
        assert name in refused.value.remedy
