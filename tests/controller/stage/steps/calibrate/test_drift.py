"""Exposures of a drift check, where the camera opens for other times than it says."""

from __future__ import annotations

import numpy as np
import pytest

from controller.core.arrays import FloatImage
from controller.optics.capture.profile import CameraProfile
from controller.stage.steps.calibrate.drift import FULL_SHARE, exposure_for

AVAILABLE_S = (0.01, 0.0125, 0.016, 0.02, 0.025, 0.03, 0.04, 0.05, 0.06, 0.08, 0.1, 0.125, 0.16)


def light(brightest: float) -> FloatImage:
    """In full scales per second."""
    return np.full((40, 30, 3), brightest, np.float32)


def profile_of(*reported_s: float) -> CameraProfile:
    return CameraProfile(exposures=np.array([(value, 1.02 * value) for value in reported_s]).reshape(-1, 2))


@pytest.mark.parametrize("profile", [None, profile_of()])
def test_a_camera_that_is_right_is_asked_for_the_longest_exposure_that_does_not_clip(
    profile: CameraProfile | None,
) -> None:
    assert exposure_for(light(FULL_SHARE / 0.055), AVAILABLE_S, 1.0, profile) == 0.05
    assert exposure_for(light(FULL_SHARE / 0.055), AVAILABLE_S, 0.03, profile) == 0.03, "no longer than allowed"


@pytest.mark.parametrize(
    ("known_s", "taken_s"),
    [
        ((0.05, 0.06), 0.05),
        ((0.04, 0.16), 0.04),
        ((0.0125, 0.06), 0.06),
        ((0.0125, 0.16), 0.0125),
        ((0.01, 0.08, 0.16), 0.05),
    ],
    ids=["the one that is wanted", "a shorter one", "a longer one", "a much shorter one", "none is near"],
)
def test_an_exposure_is_taken_whose_true_time_is_known(known_s: tuple[float, ...], taken_s: float) -> None:
    assert exposure_for(light(FULL_SHARE / 0.055), AVAILABLE_S, 1.0, profile_of(*known_s)) == taken_s


def test_wrong_times_of_the_camera_are_no_weaker_or_stronger_lamp() -> None:
    """The camera opens longer or shorter than it says; the calibration knows by how much for its own exposures."""
    opened_s = {value: value * (1 + 0.03 * np.sin(1e4 * value)) for value in AVAILABLE_S}
    profile = CameraProfile(exposures=np.array([(value, opened_s[value]) for value in (0.02, 0.06)]))
    for wanted_s in np.geomspace(0.0165, 0.12, 40):
        taken_s = exposure_for(light(FULL_SHARE / wanted_s), AVAILABLE_S, 1.0, profile)
        assert opened_s[taken_s] / profile.true_exposure(taken_s) == pytest.approx(1, abs=1e-9)
        assert FULL_SHARE * opened_s[taken_s] / wanted_s < 1, "and white does not clip"


def test_a_known_exposure_is_no_longer_than_allowed() -> None:
    assert exposure_for(light(FULL_SHARE / 0.055), AVAILABLE_S, 0.055, profile_of(0.025, 0.06)) == 0.025
