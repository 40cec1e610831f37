"""What a solve says that it needs, against what its arrays take."""

from __future__ import annotations

import gc
import tracemalloc

import pytest

from benchmarks.lab.synthetic import synthetic_calibration
from controller.calibrate.values import Calibration
from controller.core.errors import WorkError
from controller.solve.appearance import base_image, solve_base
from controller.solve.memory_need import (
    PROGRAM,
    SPARE,
    base_peak_bytes,
    calibration_peak_bytes,
    check_memory,
    planned_size,
    stage_size,
)
from controller.transport import build_transport


def solved_bytes(calibration: Calibration) -> int:
    gc.collect()
    tracemalloc.start()
    try:
        base = solve_base(build_transport(calibration), base_image(calibration), calibration.black, tolerance=0.1)
        assert base.solution.iterations < 10
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_the_need_told_covers_what_is_taken_and_is_not_far_above() -> None:
    # as many camera pixels for each projector pixel as at paper size
    calibration = synthetic_calibration(projector=(186, 246), camera=(460, 688))
    told = base_peak_bytes(stage_size(calibration)) - PROGRAM
    solved_bytes(calibration)  # compiled, and tables made
    taken = solved_bytes(calibration)
    assert taken <= told <= 1.25 * SPARE * taken


def test_four_projectors_of_3840_by_2160_are_within_8_gb() -> None:
    assert base_peak_bytes(planned_size((8192, 5464), [(3840, 2160)] * 4)) < 8e9


def test_calibrating_with_45_megapixels_is_within_4_gb_and_can_need_more_than_the_solve() -> None:
    assert calibration_peak_bytes(planned_size((8192, 5464), [(3840, 2160)] * 4)) < 5e9
    small = planned_size((8192, 5464), [(800, 600)])
    assert calibration_peak_bytes(small) > base_peak_bytes(small)
    with pytest.raises(WorkError, match="The calibration needs about"):
        check_memory(calibration_peak_bytes(small), 1_000_000_000, "The calibration")


def test_what_does_not_fit_is_refused_and_what_is_not_known_is_not() -> None:
    with pytest.raises(WorkError) as refused:
        check_memory(2_000_000_001, 2_000_000_000)
    assert refused.value.code == "memory-too-small"
    assert "2.0 GB" in refused.value.what
    assert "3.0 GB are free" in check_memory(2_000_000_000, 3_000_000_000)
    assert "not known" in check_memory(2_000_000_000, None)
