"""Tests for projector drivers."""

from __future__ import annotations

import math
import time
from typing import ClassVar

import pytest

from hal.conformance.device import DeviceConformance
from hal.deadline import in_seconds
from hal.driver_calls import Caller
from hal.errors import DeviceRefused, DeviceTimeout
from hal.interfaces import Projector
from hal.values import Power, ProjectorStatus


class ProjectorConformance(DeviceConformance):
    """Run on every projector driver; supply a fixture ``projector``. It switches the lamp on and off."""

    kind = "projector"
    interface = Projector
    poll_s: ClassVar[float] = 0.5
    """Pause between two queries while the lamp warms or cools."""

    @pytest.fixture
    def device(self, projector: Projector) -> Projector:
        return projector

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
        assert after in (Power.COOLING, Power.OFF), "the status must be new, not stored"
        self.bring(projector, Power.OFF)
        projector.switch_off(deadline=self.soon())
        assert projector.status(deadline=self.soon()).power is Power.OFF, "switching off twice is harmless"

    def check_power_is_refused(self, projector: Projector) -> None:
        """A driver that can't switch reports this, and reports no power state that it can't know."""
        for switch in (projector.switch_on, projector.switch_off):
            with pytest.raises(DeviceRefused) as caught:
                switch(deadline=self.soon())
            assert caught.value.remedy
        assert projector.status(deadline=self.soon()).power in (Power.UNKNOWN, Power.COOLING)

    def test_on_while_the_lamp_cools_is_refused_or_kept_safe(self, projector: Projector) -> None:
        if not projector.capabilities.power:
            return  # it always refuses, as tested above
        self.bring(projector, Power.ON)
        before_off = time.monotonic()
        projector.switch_off(deadline=self.soon())
        if projector.status(deadline=self.soon()).power is not Power.COOLING:
            return  # this lamp does not cool, so there is nothing to refuse
        try:
            projector.switch_on(deadline=self.soon())
        except DeviceRefused:
            assert projector.status(deadline=self.soon()).power in (Power.COOLING, Power.OFF)
            return
        # A busy machine can take longer to ask than a lamp takes to cool; then it may light again.
        dark_s = time.monotonic() - before_off
        assert dark_s >= projector.capabilities.lamp_rules.cool_down_s, f"lit a hot lamp, {dark_s:.2f} s after off"

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

    def test_tells_no_status_late(self, projector: Projector) -> None:
        with pytest.raises(DeviceTimeout):
            projector.status(deadline=in_seconds(-1.0))

    def test_every_answer_and_error_is_of_its_type(self, projector: Projector) -> None:
        assert Caller("The driver under test").device("projector", projector).capabilities == projector.capabilities
        self.check_types(projector, lambda it: it.status(deadline=self.soon()))

    def lit(self, projector: Projector) -> ProjectorStatus:
        """The status with the lamp on, if the driver can switch it; else unchanged."""
        if projector.capabilities.power:
            return self.bring(projector, Power.ON)
        return projector.status(deadline=self.soon())

    def bring(self, projector: Projector, wanted: Power) -> ProjectorStatus:
        """Bring the lamp to ON or OFF by the driver's own calls, from any state."""
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
            # Some models report standby before the minimum off time is over; the loop asks again.
            time.sleep(self.poll_s)
