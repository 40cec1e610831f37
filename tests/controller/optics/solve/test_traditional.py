"""Traditional compensation: right for a smooth target under one projector, and nothing more."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from controller.core.errors import UsageError
from controller.optics.calibrate.values import Calibration
from controller.optics.solve.appearance import traditional_compensation
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.transport import build_transport

Stage = Callable[..., Calibration]


def test_a_smooth_reachable_ratio_is_made_by_one_projector_alone(stage: Stage) -> None:
    calibration = stage(spill=0.2)
    transport = build_transport(calibration)
    target = calibration.black + 0.5 * calibration.projectors[1].white
    frames = traditional_compensation(calibration, target, 1)
    assert not frames[0].any()
    lit = transport.lit[1]
    np.testing.assert_allclose(transport.forward(frames)[lit], 0.5 * calibration.projectors[1].white[lit], rtol=1e-4)


def test_it_is_clipped_and_stays_finite_where_there_is_no_light(stage: Stage) -> None:
    calibration = stage()
    white = calibration.projectors[0].white.copy()
    white[:, :30] = 0
    projectors = (dataclasses.replace(calibration.projectors[0], white=white), calibration.projectors[1])
    target = np.full((60, 80, 3), 3, np.float32)
    frame = traditional_compensation(dataclasses.replace(calibration, projectors=projectors), target, 0)[0]
    assert np.isfinite(frame).all()
    assert frame.min() >= 0
    assert frame.max() <= 1


def test_the_global_solve_is_much_nearer_to_a_target_with_detail(stage: Stage) -> None:
    calibration = stage()
    transport = build_transport(calibration)
    rng = np.random.default_rng(0)
    frames = [(0.2 + 0.6 * rng.random((*size, 3))).astype(np.float32) for size in transport.sizes]
    target = transport.forward(frames) + calibration.black
    mask = transport.object_mask

    def error(light: np.ndarray[tuple[int, ...], np.dtype[np.float32]]) -> float:
        return float(((light + calibration.black - target)[mask] ** 2).mean() ** 0.5)

    solved = solve_bounded(transport, target, calibration.black)
    traditional = transport.forward(traditional_compensation(calibration, target, 1))
    assert error(transport.forward(solved.frames)) < error(traditional) / 3


def test_an_unknown_projector_is_refused(stage: Stage) -> None:
    calibration = stage()
    with pytest.raises(UsageError) as refused:
        traditional_compensation(calibration, calibration.black, 2)
    assert refused.value.code == "projector-unknown"
