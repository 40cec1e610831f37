"""The PTP camera driver through real sockets, on emulated cameras that misbehave like real ones."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import pytest

from hal.conformance import CameraConformance
from hal.deadline import in_seconds
from hal.errors import (
    DeviceError,
    DeviceRefused,
    PluginError,
)
from hal.registry import OpenContext
from hal.values import ExposureSettings, FileKind
from lab.emulated.cameras.camera import EmulatedPtpCamera, Flavour
from plugins.emulated.core.shot import ShotFiles, ShotSettings
from plugins.ptp.body import PictureStorage
from plugins.ptp.camera import DRIVER, open_camera
from plugins.ptp.ip import PtpIpAddress
from plugins.ptp.still import PtpCamera
from tests.plugins.ptp.ptp_rig import SHORT, Rig, Studio, card_rig, connect, left_behind, rig, running

__all__ = ["card_rig", "rig"]


class EveryFlavour(CameraConformance):
    """The shared suite; one class a flavour below."""

    flavour: ClassVar[Flavour]
    patience_s = 20.0

    @pytest.fixture
    def camera(self, tmp_path_factory: pytest.TempPathFactory) -> Iterator[PtpCamera]:
        with EmulatedPtpCamera(Studio().expose, flavour=self.flavour, time_scale=0.01) as emulator:
            context = OpenContext(tmp_path_factory.mktemp("stage"))
            camera = open_camera({"address": emulator.address}, context, in_seconds(20))
            yield camera
            camera.close()


class TestGeneric(EveryFlavour):
    flavour = "generic"


class TestEosNew(EveryFlavour):
    flavour = "eos-new"


class TestEosOld(EveryFlavour):
    flavour = "eos-old"


def test_a_picture_has_the_bytes_of_the_camera_and_the_settings_that_were_confirmed(rig: Rig, tmp_path: Path) -> None:
    confirmed = rig.driver.configure(ExposureSettings(0.25, 400, 5.6, raw=False), deadline=in_seconds(20))
    assert rig.capture(tmp_path) == rig.latest()
    shot = rig.studio.shots[-1]
    assert shot.exposure_s == pytest.approx(confirmed.exposure_s)
    assert (shot.iso, shot.raw, shot.jpeg) == (400, False, True)
    assert shot.aperture_f == pytest.approx(5.6, rel=0.02)
    assert left_behind(tmp_path) == ["shot.jpg"]


def test_a_raw_picture_comes_alone_and_with_its_own_suffix(rig: Rig, tmp_path: Path) -> None:
    rig.driver.configure(ExposureSettings(0.125, 200, raw=True), deadline=in_seconds(20))
    files = rig.driver.capture(tmp_path / "shot", deadline=in_seconds(20))
    assert [(file.path.name, file.kind) for file in files] == [("shot.dng", FileKind.RAW)]
    assert files[0].path.read_bytes().startswith(b"II*\0")


def test_pictures_do_not_pile_up_in_the_camera(rig: Rig, tmp_path: Path) -> None:
    for number in range(5):
        assert rig.capture(tmp_path, f"shot{number}") == rig.latest()
    assert rig.emulator.body.pictures_on_card == 0
    assert rig.emulator.body.exposures == 5


def test_an_eos_can_shoot_to_its_card(card_rig: Rig, tmp_path: Path) -> None:
    assert card_rig.capture(tmp_path) == card_rig.latest()
    assert card_rig.emulator.body.pictures_on_card == 0


def test_pictures_stay_on_the_card_where_that_is_wanted(tmp_path: Path) -> None:
    with running("generic", storage=PictureStorage(keep_on_card=True)) as rig:
        rig.capture(tmp_path, "one")
        assert rig.capture(tmp_path, "two") == rig.latest()
        assert rig.emulator.body.pictures_on_card == 2


def test_an_unwritable_folder_is_named_and_the_picture_stays_in_the_camera(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with running("generic") as rig:
        with pytest.raises(DeviceError) as caught:
            rig.capture(tmp_path / "file")
        assert caught.value.code == "cannot-write"
        assert rig.emulator.body.pictures_on_card == 1


@pytest.mark.parametrize(
    "address",
    [
        "",
        "usb:not a serial",
        "usb",
        "ptpip:",
        "ptpip::1",
        "ptpip:host:0",
        "ptpip:host:70000",
        "ptpip:host:1:2:3",
        "ptpip:h:x",
    ],
)
def test_an_address_that_is_none_is_refused_with_an_example(address: str) -> None:
    with pytest.raises(PluginError) as caught:
        open_camera({"address": address}, OpenContext(Path()), in_seconds(20))
    assert ("usb:" if address.startswith("usb:") else "ptpip:") in caught.value.remedy


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("ptpip:10.0.0.2", PtpIpAddress("10.0.0.2", 15740, 15740)),
        ("ptpip:camera.local:99", PtpIpAddress("camera.local", 99, 99)),
        ("ptpip:[fe80::1]:98:99", PtpIpAddress("fe80::1", 98, 99)),
    ],
)
def test_addresses_may_leave_out_the_ports(text: str, expected: PtpIpAddress) -> None:
    assert PtpIpAddress.parse(text) == expected


@pytest.mark.parametrize(
    "settings",
    [
        {"target": "moon"},
        {"keep_on_card": "yes"},
        {"picture_s": 0},
        {"picture_s": 601},
        {"picture_s": "20"},
        {"picture_s": True},
    ],
)
def test_a_wrong_setting_is_refused_by_its_key(settings: dict[str, object]) -> None:
    with pytest.raises(PluginError) as caught:
        open_camera({"address": "ptpip:127.0.0.1:1", **settings}, OpenContext(Path()), in_seconds(20))
    assert next(iter(settings)) in caught.value.what


class SlowStudio(Studio):
    """A camera that works on a picture for a while."""

    def expose(self, settings: ShotSettings) -> ShotFiles:
        time.sleep(1.5)
        return super().expose(settings)


@pytest.mark.parametrize("flavour", ["generic", "eos-new"])
def test_a_camera_that_works_long_on_a_picture_gets_the_time_that_it_is_given(flavour: Flavour, tmp_path: Path) -> None:
    with EmulatedPtpCamera(SlowStudio().expose, flavour=flavour, time_scale=0.0) as emulator:
        for picture_s, code in ((1, "camera-no-picture"), (30, "")):
            settings = {"address": emulator.address, "picture_s": picture_s}
            camera = open_camera(settings, OpenContext(tmp_path), in_seconds(20))
            camera.configure(SHORT, deadline=in_seconds(20))
            assert camera.capabilities.picture_s == picture_s
            if not code:
                assert camera.capture(tmp_path / "shot", deadline=in_seconds(60))
            else:
                with pytest.raises(DeviceError) as caught:
                    camera.capture(tmp_path / "late", deadline=in_seconds(60))
                assert caught.value.code == code
            camera.close()


@pytest.mark.parametrize("flavour", ["nikon", "sony"])
def test_a_camera_with_commands_of_its_maker_is_left_to_libgphoto2(flavour: Flavour) -> None:
    with EmulatedPtpCamera(Studio().expose, flavour=flavour) as emulator:
        with pytest.raises(DeviceRefused) as refused:
            connect(emulator)
        assert refused.value.code == "camera-needs-gphoto2"
        assert emulator.body.names.model in refused.value.what
        assert 'driver = "gphoto2"' in refused.value.remedy


def test_the_driver_explains_every_setting_and_ignores_what_is_not_its_own() -> None:
    assert DRIVER.kind == "camera"
    assert set(DRIVER.required) <= set(DRIVER.settings)
    with EmulatedPtpCamera(Studio().expose) as emulator:
        settings = {"address": emulator.address, "iso": 100, "focal_length_px": 5200.0}
        DRIVER.open(settings, OpenContext(Path()), in_seconds(20)).close()
