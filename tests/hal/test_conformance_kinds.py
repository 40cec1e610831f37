"""The suites for relays, light sensors and key panels pass devices that keep their promises and catch others."""

from __future__ import annotations

import math
import time

import numpy as np
import numpy.typing as npt
import pytest

from hal.conformance import ButtonPanelConformance, LightSensorConformance, PowerSwitchConformance
from hal.deadline import Deadline
from hal.errors import DeviceGone, DeviceRefused
from hal.values import DeviceIdentity, PanelCapabilities

FAILED = (AssertionError, pytest.fail.Exception)


class Base:
    """What the devices share; ``flaw`` names the promise that one breaks."""

    def __init__(self, flaw: str = "") -> None:
        self.flaw, self.closed = flaw, False

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        self.check(deadline)
        return DeviceIdentity("Velatura", "in memory")

    def close(self) -> None:
        self.closed = True

    def check(self, deadline: Deadline) -> None:
        if self.flaw != "late":
            deadline.check("late", what="The deadline has passed.", remedy="Allow more time.")
        if self.closed:
            raise DeviceGone("closed", what="It is closed.", remedy="Open it.")


def refused() -> DeviceRefused:
    return DeviceRefused("refused", what="It will not.", remedy="Ask for something else.")


class MemoryRelays(Base):
    """Two relays."""

    def __init__(self, flaw: str = "") -> None:
        super().__init__(flaw)
        self.states = [False, False]

    def channels(self, *, deadline: Deadline) -> int:
        self.check(deadline)
        return 2

    def state(self, channel: int, *, deadline: Deadline) -> bool:
        self.number(channel, deadline)
        return self.states[channel - 1]

    def switch(self, channel: int, closed: bool, *, deadline: Deadline) -> None:
        self.number(channel, deadline)
        for each in range(2) if self.flaw == "both" else (channel - 1,):
            self.states[each] = closed

    def number(self, channel: int, deadline: Deadline) -> None:
        self.check(deadline)
        if not 1 <= channel <= 2:
            raise refused()


class MemorySensor(Base):
    """It is dark."""

    def illuminance_lux(self, *, deadline: Deadline) -> float:
        self.check(deadline)
        return math.nan if self.flaw == "nan" else 0.2


class MemoryPanel(Base):
    """Six keys."""

    capabilities = PanelCapabilities(6, (16, 12))

    def show(self, key: int, picture: npt.NDArray[np.uint8], *, deadline: Deadline) -> None:
        self.check(deadline)
        fits = self.flaw == "any picture" or (picture.shape == (12, 16, 3) and picture.dtype == np.uint8)
        if not 0 <= key < 6 or not fits:
            raise refused()

    def wait_pressed(self, *, deadline: Deadline) -> int | None:
        if self.flaw == "presses itself":
            return 1
        while deadline.left_s() > 0:
            deadline.sleep(0.05) if self.flaw != "deaf" else time.sleep(0.05)
        return None


class TestMemoryRelays(PowerSwitchConformance):
    @pytest.fixture
    def power_switch(self) -> MemoryRelays:
        return MemoryRelays()


class TestMemorySensor(LightSensorConformance):
    @pytest.fixture
    def light_sensor(self) -> MemorySensor:
        return MemorySensor()


class TestMemoryPanel(ButtonPanelConformance):
    @pytest.fixture
    def button_panel(self) -> MemoryPanel:
        return MemoryPanel()


class Impatient(ButtonPanelConformance):
    """So that a panel that cannot be cancelled is caught soon."""

    patience_s = 1.0
    prompt_s = 0.3


def test_relays_that_move_together_are_caught() -> None:
    with pytest.raises(FAILED):
        PowerSwitchConformance().test_every_channel_closes_and_opens_alone(MemoryRelays("both"))


def test_a_relay_that_moves_after_its_deadline_is_caught() -> None:
    with pytest.raises(FAILED):
        PowerSwitchConformance().test_a_late_command_is_not_carried_out(MemoryRelays("late"))


def test_light_that_is_no_number_is_caught() -> None:
    with pytest.raises(FAILED):
        LightSensorConformance().test_light_is_told_in_lux(MemorySensor("nan"))


def test_a_panel_that_shows_what_does_not_fit_is_caught() -> None:
    with pytest.raises(FAILED):
        ButtonPanelConformance().test_refuses_what_does_not_fit(MemoryPanel("any picture"))


def test_a_panel_that_presses_itself_or_cannot_be_cancelled_is_caught() -> None:
    with pytest.raises(FAILED):
        ButtonPanelConformance().test_no_key_is_pressed_by_itself(MemoryPanel("presses itself"))
    with pytest.raises(FAILED):
        Impatient().test_waiting_ends_when_cancelled(MemoryPanel("deaf"))
