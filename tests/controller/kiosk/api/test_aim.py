"""What the aiming page gets: by test shots, by calibrations, by files that are damaged, by cameras that vanish."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from controller.kiosk.api.aim import FIGURES, FOLDER, SOFT_FOCUS, aiming, camera_picture, focus_of, grazing_share
from controller.kiosk.state import DeviceRow, LiveValue
from controller.kiosk.supervisors.device_supervisor import DeviceSupervisor
from controller.kiosk.supervisors.devices import Devices
from controller.kiosk.values import Aiming
from controller.optics.calibrate.values import Geometry, Metapixels, Pinhole
from controller.stage.sessions.check import check_stage
from hal.deadline import Deadline
from hal.errors import DeviceGone
from hal.interfaces import Device
from hal.values import CameraCapabilities, CapturedFile, DeviceIdentity, ExposureSettings
from tests.controller.kiosk.vase import graded_run, vase

SHOTS: dict[str, Any] = {
    "projectors": [{"projector": "left", "coverage": 0.42, "focus": 0.3},
                   {"projector": "right", "coverage": 0.9, "focus": 0.9}],
    "overlap": 0.5, "too_dark": 0.2, "too_soft": 0.11, "camera_focus": 0.9, "exposure": 0.7, "exposure_s": 0.1,
    "measured_unix_s": 1e9,
}  # fmt: skip


def shot(stage: Path, text: str) -> None:
    (stage / FOLDER).mkdir(parents=True, exist_ok=True)
    (stage / FOLDER / FIGURES).write_text(text)


def aimed(stage: Path, **changes: object) -> Aiming:
    shot(stage, json.dumps(SHOTS | changes))
    return aiming(check_stage(stage))


def test_the_hints_say_what_to_turn_and_no_more(tmp_path: Path) -> None:
    stage = vase(tmp_path)
    found = aimed(stage)
    assert (found.source, found.overlap, found.exposure) == ("test shots", 0.5, 0.7)
    assert [hint.partition(":")[0] for hint in found.hints] == [
        "left lights 42% of the object", "left is out of focus.", "20% of the object is too dark",
        "Light is grazing or soft on 11% of the object",
    ]  # fmt: skip
    well = aimed(stage, projectors=SHOTS["projectors"][1:], too_dark=0.1, too_soft=0.1)
    assert well.hints == ()
    (dark,) = aimed(stage, projectors=[], too_dark=0, too_soft=0, exposure=0.24).hints
    (bright,) = aimed(stage, projectors=[], too_dark=0, too_soft=0, exposure=0.99).hints
    (soft,) = aimed(stage, projectors=[], too_dark=0, too_soft=0, camera_focus=0.39).hints
    (clipped,) = aimed(stage, projectors=[], too_dark=0, too_soft=0, clipped=0.021).hints
    assert ("too dark" in dark, "too bright" in bright, "focus the camera" in soft) == (True, True, True)
    assert "2% of the object is too bright" in clipped


def metapixels(pitch_px: float, spread_px: float, *, slant: float = 1.0) -> Metapixels:
    """Pixels of a flat projector; ``spread_px``: standard deviation of a point of light in projector and camera."""
    y, x = np.mgrid[:40, :60].astype(np.float32)
    own = pitch_px**2 / 12
    covariance = np.zeros((40, 60, 3), np.float32)
    covariance[..., 0], covariance[..., 2] = own * slant**2 + spread_px**2, own + spread_px**2
    valid = np.ones((40, 60), np.bool_)
    valid[:, 50:] = False
    return Metapixels(np.stack([slant * pitch_px * x, pitch_px * y], -1), covariance, valid)


@pytest.mark.parametrize(("pitch_px", "slant"), [(0.6, 1.0), (1.0, 1.0), (1.0, 0.3), (3.0, 1.0), (8.0, 0.5)])
def test_a_sharp_projector_is_sharp_whatever_the_camera_resolves_and_a_blurred_one_is_not(
    pitch_px: float, slant: float
) -> None:
    assert focus_of(metapixels(pitch_px, 0.5, slant=slant)) > 0.85
    assert focus_of(metapixels(pitch_px, max(2.0, 1.5 * pitch_px), slant=slant)) < SOFT_FOCUS
    assert focus_of(replace(metapixels(pitch_px, 0.5), valid=np.zeros((40, 60), np.bool_))) == 0.0


def test_a_projector_looks_no_sharper_than_its_camera(tmp_path: Path) -> None:
    stage = vase(tmp_path)
    shot(stage, json.dumps(SHOTS | {"camera_focus": 0.5, "projectors": [
        {"projector": "left", "coverage": 0.9, "focus": 0.3}, {"projector": "right", "coverage": 0.9, "focus": 0.1},
    ]}))  # fmt: skip
    hints = aiming(check_stage(stage)).hints
    assert [hint.split()[0] for hint in hints if "out of focus" in hint] == ["right"]


DAMAGE = {
    "empty": "", "cut": json.dumps(SHOTS)[:80], "a list": "[]", "a word": '"left"', "nothing": "null",
    "a key less": json.dumps({key: value for key, value in SHOTS.items() if key != "overlap"}),
    "no projectors": json.dumps(SHOTS | {"projectors": 3}), "no texts": json.dumps(SHOTS | {"exposure": "bright"}),
    "other columns": json.dumps(SHOTS | {"projectors": [{"projector": "left", "size": 3}]}),
}  # fmt: skip


@pytest.mark.parametrize("how", list(DAMAGE))
def test_damaged_test_shots_are_as_good_as_none(tmp_path: Path, how: str) -> None:
    stage = vase(tmp_path)
    shot(stage, DAMAGE[how])
    assert aiming(check_stage(stage)) == Aiming()


def test_a_calibration_that_can_not_be_read_leaves_the_test_shots_or_says_so(tmp_path: Path) -> None:
    stage = vase(tmp_path)
    run = graded_run(stage, "20260101-100000-calibrate", {"left": 0.01})
    found = aiming(check_stage(stage))
    assert (found.source, found.projectors) == ("", ())
    assert "radiometry-left.npz" in found.hints[0]
    assert aimed(stage).source == "test shots", "older than the calibration, and yet all there is"
    for name in ("radiometry-left.npz", "geometry.npz", "pixels-left.npz", "metapixels-left.npz"):
        np.savez(run / name, nonsense=np.zeros(3))
    (stage / FOLDER / FIGURES).unlink()
    assert len(aiming(check_stage(stage)).hints) == 1


@dataclass
class Camera:
    """One that shows what it sees. ``then`` is called while it answers."""

    answer: Callable[[], bytes]
    shows: bool = True
    open: bool = True
    taken: list[str] = field(default_factory=list)

    @property
    def capabilities(self) -> CameraCapabilities:
        return CameraCapabilities((0.1,), (100,), (), raw=True, jpeg=True, live_view=self.shows)

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        return DeviceIdentity("Model", "Camera")

    def close(self) -> None:
        self.open = False

    def configure(self, settings: ExposureSettings, *, deadline: Deadline) -> ExposureSettings:
        return settings

    def capture(self, destination: Path, *, deadline: Deadline) -> list[CapturedFile]:
        return []

    def live_view(self, *, deadline: Deadline) -> bytes:
        assert self.open, "asked after it was let go of"
        return self.answer()

    def end_live_view(self, *, deadline: Deadline) -> None:
        """Nothing to end."""


def jpeg() -> bytes:
    out = io.BytesIO()
    Image.new("RGB", (40, 30), (200, 30, 30)).save(out, "JPEG", comment=b"a secret of the camera")
    return out.getvalue()


def gone() -> bytes:
    raise DeviceGone("camera-gone", what="It left.", remedy="Plug it in.")


def devices_with(folder: Path, camera: Camera) -> Devices:
    found = Devices(check_stage(vase(folder)), folder, lambda _: None)

    def look(device: Device, deadline: Deadline) -> tuple[LiveValue, ...]:
        device.identity(deadline=deadline)
        return ()

    found.camera = DeviceSupervisor(
        DeviceRow("camera", "camera", "model"), lambda _: camera, look, lambda _: None, every_s=0.0
    )
    return found


def test_the_live_picture_is_made_anew_and_holds_nothing_of_the_cameras(tmp_path: Path) -> None:
    devices = devices_with(tmp_path, Camera(jpeg))
    assert camera_picture(devices) is None, "it is not open yet"
    devices.camera.step()
    picture = camera_picture(devices)
    assert picture is not None
    assert b"secret" not in picture
    with Image.open(io.BytesIO(picture)) as seen:
        assert (seen.format, seen.size) == ("JPEG", (40, 30))


@pytest.mark.parametrize(
    "answer", [lambda: b"", lambda: b"\xff\xd8", lambda: jpeg()[:100], lambda: b"<html>", gone],
    ids=["nothing", "two bytes", "cut", "a page", "gone"],
)  # fmt: skip
def test_what_is_no_picture_is_none_and_the_camera_is_free_again(tmp_path: Path, answer: Callable[[], bytes]) -> None:
    devices = devices_with(tmp_path, Camera(answer))
    devices.camera.step()
    assert camera_picture(devices) is None
    assert not devices.camera.lent.locked()


def test_a_camera_without_live_view_or_at_work_is_not_asked(tmp_path: Path) -> None:
    devices = devices_with(tmp_path, Camera(gone, shows=False))
    devices.camera.step()
    assert camera_picture(devices) is None
    other = devices_with(tmp_path, Camera(jpeg))
    other.camera.step()
    with other.camera.lent:
        assert camera_picture(other) is None
    assert camera_picture(other) is not None


def test_light_grazes_where_no_projector_stands_steep_enough() -> None:
    rows, columns = 3, 4
    points = np.zeros((rows, columns, 3), np.float32)
    points[..., 0], points[..., 2] = np.arange(columns), 5.0
    normals = np.zeros_like(points)
    normals[..., 2] = -1.0
    normals[0, 0] = np.nan

    def at(*centre: float) -> Pinhole:
        return Pinhole(np.eye(3), np.zeros(2), np.eye(3), -np.array(centre), (4, 3))

    above, beside = at(1.5, 0.0, 0.0), at(500.0, 0.0, 4.0)
    mask = np.ones((rows, columns), bool)
    everywhere = np.ones((rows, columns), bool)
    nowhere = np.zeros_like(everywhere)

    def share(*parts: tuple[Pinhole, np.ndarray[Any, np.dtype[np.bool_]]]) -> float:
        geometry = Geometry(above, tuple(one for one, _ in parts), points, normals, 0.1, True)
        return grazing_share(geometry, np.stack([lit for _, lit in parts]), mask)

    assert share((above, everywhere)) == 0.0
    assert share((beside, everywhere)) == 1.0
    assert share((above, everywhere), (beside, everywhere)) == 0.0
    half = everywhere.copy()
    half[:, 2:] = False
    assert math.isclose(share((above, half), (beside, everywhere)), 6 / 11), "one place has no normal"
    assert share((above, nowhere)) == 0.0
