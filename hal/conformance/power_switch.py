"""Tests for drivers of mains relays."""

from __future__ import annotations

import pytest

from hal.conformance.device import DeviceConformance
from hal.deadline import in_seconds
from hal.errors import DeviceRefused, DeviceTimeout
from hal.interfaces import PowerSwitch


class PowerSwitchConformance(DeviceConformance):
    """Run on every driver of relays; supply a fixture ``power_switch``. It switches every channel: connect no lamp."""

    def test_says_who_it_is(self, power_switch: PowerSwitch) -> None:
        assert isinstance(power_switch, PowerSwitch)
        self.check_identity(power_switch)

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

    def test_keeps_deadlines_and_stops_when_cancelled(self, power_switch: PowerSwitch) -> None:
        self.check_deadline_and_cancel(power_switch)

    def test_every_answer_and_error_is_of_its_type(self, power_switch: PowerSwitch) -> None:
        self.check_types(
            "power_switch",
            power_switch,
            lambda it: it.channels(deadline=self.soon()),
            lambda it: it.state(1, deadline=self.soon()),
            lambda it: it.switch(1, False, deadline=self.soon()),
        )

    def test_closing_leaves_the_relays_as_they_are_and_twice_is_harmless(self, power_switch: PowerSwitch) -> None:
        power_switch.switch(1, False, deadline=self.soon())
        self.check_closes_twice(power_switch)
