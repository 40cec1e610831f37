from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from controller.core.errors import WorkError
from controller.optics.capture.acquire import Acquirer, Shot
from hal.deadline import in_seconds
from hal.errors import DeviceError, DeviceGone
from hal.values import FileKind
from tests.controller.stage.rig.rig_model import SIZE_PX, ModelCamera, ModelDisplay

FRAMES = {"P1": np.zeros((SIZE_PX[1], SIZE_PX[0], 3), np.uint8)}


def acquirer(camera: ModelCamera, *, settle_s: float = 0.0) -> Acquirer:
    return Acquirer(ModelDisplay(), camera, iso=200, aperture_f=8.0, settle_s=settle_s)


def test_the_camera_is_set_only_when_the_exposure_changes(tmp_path: Path) -> None:
    camera = ModelCamera()
    taking = acquirer(camera)
    for number, exposure_s in enumerate((0.5, 0.5, 1.0, 0.5)):
        taking.take(Shot(f"{number}", FRAMES, exposure_s), tmp_path, deadline=in_seconds(9))
    assert [(one.exposure_s, one.iso, one.aperture_f) for one in camera.configured] == [
        (0.5, 200, 8.0), (1.0, 200, 8.0), (0.5, 200, 8.0),
    ]  # fmt: skip


def test_the_raw_file_is_preferred_and_the_confirmed_exposure_told(tmp_path: Path) -> None:
    camera = ModelCamera(rounding=1.02)
    file, exposure_s = acquirer(camera).take(Shot("a", FRAMES, 0.5), tmp_path, deadline=in_seconds(9))
    assert (file.kind, exposure_s) == (FileKind.RAW, 0.51)
    camera.kinds = (FileKind.JPEG,)
    file, _ = acquirer(camera).take(Shot("b", FRAMES, 0.5), tmp_path, deadline=in_seconds(9))
    assert file.kind is FileKind.JPEG


def test_the_shutter_waits_for_the_frames_to_settle(tmp_path: Path) -> None:
    began_s = time.monotonic()
    acquirer(ModelCamera(), settle_s=0.2).photograph("a", 0.5, tmp_path, shown_at_s=began_s, deadline=in_seconds(9))
    assert time.monotonic() - began_s >= 0.2


def test_a_camera_that_sends_nothing_is_told(tmp_path: Path) -> None:
    with pytest.raises(WorkError) as failed:
        acquirer(ModelCamera(kinds=())).take(Shot("a", FRAMES, 0.5), tmp_path, deadline=in_seconds(9))
    assert failed.value.code == "camera-no-file"


@pytest.mark.parametrize("code", ["no-space", "cannot-write"])
def test_a_disk_that_fails_is_failed_work_and_no_failing_device(tmp_path: Path, code: str) -> None:
    camera = ModelCamera(fails=DeviceError(code, what="Full.", remedy="Free some."))
    with pytest.raises(WorkError) as failed:
        acquirer(camera).take(Shot("a", FRAMES, 0.5), tmp_path, deadline=in_seconds(9))
    assert (failed.value.code, failed.value.what, failed.value.remedy) == (code, "Full.", "Free some.")


def test_a_camera_that_fails_is_told_as_it_told_it(tmp_path: Path) -> None:
    gone = DeviceGone("camera-off", what="Off.", remedy="Switch it on.")
    with pytest.raises(DeviceGone) as failed:
        acquirer(ModelCamera(fails=gone)).take(Shot("a", FRAMES, 0.5), tmp_path, deadline=in_seconds(9))
    assert failed.value is gone
