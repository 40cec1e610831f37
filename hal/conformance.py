"""What every driver must do, as tests: ours and a third party's run the same ones, with one line each.

    from hal.conformance import CameraConformance

    class TestMyCamera(CameraConformance):
        @pytest.fixture
        def camera(self): return MyCamera.open("emulated")

The fixture (``projector``, ``camera`` or ``display``) gives an opened device and closes it afterwards. The device may
be in any healthy state when a test gets it. Class attributes say how patient a test is; give a slow device more.
This is the only module of ``hal`` that needs pytest.
"""

from __future__ import annotations

import hashlib
import math
import os
import threading
import time
from itertools import pairwise
from pathlib import Path
from typing import ClassVar

import numpy as np
import numpy.typing as npt
import pytest

from hal.deadline import Cancelled, Deadline, in_seconds
from hal.errors import DeviceError, DeviceRefused, DeviceTimeout
from hal.interfaces import Camera, Device, Display, Projector
from hal.values import CameraCapabilities, CapturedFile, ExposureSettings, FileKind, Power, ProjectorStatus

_RAW_SUFFIXES = {".dng", ".cr2", ".cr3", ".crw", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef"}


class DeviceConformance:
    """What holds for every kind of device; the subclasses below add their kind."""

    patience_s: ClassVar[float] = 30.0
    """Deadline of an ordinary call."""
    prompt_s: ClassVar[float] = 2.0
    """A call whose deadline has passed, or that was cancelled, must have ended after this."""

    def soon(self) -> Deadline:
        return in_seconds(self.patience_s)

    def check_identity(self, device: Device) -> None:
        who = device.identity(deadline=self.soon())
        assert who.model.strip(), "the device must say which model it is"

    def check_closes_twice(self, device: Device) -> None:
        for _ in range(2):
            started = time.monotonic()
            device.close()
            assert time.monotonic() - started < self.prompt_s, "close() must not block"
        with pytest.raises(DeviceError):
            device.identity(deadline=self.soon())

    def check_deadline_and_cancel(self, device: Device) -> None:
        started = time.monotonic()
        with pytest.raises(DeviceTimeout) as caught:
            device.identity(deadline=in_seconds(-1.0))
        assert caught.value.what
        assert caught.value.remedy
        stop = threading.Event()
        stop.set()
        with pytest.raises(Cancelled):
            device.identity(deadline=in_seconds(self.patience_s, stop))
        assert time.monotonic() - started < self.prompt_s
        self.check_identity(device)


class ProjectorConformance(DeviceConformance):
    """Run on every projector driver; supply a fixture ``projector``. It switches the lamp on and off."""

    poll_s: ClassVar[float] = 0.5
    """Pause between two questions while the lamp warms or cools."""

    def test_says_who_it_is(self, projector: Projector) -> None:
        assert isinstance(projector, Projector)
        self.check_identity(projector)

    def test_lamp_rules_are_possible(self, projector: Projector) -> None:
        rules = projector.capabilities.lamp_rules
        for seconds in (rules.warm_up_s, rules.stable_s, rules.cool_down_s, rules.minimum_off_s):
            assert math.isfinite(seconds)
            assert seconds >= 0
        assert rules.stable_s >= rules.warm_up_s

    def test_goes_on_and_off_and_says_so(self, projector: Projector) -> None:
        if not projector.capabilities.power:
            self.check_power_is_refused(projector)
            return
        self.bring(projector, Power.ON)
        projector.switch_on(deadline=self.soon())
        assert projector.status(deadline=self.soon()).power is Power.ON, "switching on twice is harmless"
        projector.switch_off(deadline=self.soon())
        after = projector.status(deadline=self.soon()).power
        assert after in (Power.COOLING, Power.OFF), "the status must be fresh, not remembered"
        self.bring(projector, Power.OFF)
        projector.switch_off(deadline=self.soon())
        assert projector.status(deadline=self.soon()).power is Power.OFF, "switching off twice is harmless"

    def check_power_is_refused(self, projector: Projector) -> None:
        """A driver that cannot switch says so, and claims to know no more than it does."""
        for switch in (projector.switch_on, projector.switch_off):
            with pytest.raises(DeviceRefused) as caught:
                switch(deadline=self.soon())
            assert caught.value.remedy
        assert projector.status(deadline=self.soon()).power in (Power.UNKNOWN, Power.COOLING)

    def test_on_while_the_lamp_cools_is_refused_or_kept_safe(self, projector: Projector) -> None:
        if not projector.capabilities.power:
            return  # it refuses always, as tested above
        self.bring(projector, Power.ON)
        projector.switch_off(deadline=self.soon())
        if projector.status(deadline=self.soon()).power is not Power.COOLING:
            return  # this lamp does not cool, so there is nothing to refuse
        with pytest.raises(DeviceRefused):
            projector.switch_on(deadline=self.soon())
        assert projector.status(deadline=self.soon()).power in (Power.COOLING, Power.OFF)

    def test_lamp_hours_are_told_exactly_when_promised(self, projector: Projector) -> None:
        hours = self.lit(projector).lamp_hours
        if projector.capabilities.lamp_hours:
            assert hours is not None
            assert hours >= 0
        else:
            assert hours is None

    def test_shutter_works_or_is_refused(self, projector: Projector) -> None:
        if projector.capabilities.shutter:
            before = self.lit(projector).power
            projector.set_shutter(True, deadline=self.soon())
            projector.set_shutter(False, deadline=self.soon())
            assert projector.status(deadline=self.soon()).power is before
        else:
            with pytest.raises(DeviceRefused):
                projector.set_shutter(True, deadline=self.soon())

    def test_keeps_deadlines_and_stops_when_cancelled(self, projector: Projector) -> None:
        self.check_deadline_and_cancel(projector)
        with pytest.raises(DeviceTimeout):
            projector.status(deadline=in_seconds(-1.0))

    def test_closing_twice_is_harmless(self, projector: Projector) -> None:
        self.check_closes_twice(projector)

    def lit(self, projector: Projector) -> ProjectorStatus:
        """The status with the lamp on, where the driver can switch it; else as it is."""
        if projector.capabilities.power:
            return self.bring(projector, Power.ON)
        return projector.status(deadline=self.soon())

    def bring(self, projector: Projector, wanted: Power) -> ProjectorStatus:
        """Bring the lamp to ON or OFF by the driver's own calls, from whatever state it is in."""
        rules = projector.capabilities.lamp_rules
        deadline = in_seconds(self.patience_s + 2 * (rules.warm_up_s + rules.cool_down_s + rules.minimum_off_s))
        while True:
            status = projector.status(deadline=self.soon())
            assert status.power is not Power.FAULT, f"the projector reports a fault: {status.faults}"
            if status.power is wanted:
                return status
            if wanted is Power.ON and status.power is Power.OFF:
                self._strike(projector)
            if wanted is Power.OFF and status.power in (Power.ON, Power.WARMING):
                projector.switch_off(deadline=self.soon())
            assert not deadline.passed, f"still {status.power} instead of {wanted}"
            deadline.sleep(self.poll_s)

    def _strike(self, projector: Projector) -> None:
        try:
            projector.switch_on(deadline=self.soon())
        except DeviceRefused:
            # Standby is told before the minimum off time is over on some models; the loop asks again.
            time.sleep(self.poll_s)


class CameraConformance(DeviceConformance):
    """Run on every camera driver; supply a fixture ``camera``. It takes a few pictures.

    A driver must call ``os.fsync`` through the module, so that the test can see which files were made durable.
    """

    def test_says_who_it_is(self, camera: Camera) -> None:
        assert isinstance(camera, Camera)
        self.check_identity(camera)

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
        assert sorted(file.path for file in files) == sorted(tmp_path.iterdir()), "nothing else may lie beside them"
        assert all(file.path.stat().st_ino in synced for file in files), "every file is fsynced"

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

    def test_keeps_deadlines_and_stops_when_cancelled(self, camera: Camera) -> None:
        self.check_deadline_and_cancel(camera)

    def test_closing_twice_is_harmless(self, camera: Camera) -> None:
        self.check_closes_twice(camera)

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
            assert suffix.lower() in (_RAW_SUFFIXES if file.kind is FileKind.RAW else {".jpg", ".jpeg"})
            assert file.size == len(data) > 0
            assert file.sha256 == hashlib.sha256(data).hexdigest()


Frames = dict[str, npt.NDArray[np.uint8]]


class DisplayConformance(DeviceConformance):
    """Run on every display driver; supply a fixture ``display``."""

    def frames(self, display: Display, value: int) -> Frames:
        outputs = display.outputs(deadline=self.soon())
        return {o.name: np.full((o.height_px, o.width_px, 3), value, dtype=np.uint8) for o in outputs}

    def test_says_who_it_is(self, display: Display) -> None:
        assert isinstance(display, Display)
        self.check_identity(display)

    def test_outputs_have_unlike_names_and_sizes(self, display: Display) -> None:
        outputs = display.outputs(deadline=self.soon())
        assert outputs
        assert len({output.name for output in outputs}) == len(outputs)
        assert all(output.name and output.width_px > 0 and output.height_px > 0 for output in outputs)

    def test_frames_are_presented_in_order(self, display: Display) -> None:
        before = time.monotonic()
        first = display.show(self.frames(display, 10), deadline=self.soon())
        second = display.show(self.frames(display, 200), deadline=self.soon())
        assert before <= first.at_s <= second.at_s <= time.monotonic()
        assert first.sequence < second.sequence

    def test_an_output_without_a_frame_is_allowed(self, display: Display) -> None:
        display.show({}, deadline=self.soon())

    def test_wrong_frames_are_refused_before_anything_is_shown(self, display: Display) -> None:
        shown = display.show(self.frames(display, 30), deadline=self.soon())
        name = display.outputs(deadline=self.soon())[0].name
        right = self.frames(display, 90)
        wrongs: tuple[Frames, ...] = (
            {**right, "no-such-output": right[name]},
            {**right, name: right[name][:-1]},
            {**right, name: right[name][:, :, :2]},
            {**right, name: right[name].astype(np.float32)},
        )
        for wrong in wrongs:
            with pytest.raises(DeviceRefused):
                display.show(wrong, deadline=self.soon())
        again = display.show(right, deadline=self.soon())
        assert again.sequence - shown.sequence <= 2, "a refused set counts as not shown"

    def test_an_unknown_appearance_is_refused(self, display: Display) -> None:
        with pytest.raises(DeviceRefused):
            display.play("there is no appearance of this name", deadline=self.soon())

    def test_keeps_deadlines_and_stops_when_cancelled(self, display: Display) -> None:
        with pytest.raises(DeviceTimeout):
            display.show(self.frames(display, 60), deadline=in_seconds(-1.0))
        self.check_deadline_and_cancel(display)

    def test_closing_twice_is_harmless(self, display: Display) -> None:
        self.check_closes_twice(display)
