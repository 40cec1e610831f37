"""Tests for drivers of dousers."""

from __future__ import annotations

import pytest

from hal.conformance.device import DeviceConformance
from hal.deadline import in_seconds
from hal.errors import DeviceTimeout
from hal.interfaces import Douser


class DouserConformance(DeviceConformance):
    """Run on every driver of dousers; supply a fixture ``douser``. Its blades move."""

    def test_says_who_it_is(self, douser: Douser) -> None:
        assert isinstance(douser, Douser)
        self.check_identity(douser)

    def test_closes_and_opens_also_twice(self, douser: Douser) -> None:
        for closed in (True, True, False, False, True):
            douser.move(closed, deadline=self.soon())
            assert douser.closed(deadline=self.soon()) is closed

    def test_a_late_command_is_not_carried_out(self, douser: Douser) -> None:
        douser.move(True, deadline=self.soon())
        with pytest.raises(DeviceTimeout):
            douser.move(False, deadline=in_seconds(-1.0))
        assert douser.closed(deadline=self.soon()) is True

    def test_keeps_deadlines_and_stops_when_cancelled(self, douser: Douser) -> None:
        self.check_deadline_and_cancel(douser)

    def test_every_answer_and_error_is_of_its_type(self, douser: Douser) -> None:
        self.check_types(
            "douser",
            douser,
            lambda it: it.move(True, deadline=self.soon()),
            lambda it: it.closed(deadline=self.soon()),
        )

    def test_closing_twice_is_harmless(self, douser: Douser) -> None:
        self.check_closes_twice(douser)
