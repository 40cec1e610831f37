"""Tests for every kind of device, and for the kinds with few calls: mains relays, dousers, light sensors and key
panels.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import pytest

from hal.deadline import Cancelled, Deadline, in_seconds
from hal.driver_calls import Caller
from hal.errors import DeviceError, DeviceRefused, DeviceTimeout, DriverFault
from hal.interfaces import ButtonPanel, Device, Douser, LightSensor, PowerSwitch


class DeviceConformance:
    """Tests for every kind of device; subclasses have a fixture ``device``, and add the tests of their ``kind``."""

    kind: ClassVar[str]
    interface: ClassVar[type]
    patience_s: ClassVar[float] = 30.0
    """Deadline of an ordinary call."""
    prompt_s: ClassVar[float] = 6.0
    """A call must end within this time after its deadline or cancellation."""

    def soon(self) -> Deadline:
        return in_seconds(self.patience_s)

    def test_says_who_it_is(self, device: Device) -> None:
        assert isinstance(device, self.interface)
        self.check_identity(device)

    def check_identity(self, device: Device) -> None:
        who = device.identity(deadline=self.soon())
        assert who.model.strip(), "the device must report its model"

    def check_types(self, device: Device, *calls: Callable[[Any], object]) -> None:
        """Each call returns what ``hal.interfaces`` says, and raises a ``DeviceError`` once the device is closed.

        The last test of a kind: a device may be the same in all of them. Closing twice is harmless.
        A driver that raises or returns anything else is stopped by the controller (``hal.driver_calls``), which then
        can only say that it is broken.
        """
        checked = Caller("The driver under test").device(self.kind, device)
        calls = (lambda it: it.identity(deadline=self.soon()), *calls)
        for call in calls:
            call(checked)
        for _ in range(2):
            started = time.monotonic()
            checked.close()
            assert time.monotonic() - started < self.prompt_s, "close() must not block"
        for call in calls:
            with pytest.raises(DeviceError) as caught:
                call(checked)
            assert not isinstance(caught.value, DriverFault), caught.value

    def test_keeps_deadlines_and_stops_when_cancelled(self, device: Device) -> None:
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


class ButtonPanelConformance(DeviceConformance):
    """Run on every key panel driver; supply a fixture ``button_panel``. Do not press a key during the test."""

    kind = "button_panel"
    interface = ButtonPanel

    @pytest.fixture
    def device(self, button_panel: ButtonPanel) -> ButtonPanel:
        return button_panel

    def test_has_keys(self, button_panel: ButtonPanel) -> None:
        keys = button_panel.capabilities
        assert keys.keys > 0
        assert keys.picture_px is None or min(keys.picture_px) > 0

    def test_shows_pictures_or_refuses_them(self, button_panel: ButtonPanel) -> None:
        if button_panel.capabilities.picture_px is None:
            with pytest.raises(DeviceRefused):
                button_panel.show(0, np.zeros((8, 8, 3), np.uint8), deadline=self.soon())
            return
        for key in (0, button_panel.capabilities.keys - 1):
            button_panel.show(key, self.picture(button_panel), deadline=self.soon())

    def test_refuses_what_does_not_fit(self, button_panel: ButtonPanel) -> None:
        picture = self.picture(button_panel)
        for key in (-1, button_panel.capabilities.keys):
            with pytest.raises(DeviceRefused):
                button_panel.show(key, picture, deadline=self.soon())
        for wrong in (picture[:-1], picture[:, :, :2], picture.astype(np.float32)):
            with pytest.raises(DeviceRefused):
                button_panel.show(0, wrong, deadline=self.soon())  # type: ignore[arg-type]

    def test_no_key_is_pressed_by_itself(self, button_panel: ButtonPanel) -> None:
        started = time.monotonic()
        assert button_panel.wait_pressed(deadline=in_seconds(0.3)) is None
        assert 0.2 < time.monotonic() - started < 0.3 + self.prompt_s
        assert button_panel.wait_pressed(deadline=in_seconds(-1.0)) is None

    def test_waiting_ends_when_cancelled(self, button_panel: ButtonPanel) -> None:
        stop = threading.Event()
        threading.Timer(0.2, stop.set).start()
        started = time.monotonic()
        with pytest.raises(Cancelled):
            button_panel.wait_pressed(deadline=in_seconds(self.patience_s, stop))
        assert time.monotonic() - started < 0.2 + self.prompt_s

    def test_shows_no_picture_late(self, button_panel: ButtonPanel) -> None:
        if button_panel.capabilities.picture_px is not None:
            with pytest.raises(DeviceTimeout):
                button_panel.show(0, self.picture(button_panel), deadline=in_seconds(-1.0))

    def test_every_answer_and_error_is_of_its_type(self, button_panel: ButtonPanel) -> None:
        assert Caller("The driver under test").device("button_panel", button_panel).capabilities.keys > 0
        self.check_types(button_panel)

    def picture(self, button_panel: ButtonPanel) -> npt.NDArray[np.uint8]:
        """A grey picture of the right size."""
        width, height = button_panel.capabilities.picture_px or (8, 8)
        return np.full((height, width, 3), 128, np.uint8)


class DouserConformance(DeviceConformance):
    """Run on every driver of dousers; supply a fixture ``douser``. Its blades move."""

    kind = "douser"
    interface = Douser

    @pytest.fixture
    def device(self, douser: Douser) -> Douser:
        return douser

    def test_closes_and_opens_also_twice(self, douser: Douser) -> None:
        for closed in (True, True, False, False, True):
            douser.move(closed, deadline=self.soon())
            assert douser.closed(deadline=self.soon()) is closed

    def test_a_late_command_is_not_carried_out(self, douser: Douser) -> None:
        douser.move(True, deadline=self.soon())
        with pytest.raises(DeviceTimeout):
            douser.move(False, deadline=in_seconds(-1.0))
        assert douser.closed(deadline=self.soon()) is True

    def test_every_answer_and_error_is_of_its_type(self, douser: Douser) -> None:
        self.check_types(
            douser, lambda it: it.move(True, deadline=self.soon()), lambda it: it.closed(deadline=self.soon())
        )


_SUNLIGHT_LUX = 150_000.0


class LightSensorConformance(DeviceConformance):
    """Run on every light sensor driver; supply a fixture ``light_sensor``."""

    kind = "light_sensor"
    interface = LightSensor

    @pytest.fixture
    def device(self, light_sensor: LightSensor) -> LightSensor:
        return light_sensor

    def test_light_is_told_in_lux(self, light_sensor: LightSensor) -> None:
        for _ in range(3):
            lux = light_sensor.illuminance_lux(deadline=self.soon())
            assert math.isfinite(lux)
            assert 0 <= lux < _SUNLIGHT_LUX

    def test_measures_nothing_late(self, light_sensor: LightSensor) -> None:
        with pytest.raises(DeviceTimeout):
            light_sensor.illuminance_lux(deadline=in_seconds(-1.0))

    def test_every_answer_and_error_is_of_its_type(self, light_sensor: LightSensor) -> None:
        self.check_types(light_sensor, lambda it: it.illuminance_lux(deadline=self.soon()))


class PowerSwitchConformance(DeviceConformance):
    """Run on every driver of relays; supply a fixture ``power_switch``. It switches every channel: connect no lamp."""

    kind = "power_switch"
    interface = PowerSwitch

    @pytest.fixture
    def device(self, power_switch: PowerSwitch) -> PowerSwitch:
        return power_switch

    def test_every_channel_closes_and_opens_alone(self, power_switch: PowerSwitch) -> None:
        channels = range(1, power_switch.channels(deadline=self.soon()) + 1)
        assert channels, "a board has at least one relay"
        for channel in channels:
            power_switch.switch(channel, False, deadline=self.soon())
        for channel in channels:
            power_switch.switch(channel, True, deadline=self.soon())
            states = [power_switch.state(other, deadline=self.soon()) for other in channels]
            assert states == [other == channel for other in channels], "only this one is closed"
            power_switch.switch(channel, False, deadline=self.soon())
            assert not power_switch.state(channel, deadline=self.soon())

    def test_switching_twice_is_harmless(self, power_switch: PowerSwitch) -> None:
        for closed in (True, True, False, False):
            power_switch.switch(1, closed, deadline=self.soon())
            assert power_switch.state(1, deadline=self.soon()) is closed

    @pytest.mark.parametrize("past_the_end", [True, False])
    def test_a_channel_that_is_not_there_is_refused(self, power_switch: PowerSwitch, past_the_end: bool) -> None:
        channel = power_switch.channels(deadline=self.soon()) + 1 if past_the_end else 0
        with pytest.raises(DeviceRefused):
            power_switch.switch(channel, True, deadline=self.soon())
        with pytest.raises(DeviceRefused):
            power_switch.state(channel, deadline=self.soon())

    def test_a_late_command_is_not_carried_out(self, power_switch: PowerSwitch) -> None:
        power_switch.switch(1, False, deadline=self.soon())
        with pytest.raises(DeviceTimeout):
            power_switch.switch(1, True, deadline=in_seconds(-1.0))
        assert not power_switch.state(1, deadline=self.soon())

    def test_every_answer_and_error_is_of_its_type(self, power_switch: PowerSwitch) -> None:
        self.check_types(
            power_switch,
            lambda it: it.channels(deadline=self.soon()),
            lambda it: it.state(1, deadline=self.soon()),
            lambda it: it.switch(1, False, deadline=self.soon()),
        )
