from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.core.errors import UsageError
from controller.optics.capture.patterns import dot_frame, dot_patterns, dot_spacing


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 60), st.integers(1, 60), st.integers(1, 20))
def test_every_pixel_is_lit_in_just_one_picture_and_never_near_another(width: int, height: int, r: int) -> None:
    lit = np.zeros((height, width), int)
    patterns = dot_patterns((width, height), r)
    assert len({pattern.name for pattern in patterns}) == len(patterns) <= r * r
    for pattern in patterns:
        frame = dot_frame(pattern, (width, height))
        assert set(np.unique(frame)) <= {0, 255}
        rows, columns = np.nonzero(frame[:, :, 0])
        lit[rows, columns] += 1
        for at in (rows, columns):
            steps = np.diff(np.unique(at))
            assert (steps >= r).all()
    np.testing.assert_array_equal(lit, 1)


def test_the_papers_projector_takes_256_pictures() -> None:
    assert len(dot_patterns((1400, 1050))) == 256


@pytest.mark.parametrize(("sigma_px", "r"), [(0.0, 4), (0.45, 4), (0.93, 7), (1.2, 8), (2.46, 16)])
def test_the_spacing_follows_the_blur(sigma_px: float, r: int) -> None:
    assert dot_spacing(sigma_px) == r


@pytest.mark.parametrize("sigma_px", [float("nan"), float("inf"), -1.0])
def test_a_blur_that_is_no_blur_is_refused(sigma_px: float) -> None:
    with pytest.raises(UsageError) as refused:
        dot_spacing(sigma_px)
    assert refused.value.code == "dot-blur-unknown"


def test_dots_without_distance_are_refused() -> None:
    with pytest.raises(UsageError) as refused:
        dot_patterns((100, 80), 0)
    assert refused.value.code == "dot-spacing-wrong"
