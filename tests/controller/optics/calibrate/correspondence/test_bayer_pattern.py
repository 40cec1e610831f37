"""Which colour each camera sample has, found from a photograph alone."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from controller.optics.calibrate.metapixels.from_phase import PATTERNS, find_bayer_pattern
from controller.optics.capture.raw import develop


def photograph(pattern: npt.NDArray[np.int64], *, seed: int = 1) -> npt.NDArray[np.float32]:
    raw = np.random.default_rng(seed).integers(500, 60000, (120, 150)).astype(np.uint16)
    return develop(raw, pattern, np.zeros((2, 2)), np.full((2, 2), 65535.0)).image


@pytest.mark.parametrize("pattern", PATTERNS)
def test_the_pattern_is_found(pattern: tuple[tuple[int, int], ...]) -> None:
    colours = np.array(pattern, np.int64)
    found = find_bayer_pattern(photograph(colours))
    assert found is not None
    np.testing.assert_array_equal(found, colours)


def test_pixels_that_were_not_measured_do_not_hide_it() -> None:
    image = photograph(np.array(PATTERNS[2]))
    image[np.random.default_rng(2).random(image.shape[:2]) < 0.05] = np.nan
    found = find_bayer_pattern(image)
    assert found is not None
    np.testing.assert_array_equal(found, PATTERNS[2])


def test_another_unit_does_not_matter() -> None:
    found = find_bayer_pattern(np.float32(1e-4) * photograph(np.array(PATTERNS[1])))
    assert found is not None


def test_pictures_that_were_not_interpolated_have_none() -> None:
    random = np.random.default_rng(3)
    assert find_bayer_pattern(random.random((120, 150, 3), np.float32)) is None
    assert find_bayer_pattern(random.random((120, 150), np.float32)) is None
    assert find_bayer_pattern(np.ones((120, 150, 3), np.float32)) is None
    assert find_bayer_pattern(np.zeros((120, 150, 3), np.float32)) is None
    assert find_bayer_pattern(np.full((120, 150, 3), np.nan, np.float32)) is None
    assert find_bayer_pattern(np.ones((2, 2, 3), np.float32)) is None
