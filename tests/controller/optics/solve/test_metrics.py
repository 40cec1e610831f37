"""Figures of a result: colour difference against a published pair, error, sharpness."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from skimage.color import deltaE_ciede2000, rgb2lab
from skimage.metrics import structural_similarity as scikit_images_similarity

from controller.core.errors import UsageError
from controller.optics.solve.result.metrics import colour_difference, compare, sharpness
from lab.study.subject.likeness import lab_of, structural_similarity

SRGB = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)


def linear_picture(seed: int = 0) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    y, x = np.mgrid[0:50, 0:60]
    checks = ((x // 10 + y // 10) % 2)[..., None] * np.array([0.5, 0.4, 0.3])
    return np.asarray(0.1 + checks + 0.01 * np.random.default_rng(seed).random((50, 60, 3)), np.float32)


def test_lab_agrees_with_an_independent_conversion_and_with_any_exposure() -> None:
    linear = np.random.default_rng(0).random((5, 6, 3)).astype(np.float32)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(lab_of(linear * 0.3, SRGB, 0.3), rgb2lab(encoded), atol=0.05)


def test_structural_similarity_agrees_with_scikit_images() -> None:
    one = np.clip(linear_picture(), 0, 1)
    other = np.clip(one + np.random.default_rng(1).normal(0, 0.1, one.shape), 0, 1).astype(np.float32)
    _, theirs = scikit_images_similarity(  # type: ignore[no-untyped-call]
        one, other, channel_axis=2, data_range=1.0, gaussian_weights=True, use_sample_covariance=False, full=True
    )
    ours = structural_similarity(one, other)
    np.testing.assert_allclose(ours, theirs, atol=1e-5)
    assert ours.min() < 0.5 < ours.max()


def test_a_published_pair_has_its_published_difference() -> None:
    # Sharma, Wu and Dalal 2005, table 1, pair 17: dE00 = 27.1492.
    pair = np.array([[50.0, 2.5, 0.0], [73.0, 25.0, -18.0]])
    f = np.stack(
        [
            (pair[:, 0] + 16) / 116 + pair[:, 1] / 500,
            (pair[:, 0] + 16) / 116,
            (pair[:, 0] + 16) / 116 - pair[:, 2] / 200,
        ],
        1,
    )
    xyz = np.where(f > 6 / 29, f**3, 3 * (6 / 29) ** 2 * (f - 4 / 29))
    a, b = (row.astype(np.float32).reshape(1, 1, 3) for row in xyz)
    difference = colour_difference(a, b, np.eye(3), 1.0, np.ones((1, 1), np.bool_))
    assert difference[0, 0] == pytest.approx(27.1492, abs=1e-3)


def test_differences_are_those_of_an_independent_formula_also_of_greys_black_and_hues_across_the_circle() -> None:
    rng = np.random.default_rng(3)
    one = (rng.random((60, 70, 3)) ** 2).astype(np.float32)
    other = np.clip(one + 0.1 * rng.normal(size=one.shape), -0.1, 1).astype(np.float32)
    one[:4], other[2:6], one[8:10], other[9:12] = 0, 0.3, 0.5, 0
    found = colour_difference(one, other, SRGB, 0.7, np.ones((60, 70), np.bool_))
    expected = deltaE_ciede2000(lab_of(one, SRGB, 0.7), lab_of(other, SRGB, 0.7))  # type: ignore[no-untyped-call]
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)


def test_a_perfect_result_has_no_error_and_all_its_edges() -> None:
    picture = linear_picture()
    result = compare(picture, picture, SRGB, 1.0, np.ones((50, 60), np.bool_))
    assert (result.delta_e00_median, result.delta_e00_p95, result.rmse) == (0, 0, 0)
    assert result.sharpness_lambda == 1


def test_only_the_mask_counts() -> None:
    picture, wrong = linear_picture(), linear_picture()
    mask = np.ones((50, 60), np.bool_)
    mask[:20] = False
    wrong[:20] = 5
    result = compare(wrong, picture, SRGB, 1.0, mask)
    assert result.rmse == 0
    assert not result.error_map.any()


def test_blur_lowers_the_sharpness_and_a_flat_result_has_none() -> None:
    picture, mask = linear_picture(), np.ones((50, 60), np.bool_)
    assert sharpness(np.full_like(picture, 0.3), picture, 1.0, mask) < 0.05
    assert sharpness(np.roll(picture, 3, 1), picture, 1.0, mask) < 0.7


def dotted(period_px: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """Dots so dense that much more than a tenth of the picture is edge, all of one strength; soft as a camera's."""
    y, x = np.mgrid[0:150, 0:200]
    off = [np.abs((axis + period_px / 2) % period_px - period_px / 2) for axis in (y, x)]
    dots = ndimage.gaussian_filter((np.hypot(*off) < period_px / 3).astype(np.float32), 0.8)
    return np.asarray(0.7 - 0.5 * dots[..., None] * np.ones(3), np.float32)


@settings(max_examples=25, deadline=None)
@given(period_px=st.floats(14, 26), contrast=st.floats(0.8, 1.0))
def test_edges_of_a_dense_pattern_are_there_though_its_contrast_is_less(period_px: float, contrast: float) -> None:
    picture, mask = dotted(period_px), np.ones((150, 200), np.bool_)
    paler = picture.mean() + np.float32(contrast) * (picture - picture.mean())
    assert sharpness(paler, picture, 1.0, mask) > 0.85
    assert sharpness(np.roll(paler, round(period_px / 4), 1), picture, 1.0, mask) < 0.5


@settings(max_examples=25, deadline=None)
@given(period_px=st.floats(12, 20), contrast=st.floats(0.8, 1.0), steps=st.integers(0, 4))
def test_a_few_stronger_edges_do_not_hide_those_of_a_pattern(period_px: float, contrast: float, steps: int) -> None:
    picture, mask = 0.4 + 0.4 * dotted(period_px), np.ones((150, 200), np.bool_)
    for step in range(steps):
        # As at an object's own folds and borders: a few of the edges, and three times as strong as the pattern's.
        picture[:, 10 * step : 10 * step + 5] = 0.02
    paler = picture.mean() + np.float32(contrast) * (picture - picture.mean())
    assert sharpness(paler, picture, 1.0, mask) > 0.85


def test_an_empty_mask_is_refused() -> None:
    picture = linear_picture()
    with pytest.raises(UsageError) as refused:
        compare(picture, picture, SRGB, 1.0, np.zeros((50, 60), np.bool_))
    assert refused.value.code == "nothing-to-compare"
