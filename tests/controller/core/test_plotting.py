"""A figure of matplotlib as a picture."""

from __future__ import annotations

import numpy as np

from controller.core.plotting import figure_of, picture_of


def test_a_figure_becomes_its_pixels_with_their_colours_in_order() -> None:
    figure = figure_of((2.0, 1.0), dpi=50)
    figure.set_facecolor("#ff8000")
    axes = figure.add_axes((0.5, 0.0, 0.5, 0.5))
    axes.set_axis_off()
    axes.imshow(np.full((1, 1, 3), (0, 64, 255), np.uint8), aspect="auto")
    picture = picture_of(figure)
    assert picture.shape == (50, 100, 3)
    assert picture.dtype == np.uint8
    assert picture.flags.c_contiguous
    np.testing.assert_array_equal(picture[:20], np.broadcast_to([255, 128, 0], (20, 100, 3)))
    np.testing.assert_array_equal(picture[30:, 55:], np.broadcast_to([0, 64, 255], (20, 45, 3)))
