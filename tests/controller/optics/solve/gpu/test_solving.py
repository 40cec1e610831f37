"""Solves on a graphics processor reach the optimum of the processor, and of a solver by other authors."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.config.defaults import SMOOTHNESS
from controller.core.arrays import FloatImage
from controller.core.errors import WorkError
from controller.optics.calibrate.values import Calibration
from controller.optics.solve import gpu
from controller.optics.solve.appearance import base_image, scale_frames, solve_base
from controller.optics.solve.bounded.engine import SolveContext
from controller.optics.solve.bounded.equations import EDGE_WEIGHT_STEPS, SolveInput, SolveSettings, build_problem
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.gpu.device import Device
from controller.optics.solve.gpu.engine import GpuEngine
from controller.optics.solve.gpu.equations import DeviceEquations
from controller.optics.solve.gpu.transport import DeviceTransport
from controller.optics.transport import LightTransport, build_transport
from controller.optics.transport.planes import frame_planes
from lab.timings.tools.synthetic import synthetic_calibration
from tests.controller.optics.solve.bounded.smoothness_reference import smoothness_weights
from tests.controller.optics.solve.bounded.test_solver_oracle import bent, exact, unreachable_in_parts
from tests.controller.optics.solve.gpu.conftest import any_windows, few, opened, stages


@pytest.fixture
def engine(device: Device) -> GpuEngine:
    return GpuEngine(device, _only_memory)


def _only_memory(text: str) -> None:
    """Nothing is left to the processor, where a test does not say so."""
    assert "takes" in text


@pytest.fixture(scope="module")
def stage() -> tuple[Calibration, LightTransport]:
    calibration = synthetic_calibration(projector=(14, 18), camera=(36, 50))
    return calibration, build_transport(calibration)


def test_the_objective_is_the_least_on_a_folded_object(engine: GpuEngine) -> None:
    calibration = bent(synthetic_calibration(projector=(14, 18), camera=(36, 50)), "fold")
    transport = build_transport(calibration)
    target = unreachable_in_parts(transport, calibration.black)
    best = exact(build_problem(transport, target, calibration.black, SMOOTHNESS, None))
    found = solve_bounded(
        transport,
        target,
        calibration.black,
        SolveSettings(tolerance=1e-5, most_iterations=2000),
        SolveContext(engine=engine),
    )
    assert found.objective == pytest.approx(best, rel=1e-4)


@pytest.mark.parametrize(
    ("mosaic", "segment"),
    [(True, 0.0), (False, 0.0), (False, 0.3), (True, 0.4)],
)
def test_objectives_agree_with_the_processor(engine: GpuEngine, mosaic: bool, segment: float) -> None:
    transport = any_windows(3, mosaic=mosaic, segment=segment)
    rng = np.random.default_rng(3)
    black = np.zeros((*transport.camera_shape, 3), np.float32)
    target = transport.reach() * rng.uniform(0, 1.2, black.shape).astype(np.float32)
    weights = rng.uniform(0.1, 3, transport.camera_shape).astype(np.float32)
    there, here = (
        solve_bounded(
            transport,
            target,
            black,
            SolveSettings(weights=weights, tolerance=1e-5, most_iterations=100),
            SolveContext(engine=which),
        )
        for which in (engine, None)
    )
    assert there.objective == pytest.approx(here.objective, rel=1e-4)
    planes = frame_planes(there.frames)
    assert planes.min() >= 0
    assert planes.max() <= 1


@few
@stages
def test_a_solve_starts_where_the_processor_s_does(device: Device, seed: int, mosaic: bool) -> None:
    """Within reach and beyond, dark pixels too."""
    transport = any_windows(seed, mosaic=mosaic, segment=0.0)
    rng = np.random.default_rng(seed)
    black = np.full((*transport.camera_shape, 3), 0.001, np.float32)
    target = black + transport.reach() * rng.uniform(0, 1.6, 3).astype(np.float32)
    there, here = (
        solve_bounded(
            transport, target, black, SolveSettings(tolerance=0, most_iterations=0), SolveContext(engine=which)
        )
        for which in (GpuEngine(device, _only_memory), None)
    )
    np.testing.assert_allclose(frame_planes(there.frames), frame_planes(here.frames), atol=2e-3)
    assert there.objective == pytest.approx(here.objective, rel=1e-3)


def test_each_solve_has_its_own_black_weights_start_and_smoothness(engine: GpuEngine) -> None:
    """What stays on the device from solve to solve is only what they share."""
    transport = any_windows(4, mosaic=True)
    rng = np.random.default_rng(4)
    shape = transport.camera_shape
    asked = [
        (
            np.full((*shape, 3), black, np.float32),
            SolveSettings(
                smoothness,
                rng.uniform(0.2, 2, shape).astype(np.float32) if weighted else None,
                [np.full((*size, 3), 0.2, np.float32) for size in transport.sizes] if started else None,
                tolerance=0,
                most_iterations=6,
            ),
        )
        for black, weighted, started, smoothness in (
            (0.0, False, False, 1e-3),
            (0.02, True, False, 1e-2),
            (0.02, False, True, 1e-4),
            (0.0, True, True, 1e-3),
            (0.0, False, False, 1e-3),
        )
    ]
    target = transport.reach() * np.float32(0.7)
    for dark, settings in asked:
        there, here = (
            solve_bounded(transport, target, dark, settings, SolveContext(which)) for which in (engine, None)
        )
        assert there.objective == pytest.approx(here.objective, rel=1e-4)
        np.testing.assert_allclose(frame_planes(there.frames), frame_planes(here.frames), atol=2e-3)


def test_pixels_beside_the_object_stay_dark(engine: GpuEngine) -> None:
    transport = any_windows(6, mosaic=True)
    beside = np.zeros(transport.pixels, np.bool_)
    beside[::7] = True
    transport = dataclasses.replace(transport, beside=beside)
    black = np.zeros((*transport.camera_shape, 3), np.float32)
    target = 0.6 * transport.reach()
    there, here = (
        solve_bounded(
            transport, target, black, SolveSettings(tolerance=0, most_iterations=8), SolveContext(engine=which)
        )
        for which in (engine, None)
    )
    assert (frame_planes(there.frames)[:, beside] == 0).all()
    assert there.objective == pytest.approx(here.objective, rel=1e-4)


@pytest.mark.parametrize("sweeps", [3, 53])
def test_sweeps_are_those_of_the_processor(
    engine: GpuEngine, stage: tuple[Calibration, LightTransport], sweeps: int
) -> None:
    """The same steps from the same start, momentum and recomputed light included."""
    calibration, transport = stage
    target = unreachable_in_parts(transport, calibration.black)
    there, here = (
        solve_bounded(
            transport,
            target,
            calibration.black,
            SolveSettings(tolerance=0, most_iterations=sweeps),
            SolveContext(engine=which),
        )
        for which in (engine, None)
    )
    assert there.iterations == here.iterations == sweeps
    assert not there.converged
    # later, pixels of hardly any light differ by what rounding made of them, and the objective does not
    if sweeps == 3:
        np.testing.assert_allclose(frame_planes(there.frames), frame_planes(here.frames), atol=1e-4)
    assert there.objective == pytest.approx(here.objective, rel=1e-5)
    assert there.kkt == pytest.approx(here.kkt, rel=0.05)


def test_a_solve_ends_in_the_sweep_that_meets_the_tolerance(
    engine: GpuEngine, stage: tuple[Calibration, LightTransport]
) -> None:
    """Although several are submitted at once: those after it change nothing."""
    calibration, transport = stage
    image = base_image(calibration)
    found = solve_bounded(
        transport, image, calibration.black, SolveSettings(tolerance=1e-4), SolveContext(engine=engine)
    )
    same = solve_bounded(
        transport,
        image,
        calibration.black,
        SolveSettings(tolerance=0, most_iterations=found.iterations),
        SolveContext(engine=engine),
    )
    assert found.converged
    assert found.kkt == same.kkt <= 1e-4
    np.testing.assert_array_equal(frame_planes(found.frames), frame_planes(same.frames))


def test_a_warm_start_is_used(engine: GpuEngine, stage: tuple[Calibration, LightTransport]) -> None:
    calibration, transport = stage
    image = base_image(calibration)
    cold = solve_bounded(transport, image, calibration.black, context=SolveContext(engine=engine))
    warm = solve_bounded(
        transport, image, calibration.black, SolveSettings(start=cold.frames), SolveContext(engine=engine)
    )
    assert warm.iterations < cold.iterations / 2


def test_progress_is_told_and_a_stop_request_obeyed(
    engine: GpuEngine, stage: tuple[Calibration, LightTransport]
) -> None:
    calibration, transport = stage
    seen: list[int] = []
    context = SolveContext(engine, lambda iteration, kkt: seen.append(iteration), lambda: len(seen) >= 3)
    with pytest.raises(WorkError) as stopped:
        solve_bounded(transport, base_image(calibration), calibration.black, SolveSettings(tolerance=0), context)
    assert stopped.value.code == "solve-cancelled"
    assert len(seen) == 3
    assert seen == sorted(set(seen))


@pytest.mark.parametrize("segment", [0.0, 0.3])
def test_base_times_scale_is_that_of_the_processor(engine: GpuEngine, segment: float) -> None:
    transport = any_windows(8, mosaic=True, segment=segment)
    rng = np.random.default_rng(8)
    black = np.full((*transport.camera_shape, 3), 0.001, np.float32)
    base = solve_base(transport, 0.4 * transport.reach() + black, black, SolveSettings(tolerance=1e-3))
    for _ in range(2):
        target = black + transport.reach() * rng.uniform(0, 0.9, black.shape).astype(np.float32)
        there, here = (scale_frames(transport, base, target, black, engine=which) for which in (engine, None))
        np.testing.assert_allclose(frame_planes(there), frame_planes(here), atol=1e-5)


def test_a_second_base_and_a_second_stage_take_the_place_of_the_first(engine: GpuEngine, device: Device) -> None:
    before = device.held_bytes
    held = []
    for seed in (8, 9, 8):
        transport = any_windows(seed, mosaic=True)
        black = np.zeros((*transport.camera_shape, 3), np.float32)
        for level in (0.3, 0.5):
            base = solve_base(
                transport, level * transport.reach(), black, SolveSettings(tolerance=1e-2), SolveContext(engine=engine)
            )
            target = 0.3 * transport.reach()
            there, here = (scale_frames(transport, base, target, black, engine=which) for which in (engine, None))
            np.testing.assert_allclose(frame_planes(there), frame_planes(here), atol=1e-5)
            held.append(device.held_bytes - before)
    assert held[0] == held[1] == held[4]


# what a device refuses


def solved(
    stage: tuple[Calibration, LightTransport],
    engine: GpuEngine | None,
    progress: Callable[[int, float], None] | None = None,
) -> Sequence[FloatImage]:
    calibration, transport = stage
    target = unreachable_in_parts(transport, calibration.black)
    return solve_bounded(
        transport,
        target,
        calibration.black,
        SolveSettings(tolerance=0, most_iterations=30),
        SolveContext(engine=engine, progress=progress),
    ).frames


def test_a_device_lost_in_the_middle_leaves_the_solve_to_the_processor(
    stage: tuple[Calibration, LightTransport],
) -> None:
    own, notes = opened(), list[str]()
    lost: list[int] = []

    def pull_out(iteration: int, kkt: float) -> None:
        if iteration >= 4 and not lost:
            lost.append(iteration)
            own.close()

    engine = GpuEngine(own, notes.append)
    found = solved(stage, engine, progress=pull_out)
    assert lost
    assert engine.worked == "processor"
    np.testing.assert_array_equal(frame_planes(found), frame_planes(solved(stage, None)))
    assert notes[-1].startswith(f"The processor solves instead of {own.name}: the graphics processor could not ")
    told = len(notes)
    np.testing.assert_array_equal(frame_planes(solved(stage, engine)), frame_planes(solved(stage, None)))
    assert len(notes) == told, "one note is enough"


def test_a_device_without_room_leaves_the_solve_to_the_processor(
    stage: tuple[Calibration, LightTransport], device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    notes: list[str] = []
    held = device.held_bytes
    monkeypatch.setattr(device, "most_bytes", 5000)
    engine = GpuEngine(device, notes.append)
    np.testing.assert_array_equal(frame_planes(solved(stage, engine)), frame_planes(solved(stage, None)))
    assert len(notes) == 1
    assert "in one piece" in notes[0]
    assert device.held_bytes == held


@few
@given(seed=st.integers(0, 2**20), mosaic=st.booleans())
def test_the_weights_of_smoothness_are_those_of_the_reference(device: Device, seed: int, mosaic: bool) -> None:
    """Paper 2.4, eq. 3: the same reference in NumPy that the processor's loop is tested against."""
    transport = any_windows(seed, mosaic=mosaic)
    black = np.zeros((*transport.camera_shape, 3), np.float32)
    pattern = np.random.default_rng(seed).uniform(0.2, 1, black.shape).astype(np.float32)
    target = transport.reach() * pattern
    there = DeviceEquations(DeviceTransport(device, transport))
    there.build(SolveInput(transport, target, black, SMOOTHNESS, None, None))
    dark = build_problem(transport, target, black, SMOOTHNESS, None).majoriser == 0
    for n, (one, size) in enumerate(zip(there.projectors, transport.sizes, strict=True)):
        packed = device.read(one.edge_weights, 3 * one.pixels).view(np.uint32).reshape(3, *size)
        white = transport.forward_part(n, np.ones((*size, 3), np.float32))
        expected = smoothness_weights(transport.gaussian_mean(target, n), transport.gaussian_mean(white, n))
        lit = ~np.moveaxis(dark[:, transport.span(n)].reshape(3, *size), 0, 2)
        found = np.moveaxis(packed, 0, 2)
        across, down = (part / EDGE_WEIGHT_STEPS for part in (found[:, :-1] & 0xFFFF, found[:-1] >> 16))
        np.testing.assert_allclose(across, expected.across**2 * (lit[:, 1:] & lit[:, :-1]), atol=1e-3)
        np.testing.assert_allclose(down, expected.down**2 * (lit[1:] & lit[:-1]), atol=1e-3)
    there.free()


def test_no_shader_declares_a_constant_of_its_own() -> None:
    shaders = Path(gpu.__file__).parent / "shaders"
    for shader in shaders.glob("*.wgsl"):
        assert not re.search(r"^const ", shader.read_text("utf-8"), re.MULTILINE), shader.name
