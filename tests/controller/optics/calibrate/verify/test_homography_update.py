from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from controller.core.arrays import Float64
from controller.optics.calibrate.values import Radiometry
from controller.optics.calibrate.verify.drift import update_positions, update_radiometry
from tests.controller.optics.calibrate.spectra import colours

ROWS, COLUMNS = 40, 60
TURN: Float64 = np.array([[1.0, -0.004, 1.3], [0.004, 1.0, -0.8], [1e-5, 0.0, 1.0]])


def camera_of(projector_px: Float64) -> Float64:
    """Where a projector's pixel is seen: a smooth, slightly bent surface."""
    x, y = projector_px[..., 0], projector_px[..., 1]
    return np.stack([20 + 2.0 * x + 0.002 * x * y, 10 + 1.9 * y + 0.1 * x], axis=-1)


def moved(matrix: Float64, at: Float64) -> Float64:
    ones = np.concatenate([at, np.ones((*at.shape[:-1], 1))], axis=-1) @ matrix.T
    return np.asarray(ones[..., :2] / ones[..., 2:])


@pytest.fixture
def pixels() -> dict[str, npt.NDArray[Any]]:
    x, y = np.meshgrid(np.arange(COLUMNS, dtype=float), np.arange(ROWS, dtype=float))
    grid = np.stack([x, y], axis=2)
    return {
        "projector_px": np.full((90, 150, 2), 7.0, np.float32),
        "shown_px": np.full((90, 150, 2), 7.0, np.float32),
        "modulation": np.full((90, 150), 0.5, np.float32),
        "centre_px": camera_of(grid).astype(np.float32),
        "covariance_px2": np.full((ROWS, COLUMNS, 3), 0.4, np.float32),
        "valid": np.ones((ROWS, COLUMNS), np.bool_),
        "colours_px": np.array([(0.3, 0.0), (0.0, 0.0), (0.0, 0.3)]),
    }


def test_metapixels_lie_where_the_turned_projectors_light_now_falls(
    pixels: dict[str, npt.NDArray[Any]],
) -> None:
    found = update_positions(pixels, TURN)
    x, y = np.meshgrid(np.arange(COLUMNS, dtype=float), np.arange(ROWS, dtype=float))
    truth = camera_of(moved(np.asarray(np.linalg.inv(TURN), np.float64), np.stack([x, y], axis=2)))
    np.testing.assert_allclose(found["centre_px"], truth, atol=0.02)
    assert found["valid"].all()
    assert np.isfinite(found["covariance_px2"]).all()


def test_correspondences_are_mapped_and_what_is_kept_by_camera_pixel_stays(
    pixels: dict[str, npt.NDArray[Any]],
) -> None:
    found = update_positions(pixels, TURN)
    for name in ("projector_px", "shown_px"):
        np.testing.assert_allclose(found[name][3, 5], moved(TURN, np.full(2, 7.0)), atol=1e-4)
    for name in ("modulation", "colours_px"):
        np.testing.assert_array_equal(found[name], pixels[name])


def test_pixels_that_were_not_trusted_move_along(
    pixels: dict[str, npt.NDArray[Any]],
) -> None:
    pixels["valid"][10:20, 20:30] = False
    pixels["centre_px"][10:20, 20:30] = np.nan
    shift: Float64 = np.array([[1.0, 0, 5.0], [0, 1.0, 3.0], [0, 0, 1.0]])
    valid = update_positions(pixels, shift)["valid"]
    assert not valid[13:23, 25:35].any()
    assert valid[:12].all()


def test_a_dimmed_channel_changes_the_mixing_and_white_stays_white() -> None:
    mixing = np.array([[0.9, 0.08, 0.02], [0.05, 0.9, 0.05], [0.01, 0.09, 0.9]])
    found = update_radiometry(Radiometry(np.zeros((3, 256)), mixing), (1.0, 1.0, 0.8)).mixing
    np.testing.assert_allclose(found.sum(axis=1), 1)
    assert found[2, 2] / found[2, 1] == pytest.approx(0.8 * mixing[2, 2] / mixing[2, 1])


def test_a_dimmed_channel_changes_colours_on_all_paints_as_their_spectra_say() -> None:
    gain = (1.0, 0.9, 0.7)

    def told_by_white(light: Float64) -> Float64:
        return np.asarray(np.einsum("kjc,jm->kcm", light, np.linalg.inv(light.sum(axis=2))))

    before = Radiometry(np.zeros((3, 256)), colours().sum(axis=1), paint=told_by_white(colours()))
    found = update_radiometry(before, gain).paint
    assert found is not None
    np.testing.assert_allclose(found, told_by_white(colours() * np.array(gain)), atol=1e-9)
