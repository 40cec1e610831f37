from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from controller.core.arrays import Float64, FloatImage
from controller.optics.calibrate.verify.registration import register
from controller.optics.capture.pattern_frames import frame
from controller.optics.capture.patterns import Pattern, PatternKind

ROWS, COLUMNS = 150, 200
PICTURE: FloatImage = cv2.GaussianBlur(
    frame(Pattern("r", PatternKind.RANDOM, seed=3), (COLUMNS, ROWS)), (0, 0), 0.7
).astype(np.float32)
Y, X = np.mgrid[0:ROWS, 0:COLUMNS].astype(np.float32)
KNOWN = (((X - 100) ** 2 / 80**2 + (Y - 75) ** 2 / 65**2) < 1).astype(np.float32)


def similarity(shift: tuple[float, float], degrees: float = 0.0, scale: float = 1.0) -> Float64:
    """About the picture's middle."""
    angle, middle = math.radians(degrees), np.array([99.5, 74.5])
    turn = scale * np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    matrix = np.eye(3)
    matrix[:2, :2] = turn
    matrix[:2, 2] = middle - turn @ middle + shift
    return matrix


def seen_through(matrix: Float64, *, gain: float = 1.0, noise: float = 0.0) -> FloatImage:
    """By splines, which know nothing of the interpolation under test."""
    random = np.random.default_rng(5)
    at = matrix @ np.stack([X.ravel(), Y.ravel(), np.ones(X.size)])
    places = [(at[1] / at[2]).reshape(X.shape), (at[0] / at[2]).reshape(X.shape)]
    channels = [map_coordinates(PICTURE[:, :, c], places, order=3, mode="nearest") for c in range(3)]
    seen = gain * np.stack(channels, axis=2) + noise * random.standard_normal(PICTURE.shape)
    return np.asarray(seen, np.float32)


@pytest.mark.parametrize(
    ("shift", "degrees", "scale"),
    [((0.0, 0.0), 0.0, 1.0), ((0.3, -0.2), 0.0, 1.0), ((2.0, 1.0), 0.3, 1.004), ((-22.0, 14.0), 1.0, 1.0)],
)
def test_a_known_motion_is_found_within_a_fortieth_of_a_pixel(
    shift: tuple[float, float], degrees: float, scale: float
) -> None:
    matrix = similarity(shift, degrees, scale)
    found = register(PICTURE, seen_through(matrix, gain=0.9, noise=0.01), KNOWN)
    at = matrix @ np.array([*found.middle_px, 1.0])
    assert found.found
    assert found.shift_px == pytest.approx(at[:2] / at[2] - found.middle_px, abs=0.025)
    assert found.rotation_deg == pytest.approx(degrees, abs=0.03)
    assert found.scale == pytest.approx(scale, abs=3e-4)
    assert found.gain == pytest.approx((0.9, 0.9, 0.9), abs=0.005)


def test_the_uncertainty_grows_with_the_noise_and_covers_the_error() -> None:
    calm, noisy = (register(PICTURE, seen_through(np.eye(3), noise=noise), KNOWN) for noise in (0.005, 0.15))
    assert noisy.sigma_px > 3 * calm.sigma_px
    assert math.hypot(*noisy.shift_px) < 5 * noisy.sigma_px
    assert not noisy.moved(0.1)


def test_what_is_not_known_says_nothing_whatever_it_holds() -> None:
    seen = seen_through(similarity((1.0, 0.0)))
    seen[KNOWN == 0] = np.nan
    found = register(PICTURE, seen, KNOWN)
    assert found.shift_px == pytest.approx((1.0, 0.0), abs=0.025)


def test_a_part_that_is_covered_does_not_pull_the_rest_along() -> None:
    seen = seen_through(similarity((0.8, 0.4)))
    seen[60:90, 60:100] = 0.02
    found = register(PICTURE, seen, KNOWN)
    assert found.shift_px == pytest.approx((0.8, 0.4), abs=0.06)


@pytest.mark.parametrize("other", ["another picture", "nothing", "too little"])
def test_pictures_of_different_things_are_not_registered(other: str) -> None:
    seen, known = seen_through(np.eye(3)), KNOWN
    if other == "another picture":
        seen = frame(Pattern("r", PatternKind.RANDOM, seed=9), (COLUMNS, ROWS))
    elif other == "nothing":
        seen = np.zeros_like(PICTURE)
    else:
        known = np.zeros_like(KNOWN)
        known[70:80, 90:100] = 1
    found = register(PICTURE, seen, known)
    assert not found.found
    assert not found.moved(0.1)
    assert all(map(math.isnan, found.shift_px))


def test_a_picture_of_one_channel_is_registered_too() -> None:
    found = register(PICTURE[:, :, :1], seen_through(similarity((1.5, -0.5)))[:, :, :1], KNOWN)
    assert found.shift_px == pytest.approx((1.5, -0.5), abs=0.03)
