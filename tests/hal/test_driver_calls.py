"""Drivers that raise and return what they must not, behind the calls that turn it into an error with a name."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.conformance import CameraConformance, LightSensorConformance, ProjectorConformance
from hal.deadline import Cancelled, Deadline, in_seconds
from hal.driver_calls import Caller, mismatch
from hal.errors import DeviceError, DeviceGone, DriverFault
from hal.interfaces import BundleDisplay, Camera, Display, LiveViewCamera, Projector, WatchedCamera
from hal.registry import Driver, OpenContext, check_device, open_device
from hal.values import (
    CameraCapabilities,
    CameraStatus,
    CapturedFile,
    DeviceIdentity,
    ExposureSettings,
    LampRules,
    Power,
    ProjectorCapabilities,
    ProjectorStatus,
)

CAN = ProjectorCapabilities(False, False, (), False, LampRules(0, 0, 0, 0))
WELL = {
    "identity": DeviceIdentity("Acme", "A1"),
    "status": ProjectorStatus(Power.OFF),
    "capabilities": CAN,
    "switch_on": None,
    "switch_off": None,
    "set_shutter": None,
    "close": None,
}


class Broken(DeviceError):
    """An error whose author forgot its text."""

    def __init__(self) -> None:
        """Without calling the constructor of DeviceError."""


class Acme:
    """A projector that answers as ``answers`` says; an exception among them is raised."""

    def __init__(self, **answers: Any) -> None:
        self.answers = WELL | answers
        self.called: list[str] = []

    def answer(self, name: str) -> Any:
        self.called.append(name)
        answer = self.answers[name]
        if isinstance(answer, BaseException):
            raise answer
        return answer

    @property
    def capabilities(self) -> Any:
        return self.answer("capabilities")

    def identity(self, *, deadline: Deadline) -> Any:
        return self.answer("identity")

    def status(self, *, deadline: Deadline) -> Any:
        return self.answer("status")

    def switch_on(self, *, deadline: Deadline) -> Any:
        return self.answer("switch_on")

    def switch_off(self, *, deadline: Deadline) -> Any:
        return self.answer("switch_off")

    def set_shutter(self, closed: bool, *, deadline: Deadline) -> Any:
        return self.answer("set_shutter")

    def close(self) -> Any:
        return self.answer("close")


def opened(made: object, kind: str = "projector") -> Any:
    driver = Driver(kind, "acme", "a test", lambda *_: made)
    return open_device(driver, {}, OpenContext(Path()), in_seconds(5), name="left")


CALLS: dict[str, Callable[[Any], object]] = {
    "identity": lambda it: it.identity(deadline=in_seconds(5)),
    "status": lambda it: it.status(deadline=in_seconds(5)),
    "capabilities": lambda it: it.capabilities,
    "switch_on": lambda it: it.switch_on(deadline=in_seconds(5)),
    "switch_off": lambda it: it.switch_off(deadline=in_seconds(5)),
    "set_shutter": lambda it: it.set_shutter(True, deadline=in_seconds(5)),
    "close": lambda it: it.close(),
}
ODD = [
    ValueError("a \x1b[2J b"), SystemExit(3), asyncio.CancelledError(), Broken(), OSError(5, "Input/output error"),
    RecursionError(), KeyError("x"), StopIteration(),
]  # fmt: skip


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize("odd", ODD, ids=lambda odd: type(odd).__name__)
def test_whatever_a_call_raises_names_driver_and_device(call: str, odd: BaseException) -> None:
    device = opened(Acme(**{call: odd}))
    with pytest.raises(DriverFault) as caught:
        CALLS[call](device)
    assert caught.value.code == "driver-fault"
    for word in ("'acme'", "projector left", call, type(odd).__name__):
        assert word in caught.value.what
    assert caught.value.what.isprintable()
    assert caught.value.__cause__ is odd


@pytest.mark.parametrize("call", CALLS)
def test_the_errors_of_the_interface_and_ctrl_c_come_through_as_they_are(call: str) -> None:
    for error in (DeviceGone("gone", what="It left.", remedy="Look."), Cancelled(), KeyboardInterrupt()):
        with pytest.raises(type(error)) as caught:
            CALLS[call](opened(Acme(**{call: error})))
        assert caught.value is error


@pytest.mark.parametrize(
    ("call", "wrong", "word"),
    [
        ("status", None, "nothing (None) instead of a ProjectorStatus"),
        ("status", "on", "a str instead of a ProjectorStatus"),
        ("status", ProjectorStatus("on"), "power: a str instead of a Power"),  # type: ignore[arg-type]
        ("status", ProjectorStatus(Power.ON, "lamp"), "faults: a str instead of a tuple"),  # type: ignore[arg-type]
        ("status", ProjectorStatus(Power.ON, (), 3.5), "lamp_hours: a float"),  # type: ignore[arg-type]
        ("identity", ("Acme", "A1"), "a tuple instead of a DeviceIdentity"),
        ("identity", DeviceIdentity("Acme", b"A1"), "model: a bytes instead of a str"),  # type: ignore[arg-type]
        ("capabilities", replace(CAN, answer_s=math.nan), "answer_s: nan is not a finite number"),
        ("capabilities", replace(CAN, lamp_rules=None), "lamp_rules: nothing"),  # type: ignore[arg-type]
        ("switch_off", "ok", "a str instead of a NoneType"),
    ],
)
def test_a_wrong_object_is_named_where_it_comes_from(call: str, wrong: Any, word: str) -> None:
    with pytest.raises(DriverFault) as caught:
        CALLS[call](opened(Acme(**{call: wrong})))
    for part in ("'acme'", "projector left", f"returned from {call}", word):
        assert part in caught.value.what


def test_what_is_right_comes_back_as_it_is() -> None:
    device = opened(Acme())
    for name, call in CALLS.items():
        assert call(device) is WELL[name]
    assert isinstance(device, Projector)


@pytest.mark.parametrize("made", [None, {"port": "x"}, Acme])
def test_what_is_no_device_is_refused_at_opening(made: Any) -> None:
    if made is Acme:
        made = Acme()
        with pytest.raises(DriverFault, match="without configure, capture, which is not a camera"):
            opened(made, "camera")
        assert made.called == ["close"], "its port is needed again"
    else:
        with pytest.raises(DriverFault, match="which is not a projector"):
            opened(made)


@pytest.mark.parametrize("odd", ODD, ids=lambda odd: type(odd).__name__)
def test_open_and_check_are_guarded_too(odd: BaseException) -> None:
    def fail(*_: object) -> None:
        raise odd

    driver = Driver("projector", "acme", "a test", fail, check=fail)
    for act in (
        lambda: open_device(driver, {}, OpenContext(Path()), in_seconds(5), name="left"),
        lambda: check_device(driver, {}, OpenContext(Path()), name="left"),
    ):
        with pytest.raises(DriverFault, match="'acme' of projector left"):
            act()


class PlainCamera:
    """Cannot be watched, and has no live view."""

    capabilities = CameraCapabilities((1.0,), (100,), (), raw=True, jpeg=False)
    files: Any = ()

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        return DeviceIdentity("Acme", "C1")

    def close(self) -> None:
        """Nothing to release."""

    def configure(self, settings: ExposureSettings, *, deadline: Deadline) -> ExposureSettings:
        return settings

    def capture(self, destination: Path, *, deadline: Deadline) -> Any:
        return self.files


class Watched(PlainCamera):
    """Reports its notices in a wrong shape."""

    def status(self, *, deadline: Deadline) -> CameraStatus:
        return CameraStatus(battery_percent=20)

    def notices(self) -> Any:
        return ["slow"]


def test_a_camera_has_what_its_driver_has_and_no_more() -> None:
    plain, watched = opened(PlainCamera(), "camera"), opened(Watched(), "camera")
    assert isinstance(plain, Camera)
    assert not isinstance(plain, WatchedCamera)
    assert isinstance(watched, WatchedCamera)
    assert not isinstance(watched, LiveViewCamera)
    assert not isinstance(plain, Display | BundleDisplay)
    assert watched.status(deadline=in_seconds(5)).battery_percent == 20
    with pytest.raises(DriverFault, match="notices"):
        watched.notices()


@pytest.mark.parametrize("files", [(), None, ["shot.dng"], [CapturedFile("x", "raw", 1, "")]])  # type: ignore[arg-type]
def test_a_capture_returns_a_list_of_captured_files(files: Any) -> None:
    camera = PlainCamera()
    camera.files = files
    with pytest.raises(DriverFault, match="returned from capture"):
        opened(camera, "camera").capture(Path("shot"), deadline=in_seconds(5))


class UntypedSensor:
    """Raises what it should not once it is closed; ``lux`` is what it tells."""

    def __init__(self, lux: Any) -> None:
        self.lux, self.closed = lux, False

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        self.told(None)
        return DeviceIdentity("Acme", "L1")

    def illuminance_lux(self, *, deadline: Deadline) -> Any:
        return self.told(self.lux)

    def told(self, answer: Any) -> Any:
        if self.closed:
            raise OSError(9, "Bad file descriptor")
        return answer

    def close(self) -> None:
        self.closed = True


@pytest.mark.parametrize("lux", [1.0, "1 lux"])
def test_the_conformance_suite_catches_untyped_errors_and_answers(lux: Any) -> None:
    with pytest.raises((AssertionError, DriverFault)):
        LightSensorConformance().test_every_answer_and_error_is_of_its_type(UntypedSensor(lux))
    with pytest.raises((AssertionError, DriverFault)):
        ProjectorConformance().test_every_answer_and_error_is_of_its_type(Acme(status={"power": "on"}))
    with pytest.raises((AssertionError, DriverFault)):
        CameraConformance().test_every_answer_and_error_is_of_its_type(PlainCamera(), Path("nowhere"))


ANSWERS = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary() | st.sampled_from(Power),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner) | st.tuples(inner, inner),
)
STATUSES = st.builds(ProjectorStatus, ANSWERS, ANSWERS, ANSWERS)


@given(answer=ANSWERS | STATUSES)
def test_only_a_sound_status_comes_through(answer: Any) -> None:
    device = Caller("The driver").device("projector", Acme(status=answer))
    if mismatch(answer, ProjectorStatus):
        with pytest.raises(DriverFault) as caught:
            device.status(deadline=in_seconds(5))
        assert caught.value.what.isprintable()
        return
    status = device.status(deadline=in_seconds(5))
    assert type(status.power) is Power
    assert type(status.faults) is tuple
    assert all(type(fault) is str for fault in status.faults)
    assert type(status.lamp_hours) in (int, type(None))
