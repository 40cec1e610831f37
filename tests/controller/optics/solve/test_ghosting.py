"""Ghosting: the object's own pattern in a photograph's error, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.core.arrays import FloatImage, Mask
from controller.optics.solve.result.ghosting import Ghosting, ghosting

SHAPE = (160, 240)
MATRIX = np.array([[0.41, 0.36, 0.18], [0.21, 0.72, 0.07], [0.02, 0.12, 0.95]])
EVERYWHERE: Mask = np.ones(SHAPE, np.bool_)


def paint(seed: int, colour: tuple[float, float, float] = (0.4, 0.5, 0.9)) -> FloatImage:
    """White with spots of a colour, of about 3 % of the picture."""
    import cv2

    spots = cv2.GaussianBlur(np.random.default_rng(seed).random(SHAPE), (0, 0), 3)
    on = (spots > np.median(spots))[..., None]
    soft = cv2.GaussianBlur(np.where(on, np.array(colour), 0.9), (0, 0), 1)
    return np.asarray(soft, np.float32)


def measured(photograph: FloatImage, asked: FloatImage, own: FloatImage, lacking: Mask = EVERYWHERE) -> Ghosting:
    found = ghosting(photograph, asked, own, MATRIX, 2.0, EVERYWHERE, lacking)
    assert found is not None
    return found


@settings(max_examples=12, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10_000), showing=st.floats(0.2, 1.0), scale=st.floats(0.3, 3.0))
def test_as_much_of_the_pattern_as_shows_is_found_at_any_brightness(seed: int, showing: float, scale: float) -> None:
    own = paint(seed)
    asked = np.full((*SHAPE, 3), scale, np.float32)
    found = measured(asked * own ** np.float32(showing), asked, own)
    assert found.both.correlation > 0.97
    assert found.both.share == pytest.approx(showing, rel=0.06)
    assert found.chroma.share == pytest.approx(showing, rel=0.1)
    assert found.lightness.share == pytest.approx(showing, rel=0.06)


@settings(max_examples=12, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10_000))
def test_errors_that_are_not_the_objects_pattern_are_no_ghosts(seed: int) -> None:
    own, other = paint(seed), paint(seed + 20_000, (0.9, 0.6, 0.4))
    asked = np.full((*SHAPE, 3), 1.0, np.float32)
    wide = np.linspace(0.3, 1.0, SHAPE[1], dtype=np.float32)[None, :, None]
    for picture, share, correlation in ((asked * wide, 0.03, 0.5), (asked * other, 0.25, 0.25)):
        found = measured(picture, asked, own).both
        assert found.share < share
        assert found.correlation < correlation


def test_a_ghost_of_colour_alone_is_one_of_chroma() -> None:
    own = paint(5, (1.1, 0.9, 0.9))
    asked = np.full((*SHAPE, 3), 1.0, np.float32)
    grey = own @ MATRIX[1][:, None].astype(np.float32)
    found = measured(asked * own / grey, asked, own)
    assert found.chroma.correlation > 0.9
    assert found.lightness.share < 0.4 * found.chroma.share


def test_it_is_measured_around_what_is_out_of_reach_alone() -> None:
    own = paint(7)
    asked = np.full((*SHAPE, 3), 1.0, np.float32)
    right = np.zeros(SHAPE, np.bool_)
    right[:, 140:] = True
    photograph = np.where(right[..., None], asked * own, asked).astype(np.float32)
    assert measured(photograph, asked, own, right).both.share > 0.8
    left = measured(photograph, asked, own, np.roll(right, 120, axis=1) & ~right)
    assert left.both.share < 0.1
    assert left.area < 0.6


def test_nothing_is_told_where_nothing_is_lacking_or_the_object_is_plain() -> None:
    asked = np.full((*SHAPE, 3), 1.0, np.float32)
    nowhere = np.zeros(SHAPE, np.bool_)
    assert ghosting(asked, asked, paint(1), MATRIX, 1.0, EVERYWHERE, nowhere) is None
    assert ghosting(0.5 * asked, asked, np.full_like(asked, 0.7), MATRIX, 1.0, EVERYWHERE, EVERYWHERE) is None
    unknown = np.full_like(asked, np.nan)
    assert ghosting(0.5 * asked, asked, unknown, MATRIX, 1.0, EVERYWHERE, EVERYWHERE) is None
