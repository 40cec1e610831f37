"""Tests for camera drivers."""

from __future__ import annotations

import hashlib
import math
import os
import time
from itertools import pairwise
from pathlib import Path
from typing import ClassVar

import pytest

from hal.conformance.device import DeviceConformance
from hal.deadline import in_seconds
from hal.driver_calls import Caller
from hal.errors import DeviceRefused, DeviceTimeout
from hal.interfaces import Camera
from hal.values import CameraCapabilities, CapturedFile, ExposureSettings, FileKind

_RAW = (".dng", ".cr2", ".cr3", ".crw", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".exr", ".tif", ".tiff")


class CameraConformance(DeviceConformance):
    """Run on every camera driver; supply a fixture ``camera``. It takes a few pictures.

    A driver must call ``os.fsync`` through the module, so that the test can see which files were made durable.
    """

    kind = "camera"
    interface = Camera
    sees_fsync: ClassVar[bool] = True
    """False for a driver that writes its files in another process, where the test can't look."""

    @pytest.fixture
    def device(self, camera: Camera) -> Camera:
        return camera

    def test_capabilities_are_ascending_and_not_empty(self, camera: Camera) -> None:
        can = camera.capabilities
        assert can.exposures_s, "exposure must be settable"
        assert can.raw or can.jpeg
        for values in (can.exposures_s, can.isos, can.apertures_f):
            assert all(math.isfinite(value) and value > 0 for value in values)
            assert all(low < high for low, high in pairwise(values)), "ascending, without repeats"

    def test_configure_returns_what_the_camera_has(self, camera: Camera) -> None:
        can = camera.capabilities
        for exposure_s in (can.exposures_s[0], can.exposures_s[-1], can.exposures_s[len(can.exposures_s) // 2]):
            asked = self.settings(can, exposure_s)
            confirmed = camera.configure(asked, deadline=self.soon())
            assert confirmed == asked, "a setting taken from the capabilities is not rounded"

    def test_configure_between_two_steps_rounds_to_a_step(self, camera: Camera) -> None:
        can = camera.capabilities
        if len(can.exposures_s) < 2:
            return
        between = math.sqrt(can.exposures_s[0] * can.exposures_s[1])
        try:
            confirmed = camera.configure(self.settings(can, between), deadline=self.soon())
        except DeviceRefused:
            return
        assert confirmed.exposure_s in can.exposures_s[:2]

    @pytest.mark.parametrize("factor", [1000.0, 0.0, -1.0, math.nan, math.inf])
    def test_an_impossible_exposure_is_refused(self, camera: Camera, factor: float) -> None:
        can = camera.capabilities
        impossible = self.settings(can, can.exposures_s[-1] * factor)
        with pytest.raises(DeviceRefused):
            camera.configure(impossible, deadline=self.soon())
        self.check_identity(camera)

    def test_a_picture_is_complete_durable_and_alone(
        self, camera: Camera, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        synced: set[int] = set()
        fsync = os.fsync

        def recording(handle: int) -> None:
            synced.add(os.fstat(handle).st_ino)
            fsync(handle)

        monkeypatch.setattr(os, "fsync", recording)
        self.configure_short(camera)
        files = camera.capture(tmp_path / "shot.of-the-day", deadline=self.soon())
        self.check_files(files, tmp_path / "shot.of-the-day")
        assert sorted(file.path for file in files) == sorted(tmp_path.iterdir()), "no other files may be in the folder"
        if self.sees_fsync:
            assert all(file.path.stat().st_ino in synced for file in files), "every file is fsynced"

    def test_a_folder_that_does_not_exist_is_made(self, camera: Camera, tmp_path: Path) -> None:
        self.configure_short(camera)
        destination = tmp_path / "captures" / "left" / "shot"
        self.check_files(camera.capture(destination, deadline=self.soon()), destination)

    def test_the_kind_of_file_follows_the_setting(self, camera: Camera, tmp_path: Path) -> None:
        can = camera.capabilities
        for raw in (True, False):
            if not (can.raw if raw else can.jpeg):
                continue
            self.configure_short(camera, raw=raw)
            files = camera.capture(tmp_path / f"raw-{raw}", deadline=self.soon())
            assert (FileKind.RAW if raw else FileKind.JPEG) in {file.kind for file in files}

    def test_a_deadline_in_the_past_leaves_no_file(self, camera: Camera, tmp_path: Path) -> None:
        self.configure_short(camera)
        started = time.monotonic()
        with pytest.raises(DeviceTimeout):
            camera.capture(tmp_path / "late", deadline=in_seconds(-1.0))
        assert time.monotonic() - started < self.prompt_s
        assert not list(tmp_path.iterdir())

    def test_a_second_picture_follows_the_first(self, camera: Camera, tmp_path: Path) -> None:
        self.configure_short(camera)
        first = camera.capture(tmp_path / "first", deadline=self.soon())
        second = camera.capture(tmp_path / "second", deadline=self.soon())
        self.check_files(first, tmp_path / "first")
        self.check_files(second, tmp_path / "second")

    def test_every_answer_and_error_is_of_its_type(self, camera: Camera, tmp_path: Path) -> None:
        can = Caller("The driver under test").device("camera", camera).capabilities
        self.check_types(
            camera,
            lambda it: it.configure(self.settings(can, can.exposures_s[0]), deadline=self.soon()),
            lambda it: it.capture(tmp_path / "shot", deadline=self.soon()),
        )

    def settings(self, can: CameraCapabilities, exposure_s: float, *, raw: bool | None = None) -> ExposureSettings:
        return ExposureSettings(exposure_s, can.isos[0] if can.isos else 100, raw=can.raw if raw is None else raw)

    def configure_short(self, camera: Camera, *, raw: bool | None = None) -> None:
        can = camera.capabilities
        short = self.settings(can, can.exposures_s[len(can.exposures_s) // 4], raw=raw)
        camera.configure(short, deadline=self.soon())

    def check_files(self, files: list[CapturedFile], destination: Path) -> None:
        assert files
        for file in files:
            data = file.path.read_bytes()
            suffix = file.path.name.removeprefix(destination.name)
            assert file.path == destination.parent / f"{destination.name}{suffix}", "the suffix is appended"
            assert suffix.lower() in (_RAW if file.kind is FileKind.RAW else {".jpg", ".jpeg"})
            assert file.size == len(data) > 0
            assert file.sha256 == hashlib.sha256(data).hexdigest()
