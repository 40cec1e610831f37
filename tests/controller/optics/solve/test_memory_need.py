"""What a solve says that it needs, against what its arrays take."""

from __future__ import annotations

import dataclasses
import gc
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from controller.core.errors import WorkError
from controller.optics.calibrate.values import Calibration, SurfaceSpread
from controller.optics.solve.appearance import StageLight, base_image, solve_base
from controller.optics.solve.bounded.engine import SolveContext
from controller.optics.solve.bounded.equations import SolveSettings
from controller.optics.solve.memory_need import (
    PROGRAM,
    SPARE,
    appearance_peak_bytes,
    base_peak_bytes,
    calibration_peak_bytes,
    check_memory,
    planned_size,
    solve_peak_bytes,
    stage_size,
)
from controller.optics.solve.request import SolveOptions, solve_appearance
from controller.optics.solve.result.common_causes import equations
from controller.optics.solve.result.refinement import ModelError, RefinedStage, corrected_target
from controller.optics.solve.targets.values import Target
from controller.optics.transport import build_transport
from controller.optics.transport.indirect.indirect_light import IndirectLight
from controller.optics.transport.indirect.surface_light import SurfaceLight
from lab.timings.tools.synthetic import synthetic_calibration


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    # as many camera pixels for each projector pixel as at paper size
    made = synthetic_calibration(projector=(186, 246), camera=(460, 688))
    _solved_bytes(made)  # compiled, and tables made
    return made


def _peak_bytes(work: Callable[[], object]) -> int:
    """Of arrays, while this is done, or since ``work`` last reset the peak."""
    gc.collect()
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def _solved_bytes(calibration: Calibration) -> int:
    def solve() -> None:
        base = solve_base(
            build_transport(calibration), base_image(calibration), calibration.black, SolveSettings(tolerance=0.1)
        )
        assert base.solution.iterations < 10

    return _peak_bytes(solve)


def _indirect(calibration: Calibration, *, has_paint: bool, has_spread: bool) -> IndirectLight:
    lit, side = calibration.object_mask, 30
    grid = -(-lit.shape[0] // side), -(-lit.shape[1] // side)
    factors = np.full((grid[0] * grid[1],) * 2, 0.2 / (grid[0] * grid[1]), np.float32)
    scale = np.where(lit[..., None], 0.2, 0).astype(np.float32) * np.ones(3, np.float32)
    white = np.sum([part.white for part in calibration.projectors], axis=0)
    paint = np.full((3, 3, *lit.shape), 0.01, np.float16) if has_paint else None
    surface = SurfaceLight.of(SurfaceSpread(0.3, 5.0, 2.0), white, lit) if has_spread else None
    return IndirectLight(factors, scale, lit, grid, side, paint=paint, surface=surface)


def _appearance_bytes(calibration: Calibration, know: Callable[[], IndirectLight | None], folder: Path) -> int:
    def solve() -> None:
        transport = build_transport(calibration)
        indirect = know()
        tracemalloc.reset_peak()
        shape = calibration.black.shape
        solve_appearance(
            StageLight(transport, calibration.black, None if indirect is None else indirect.in_files(folder)),
            Target(np.random.default_rng(1).random(shape, np.float32), np.ones(shape[:2], np.bool_)),
            SolveOptions(share=0.9, smoothness=1e-3, adapt=1.0),
            context=SolveContext(folder=folder),
        )

    return _peak_bytes(solve)


def test_the_need_stated_covers_what_is_taken_and_is_not_far_above(calibration: Calibration) -> None:
    stated = base_peak_bytes(stage_size(calibration)) - PROGRAM
    taken = _solved_bytes(calibration)
    assert taken <= stated <= 1.25 * SPARE * taken


@pytest.mark.parametrize("known", [(), ("indirect",), ("indirect", "paint", "spread")], ids=str)
def test_the_need_of_an_appearance_covers_what_is_taken_and_is_not_far_above(
    calibration: Calibration, tmp_path: Path, known: tuple[str, ...]
) -> None:
    size = dataclasses.replace(stage_size(calibration), **{f"has_{name}": True for name in known})

    def know() -> IndirectLight | None:
        if not known:
            return None
        return _indirect(calibration, has_paint="paint" in known, has_spread="spread" in known)

    taken = _appearance_bytes(calibration, know, tmp_path)
    stated = appearance_peak_bytes(size) - PROGRAM
    assert taken <= stated <= 1.25 * SPARE * taken


def test_a_refinement_needs_few_pictures_at_once(calibration: Calibration) -> None:
    transport, rng = build_transport(calibration), np.random.default_rng(0)
    frames = [rng.random((*part.metapixels.valid.shape, 3), np.float32) for part in calibration.projectors]
    white = np.maximum(np.sum([part.white for part in calibration.projectors], axis=0), 0)
    stage, trusted = RefinedStage(calibration.black, white), calibration.object_mask
    error = (0.01 * rng.standard_normal(white.shape)).astype(np.float32)
    picture = 12 * trusted.size

    # before, all images of all causes and all bands of the error were there at once: 30 and 16 pictures
    assert _peak_bytes(lambda: equations(transport, frames, error, stage, trusted)) < 14 * picture
    seen = ModelError(error, np.full_like(error, 0.005))
    assert _peak_bytes(lambda: corrected_target(0.3 * white, seen, stage)) < 14 * picture


def test_four_projectors_of_3840_by_2160_are_within_8_gb() -> None:
    assert solve_peak_bytes(planned_size((8192, 5464), [(3840, 2160)] * 4)) < 8e9


def test_calibrating_with_45_megapixels_is_within_4_gb_and_can_need_more_than_the_solve() -> None:
    assert calibration_peak_bytes(planned_size((8192, 5464), [(3840, 2160)] * 4)) < 5e9
    small = planned_size((8192, 5464), [(800, 600)])
    assert calibration_peak_bytes(small) > solve_peak_bytes(small)
    with pytest.raises(WorkError, match="The calibration needs about"):
        check_memory(calibration_peak_bytes(small), 1_000_000_000, "The calibration")


def test_what_does_not_fit_is_refused_and_what_is_not_known_is_not() -> None:
    with pytest.raises(WorkError) as refused:
        check_memory(2_000_000_001, 2_000_000_000)
    assert refused.value.code == "memory-too-small"
    assert "2.0 GB" in refused.value.what
    assert "3.0 GB are free" in check_memory(2_000_000_000, 3_000_000_000)
    assert "not known" in check_memory(2_000_000_000, None)
