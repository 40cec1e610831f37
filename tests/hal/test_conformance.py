"""The conformance suite passes a device that keeps its promises and catches those that do not."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from hal.conformance import CameraConformance, DisplayConformance, ProjectorConformance
from hal.deadline import Deadline
from hal.errors import DeviceGone, DeviceRefused
from hal.values import (
    CameraCapabilities,
    CapturedFile,
    DeviceIdentity,
    ExposureSettings,
    FileKind,
    LampRules,
    OutputInfo,
    Power,
    Presented,
    ProjectorCapabilities,
    ProjectorStatus,
)


class Base:
    """What the devices below share."""

    def __init__(self) -> None:
        self.closed = False

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        self.check(deadline)
        return DeviceIdentity("Velatura", "in memory")

    def close(self) -> None:
        self.closed = True

    def check(self, deadline: Deadline) -> None:
        deadline.check("late", what="The deadline has passed.", remedy="Allow more time.")
        if self.closed:
            raise DeviceGone("closed", what="It is closed.", remedy="Open it.")


def refused(what: str) -> DeviceRefused:
    return DeviceRefused("refused", what=what, remedy="Ask for something else.")


class MemoryCamera(Base):
    """A camera without optics; ``flaw`` names the promise that it breaks."""

    def __init__(self, flaw: str = "") -> None:
        super().__init__()
        self.flaw = flaw
        steps = (0.5, 0.25, 1.0) if flaw == "order" else (0.25, 0.5, 1.0)
        self.capabilities = CameraCapabilities(steps, (100, 200), (), raw=True, jpeg=True)
        self.settings = ExposureSettings(0.5, 100)

    def configure(self, settings: ExposureSettings, *, deadline: Deadline) -> ExposureSettings:
        self.check(deadline)
        steps = self.capabilities.exposures_s
        if not min(steps) <= settings.exposure_s <= max(steps):
            if self.flaw != "clamps":
                raise refused("That exposure does not exist.")
            return settings
        nearest = min(steps, key=lambda step: abs(step - settings.exposure_s))
        self.settings = replace(settings, exposure_s=nearest)
        return self.settings

    def capture(self, destination: Path, *, deadline: Deadline) -> list[CapturedFile]:
        if self.flaw != "ignores the deadline":
            self.check(deadline)
        suffix, kind = (".dng", FileKind.RAW) if self.settings.raw else (".jpg", FileKind.JPEG)
        data = os.urandom(100)
        path = destination.with_suffix(suffix) if self.flaw == "suffix" else Path(f"{destination}{suffix}")
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("wb") as file:
            file.write(data)
            file.flush()
            if self.flaw != "fsync":
                os.fsync(file.fileno())
        if self.flaw == "leftover":
            Path(f"{path}.part").touch()
        digest = hashlib.sha256(data if self.flaw != "hash" else b"").hexdigest()
        return [CapturedFile(path, kind, len(data), digest)]


class MemoryDisplay(Base):
    """A display without pixels; ``flaw`` names the promise that it breaks."""

    def __init__(self, flaw: str = "") -> None:
        super().__init__()
        self.flaw = flaw
        self.sequence = 0

    def outputs(self, *, deadline: Deadline) -> tuple[OutputInfo, ...]:
        self.check(deadline)
        return OutputInfo("P1", 8, 6), OutputInfo("P2", 6, 4)

    def show(self, frames: Mapping[str, npt.NDArray[np.uint8]], *, deadline: Deadline) -> Presented:
        sizes = {output.name: (output.height_px, output.width_px, 3) for output in self.outputs(deadline=deadline)}
        if self.flaw != "shows anything":
            for name, frame in frames.items():
                wrong_type = self.flaw != "any dtype" and frame.dtype != np.uint8
                if name not in sizes or frame.shape != sizes[name] or wrong_type:
                    raise refused("A frame does not fit.")
        self.sequence += 1
        return Presented(self.sequence, time.monotonic())

    def play(self, appearance: str, *, deadline: Deadline) -> Presented:
        self.check(deadline)
        raise refused("There is no bundle.")


class MemoryProjector(Base):
    """A lamp that warms at once; ``flaw`` names the promise that it breaks, ``answer_s`` how long a refusal takes."""

    def __init__(self, flaw: str = "", answer_s: float = 0.0) -> None:
        super().__init__()
        self.flaw = flaw
        self.answer_s = answer_s
        rules = LampRules(warm_up_s=0.0, stable_s=0.0, cool_down_s=0.2, minimum_off_s=0.2)
        self.capabilities = ProjectorCapabilities(False, False, (), False, rules)
        self.lit = False
        self.cool_at = 0.0

    def status(self, *, deadline: Deadline) -> ProjectorStatus:
        self.check(deadline)
        if self.lit:
            return ProjectorStatus(Power.ON)
        return ProjectorStatus(Power.COOLING if time.monotonic() < self.cool_at else Power.OFF)

    def switch_on(self, *, deadline: Deadline) -> None:
        self.check(deadline)
        time.sleep(self.answer_s)
        if time.monotonic() < self.cool_at and self.flaw != "strikes hot":
            raise refused("The lamp cools.")
        self.lit = True

    def switch_off(self, *, deadline: Deadline) -> None:
        self.check(deadline)
        if self.lit:
            self.cool_at = time.monotonic() + self.capabilities.lamp_rules.cool_down_s
        self.lit = False

    def set_shutter(self, closed: bool, *, deadline: Deadline) -> None:
        raise refused("It has no shutter.")


class TestMemoryProjector(ProjectorConformance):
    poll_s = 0.05

    @pytest.fixture(params=[0.0, 0.3])
    def projector(self, request: pytest.FixtureRequest) -> MemoryProjector:
        """One answers at once, one only after its lamp has cooled."""
        return MemoryProjector(answer_s=request.param)


class TestMemoryCamera(CameraConformance):
    @pytest.fixture
    def camera(self) -> MemoryCamera:
        return MemoryCamera()


class TestMemoryDisplay(DisplayConformance):
    @pytest.fixture
    def display(self) -> MemoryDisplay:
        return MemoryDisplay()


FAILED = (AssertionError, pytest.fail.Exception)


@pytest.mark.parametrize("flaw", ["suffix", "fsync", "leftover", "hash"])
def test_a_camera_whose_files_are_not_as_promised_is_caught(
    flaw: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(FAILED):
        CameraConformance().test_a_picture_is_complete_durable_and_alone(MemoryCamera(flaw), tmp_path, monkeypatch)


def test_a_camera_that_claims_impossible_exposures_is_caught() -> None:
    with pytest.raises(FAILED):
        CameraConformance().test_an_impossible_exposure_is_refused(MemoryCamera("clamps"), 1000.0)


def test_a_camera_that_ignores_the_deadline_is_caught(tmp_path: Path) -> None:
    with pytest.raises(FAILED):
        CameraConformance().test_a_deadline_in_the_past_leaves_no_file(MemoryCamera("ignores the deadline"), tmp_path)


def test_a_camera_with_unordered_steps_is_caught() -> None:
    with pytest.raises(FAILED):
        CameraConformance().test_capabilities_are_ascending_and_not_empty(MemoryCamera("order"))


@pytest.mark.parametrize("flaw", ["shows anything", "any dtype"])
def test_a_display_that_shows_what_does_not_fit_is_caught(flaw: str) -> None:
    with pytest.raises(FAILED):
        DisplayConformance().test_wrong_frames_are_refused_before_anything_is_shown(MemoryDisplay(flaw))


def test_a_projector_that_strikes_a_hot_lamp_is_caught() -> None:
    with pytest.raises(FAILED):
        ProjectorConformance().test_on_while_the_lamp_cools_is_refused_or_kept_safe(MemoryProjector("strikes hot"))
