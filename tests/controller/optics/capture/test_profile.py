from __future__ import annotations

import numpy as np

from controller.optics.capture.profile import CameraProfile, true_exposure


def test_an_exposure_is_as_measured_or_as_the_camera_reports() -> None:
    profile = CameraProfile(exposures=np.array([(1 / 30, 1 / 32), (0.5, 0.51)]))
    assert true_exposure(None, 1 / 30) == 1 / 30
    assert true_exposure(CameraProfile(), 1 / 30) == 1 / 30
    assert true_exposure(profile, 1 / 30) == 1 / 32
    assert true_exposure(profile, 0.25) == 0.25
    assert [profile.knows(value) for value in (1 / 30, 0.25, 0.5)] == [True, False, True]
    assert not CameraProfile().knows(0.5)
