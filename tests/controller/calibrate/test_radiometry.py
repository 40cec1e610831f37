from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.arrays import Float64, FloatImage
from controller.calibrate.radiometry import check_linearity, measure_radiometry, response_curve
from controller.capture.patterns import RAMP_LEVELS, device_frame, plan_patterns
from controller.errors import CalibrationError
from tests.controller.calibrate.simulator import Scene, Stage

LEVELS = np.array(RAMP_LEVELS)
X = np.arange(256) / 255


@functools.cache
def flats() -> dict[str, FloatImage]:
    stage = Stage(Scene())
    plan = plan_patterns(stage.scene.projector_px)
    return {p.name: stage.photograph(device_frame(p, plan.size_px)) for p in plan if not p.needs_response}


def test_response_and_mixing_are_found_within_half_a_percent() -> None:
    radiometry, report = measure_radiometry(flats())
    assert np.max(np.abs(radiometry.response - Scene().response())) < 0.002
    assert np.max(np.abs(radiometry.mixing - np.array(Scene().mixing))) < 0.002
    np.testing.assert_allclose(radiometry.mixing.sum(axis=1), 1)
    assert report.additivity < 0.002
    assert np.all(np.diff(radiometry.response, axis=1) >= 0)
    assert np.all(radiometry.response[:, 0] == 0)
    assert np.all(radiometry.response[:, -1] == 1)


def test_a_reflection_that_only_some_pixels_see_does_not_bend_the_response() -> None:
    captures = dict(flats())
    for level in RAMP_LEVELS:
        image = captures[f"ramp-{level:03d}"].copy()
        image[90:110, 100:160] += 0.2
        captures[f"ramp-{level:03d}"] = image
    radiometry, _ = measure_radiometry(captures)
    assert np.max(np.abs(radiometry.response - Scene().response())) < 0.005


CURVES: dict[str, Callable[[Float64], Float64]] = {
    "gamma 1.8": lambda x: x**1.8,
    "gamma 2.6": lambda x: x**2.6,
    "sRGB": lambda x: np.where(x < 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4),
    "S": lambda x: 3 * x**2 - 2 * x**3,
    "linear": lambda x: x,
}


@pytest.mark.parametrize("curve", CURVES.values(), ids=CURVES)
def test_seven_levels_hold_half_a_percent_for_usual_curves(curve: Callable[[Float64], Float64]) -> None:
    truth = curve(X)
    assert np.max(np.abs(response_curve(LEVELS, truth[LEVELS]) - truth)) < 0.005


@given(st.lists(st.floats(0, 1), min_size=7, max_size=7))
def test_a_response_always_rises_from_black_to_white(light: list[float]) -> None:
    rising = np.sort(np.array(light))
    curve = response_curve(LEVELS, rising)
    assert np.all(np.diff(curve) >= 0)
    assert curve[0] == 0
    assert curve[-1] == 1
    np.testing.assert_allclose(curve[LEVELS], rising, atol=1e-9)


def test_a_response_that_falls_is_refused() -> None:
    with pytest.raises(CalibrationError) as caught:
        response_curve(LEVELS, np.array([0.1, 0.2, 0.6, 0.3, 0.7, 0.8, 0.9]))
    assert caught.value.code == "response-falls"


@pytest.mark.parametrize("name", ["black", "white", "green"])
def test_a_missing_flat_is_named(name: str) -> None:
    captures = {key: image for key, image in flats().items() if key != name}
    with pytest.raises(CalibrationError, match=name):
        measure_radiometry(captures)


def test_too_few_ramp_levels_are_refused() -> None:
    captures = {key: image for key, image in flats().items() if not key.startswith("ramp-1")}
    with pytest.raises(CalibrationError) as caught:
        measure_radiometry({k: v for k, v in captures.items() if k != "ramp-024"})
    assert caught.value.code == "capture-missing"


@pytest.mark.parametrize("value", [0.0, 1.0, np.nan])
def test_a_dead_projector_is_named_as_dark(value: float) -> None:
    captures = {key: np.full_like(image, value) for key, image in flats().items()}
    with pytest.raises(CalibrationError) as caught:
        measure_radiometry(captures)
    assert caught.value.code == "projector-dark"


def test_a_white_segment_in_the_colour_wheel_is_found_out() -> None:
    captures = dict(flats())
    captures["white"] = captures["black"] + 1.3 * (captures["white"] - captures["black"])
    with pytest.raises(CalibrationError) as caught:
        measure_radiometry(captures)
    assert caught.value.code == "colours-do-not-add"


def test_swapped_ramp_captures_are_refused() -> None:
    captures = dict(flats())
    captures["ramp-056"], captures["ramp-220"] = captures["ramp-220"], captures["ramp-056"]
    with pytest.raises(CalibrationError) as caught:
        measure_radiometry(captures)
    assert caught.value.code == "response-falls"


def test_a_linear_camera_is_told_from_a_bent_one() -> None:
    random = np.random.default_rng(3)
    light = random.uniform(0, 0.3, (100, 120, 3)).astype(np.float32)
    long = 3.2 * light
    measured = check_linearity(light, np.where(long < 0.98, long, np.nan).astype(np.float32), 3.0)
    assert measured.ratio == pytest.approx(3.2, rel=1e-4)
    assert measured.worst < 1e-3
    assert check_linearity(light, (long**1.1).astype(np.float32), 3.0).worst > 0.03


def test_linearity_of_a_bracket_without_overlap_is_refused() -> None:
    dark = np.zeros((20, 20, 3), np.float32)
    with pytest.raises(CalibrationError) as caught:
        check_linearity(dark, dark, 2.0)
    assert caught.value.code == "bracket-empty"
