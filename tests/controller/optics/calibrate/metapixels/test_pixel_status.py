"""Reasons why projector pixels are missing or not to be trusted."""

from __future__ import annotations

import numpy as np

from controller.optics.calibrate.metapixels.pixel_status import PixelStatus, pixel_status, status_counts
from controller.optics.calibrate.values import Metapixels


def grid(rows: int = 30, columns: int = 40, spacing: float = 3.0) -> Metapixels:
    y, x = np.mgrid[0:rows, 0:columns].astype(np.float32)
    covariance = np.broadcast_to(np.array([1.5, 0, 1.5], np.float32), (rows, columns, 3)).copy()
    return Metapixels(np.stack([spacing * x, spacing * y], axis=-1), covariance, np.ones((rows, columns), np.bool_))


def white_of(rows: int = 90, columns: int = 120) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    return np.ones((rows, columns, 3), np.float32)


def test_a_plain_surface_is_good_everywhere() -> None:
    assert status_counts(pixel_status(grid(), white_of()))["good"] == 30 * 40


def test_a_gap_within_is_shadow_and_what_lies_past_the_object_is_outside() -> None:
    pixels = grid()
    pixels.valid[10:20, 15:22] = False
    pixels.valid[:, 36:] = False
    found = pixel_status(pixels, white_of())
    assert (found[10:20, 15:22] == PixelStatus.SHADOW).all()
    assert (found[:, 36:] == PixelStatus.OUTSIDE).all()
    assert status_counts(found)["good"] == 30 * 36 - 70


def test_a_surface_that_is_seen_too_slantingly_is_grazing_and_stays_valid() -> None:
    pixels = grid()
    x = pixels.centre_px[..., 0].copy()
    pixels.centre_px[..., 0] = np.where(np.arange(40) < 20, x, 60 + (x - 60) / 6)
    found = pixel_status(pixels, white_of())
    assert (found[:, 24:] == PixelStatus.GRAZING).all()
    assert (found[:, :16] == PixelStatus.GOOD).all()


def test_pixels_whose_white_was_saturated_in_every_exposure_are_named_so_even_where_nothing_was_fitted() -> None:
    pixels = grid()
    pixels.valid[14:16, 19:21] = False
    white = white_of()
    white[40:50, 55:65, 1] = np.nan
    found = pixel_status(pixels, white)
    assert (found[14:16, 19:21] == PixelStatus.SATURATED).all()
    assert found[2, 2] == PixelStatus.GOOD
    assert 9 <= status_counts(found)["saturated"] <= 36
