from __future__ import annotations

import numpy as np
import pytest

from controller.core.errors import TroubleCode
from controller.optics.capture.linearity import (
    RawExposure,
    black_offset,
    camera_faults,
    check_series,
    common_limit,
    exposure_ratio,
    find_hot,
    true_exposures,
)
from tests.controller.optics.capture.sensor_model import SensorModel, textured

LIGHT = textured()


def test_exposures_that_the_camera_tells_wrongly_are_measured() -> None:
    """A camera that says 1/30 s and opens for 1/32 s: 6 % that a merge of brackets would otherwise show as a step."""
    model = SensorModel()
    series = [model.expose(LIGHT, 1 / 32, 1, told_s=1 / 30), model.expose(LIGHT, 1 / 8, 2)]
    found = check_series(series, model.levels)
    assert found.nominal[1] == pytest.approx(30 / 8)
    assert found.ratios[1] == pytest.approx(4.0, rel=0.003)
    assert found.worst < 0.01


def test_a_highlight_that_moved_between_two_exposures_does_not_change_their_ratio() -> None:
    model = SensorModel()
    moved = LIGHT.copy()
    moved[: len(moved) // 5] = np.minimum(1.5 * moved[: len(moved) // 5], LIGHT.max())
    shorter, longer = model.expose(LIGHT, 0.01, 1), model.expose(moved, 0.04, 2)
    assert exposure_ratio(shorter, longer, model.levels) == pytest.approx(4.0, rel=0.003)


def test_the_ceiling_is_found_where_the_sensor_has_it_and_not_where_the_file_says() -> None:
    model = SensorModel(ceiling=3600)
    series = [model.expose(LIGHT, t, n) for n, t in enumerate((0.01, 0.04, 0.16))]
    found = check_series(series, model.levels)
    assert np.all((found.clip > 3450) & (found.clip <= 3600))


@pytest.mark.parametrize("well", [3850, 3700])
def test_wells_that_differ_from_pixel_to_pixel_are_no_nonlinearity_below_them(well: int) -> None:
    model, series = SensorModel(), []
    for n, exposure_s in enumerate((0.01, 0.04, 0.16)):
        seen = model.expose(LIGHT, exposure_s, n)
        full = np.random.default_rng(9 + n).normal(well, 40, seen.samples.shape).astype(np.uint16)
        series.append(RawExposure(np.minimum(seen.samples, full), exposure_s))
    found = check_series(series, model.levels)
    assert np.all((found.clip > well - 130) & (found.clip < well))
    assert found.worst < 0.01


def test_a_sensor_that_bends_before_it_clips_is_trusted_only_below() -> None:
    straight, bent = SensorModel(), SensorModel(bend=0.1)
    for model, low, high in ((straight, 3900, 4095), (bent, 2600, 3350)):
        series = [model.expose(LIGHT, t, n) for n, t in enumerate((0.01, 0.04, 0.16))]
        found = check_series(series, model.levels)
        assert np.all((found.clip > low) & (found.clip <= high)), found.clip
        assert found.worst < 0.01


def test_a_series_that_stays_dark_claims_no_limit() -> None:
    model = SensorModel()
    dim = LIGHT * 0.001
    found = check_series([model.expose(dim, 0.1, 1), model.expose(dim, 0.4, 2)], model.levels)
    assert np.isinf(found.clip).all()
    assert found.ratios == pytest.approx(found.nominal)


@pytest.mark.parametrize("black", [128.0, 131.5, 120.0])
def test_the_black_level_is_measured_under_ambient_light(black: float) -> None:
    model = SensorModel(black=black)
    ambient = 0.002 + 0.01 * textured(high=1.0)
    series = [model.expose(ambient, t, n) for n, t in enumerate((0.5, 2.0))]
    np.testing.assert_allclose(black_offset(series, model.levels), black - 128, atol=0.15)


def test_one_exposure_or_a_lamp_that_went_on_leaves_the_files_black_level() -> None:
    model = SensorModel()
    series = [model.expose(LIGHT, 0.02, 1), model.expose(LIGHT * 0.1, 0.08, 2)]
    assert not black_offset(series[:1], model.levels).any()
    assert not black_offset(series, model.levels).any()


def test_hot_samples_are_found_and_edges_grain_and_single_hits_are_not() -> None:
    model = SensorModel()
    ambient = 0.002 + 0.01 * textured(high=1.0)
    ambient[100:, 200:] *= 8
    series = [model.expose(ambient, t, n) for n, t in enumerate((0.5, 2.0))]
    rng = np.random.default_rng(3)
    hot = np.unique(np.stack((rng.integers(2, 318, 40), rng.integers(2, 238, 40)), axis=1), axis=0)
    for one in series:
        one.samples[hot[:, 1], hot[:, 0]] = np.minimum(one.samples[hot[:, 1], hot[:, 0]] + 900, 4095)
    series[0].samples[50, 50] = 4000
    found = find_hot(series, model.levels)
    assert {tuple(px) for px in found.tolist()} == {tuple(px) for px in hot.tolist()}
    assert not len(find_hot([], model.levels))


def test_only_exposures_that_are_told_noticeably_wrong_are_corrected() -> None:
    told = [1 / 30, 1 / 8, 1 / 4]
    right = [((told[0], told[1]), (1.0, 30 / 8 * 1.004)), ((told[1], told[2]), (1.0, 2.0))]
    assert not len(true_exposures(right))
    wrong = [((told[0], told[1]), (1.0, 4.0)), ((told[1], told[2]), (1.0, 2.0))]
    corrected = true_exposures(wrong)
    np.testing.assert_allclose(corrected[:, 0], told)
    np.testing.assert_allclose(corrected[1:, 1] / corrected[:-1, 1], (4.0, 2.0))
    assert np.prod(corrected[:, 1] / corrected[:, 0]) == pytest.approx(1.0)


Series = list[tuple[list[float], list[float]]]


def drawn_series(rng: np.random.Generator, flicker: float, wrong: float) -> tuple[Series, dict[float, float]]:
    """Three projectors' exposures and ratios, and how long each exposure really is; relative standard deviations."""
    true: dict[float, float] = {}
    series: Series = []
    for _ in range(3):
        first = int(rng.integers(3))
        exposures = [2.0 ** ((first + 5 * step) / 3) / 16 for step in range(3)]
        for one in exposures:
            true.setdefault(one, one * float(np.exp(wrong * rng.standard_normal())))
        seen = [true[one] * (1 + flicker * rng.standard_normal()) for one in exposures]
        series.append((exposures, [one / seen[0] for one in seen]))
    return series, true


def test_a_lamp_that_flickers_is_hardly_ever_taken_for_wrong_exposure_times() -> None:
    rng = np.random.default_rng(7)
    assert sum(len(true_exposures(drawn_series(rng, 0.007, 0.0)[0])) > 0 for _ in range(2000)) < 80


def test_wrong_exposure_times_are_found_beside_a_lamp_that_flickers() -> None:
    rng = np.random.default_rng(7)
    drawn = [drawn_series(rng, 0.007, 0.03) for _ in range(200)]
    corrected = [(true_exposures(series), true) for series, true in drawn]
    found = [(one, true) for one, true in corrected if len(one)]
    assert len(found) > 180
    left = [np.log(one[:, 1] / [true[reported] for reported in one[:, 0]]) for one, true in found]
    before = [np.log([true[reported] / reported for reported in one[:, 0]]) for one, true in found]
    assert np.mean([one.std() for one in left]) < 0.5 * np.mean([one.std() for one in before])


def test_a_limit_seen_once_too_low_does_not_count() -> None:
    high, low, none = np.full((2, 2), 4000.0), np.full((2, 2), 1700.0), np.full((2, 2), np.inf)
    np.testing.assert_array_equal(common_limit([low, high, none]), high)
    np.testing.assert_array_equal(common_limit([none]), none)
    np.testing.assert_array_equal(common_limit([]), none)


def test_faults_of_a_camera_are_named() -> None:
    sound = np.empty((0, 2))
    assert not camera_faults(sound, 3, 400_000)
    said = camera_faults(np.array([[0.1, 0.101], [0.4, 0.392]]), 80, 400_000)
    assert "3.0 %" in said[TroubleCode.EXPOSURE_TIMES]
    assert "80 pixels" in said[TroubleCode.HOT_PIXELS]
    assert list(camera_faults(sound, 80, 400_000)) == [TroubleCode.HOT_PIXELS]
