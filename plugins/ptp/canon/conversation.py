"""Communication with a Canon EOS body: its reports, its settings, and keeping it awake."""

from __future__ import annotations

import time
from typing import Final

from hal.codecs.ptp.eos import EosProperty, ImageFormat, pack_setting, parse_records
from hal.codecs.ptp.values import Operation
from hal.deadline import Deadline
from hal.errors import DeviceTimeout
from plugins.ptp.body import Channel
from plugins.ptp.canon.state import EosState

_MOST_DRAINS: Final = 200
_EXPOSURE: Final = (EosProperty.APERTURE, EosProperty.SHUTTER, EosProperty.ISO)


class EosTalk:
    """A channel to a body, and the body's reports."""

    def __init__(self, channel: Channel) -> None:
        self.channel = channel
        self.state = EosState()
        self._alive_at_s = time.monotonic()

    def drain(self, deadline: Deadline) -> None:
        """Read records until an answer has none."""
        for _ in range(_MOST_DRAINS):
            reply = self.channel.request(Operation.EOS_GET_EVENT, doing="report its changes", deadline=deadline)
            records = parse_records(reply.data)
            self.state.take(records)
            if self.state.falls_asleep:
                self.state.falls_asleep = False
                self.keep_alive(deadline, at_once=True)
            if not records:
                return

    def keep_alive(self, deadline: Deadline, *, at_once: bool = False) -> None:
        """Keep it awake, unless that was just done."""
        due = at_once or time.monotonic() - self._alive_at_s >= self.channel.timing.keep_alive_s
        if due and self.channel.has(Operation.EOS_KEEP_DEVICE_ON):
            self.channel.once(Operation.EOS_KEEP_DEVICE_ON, deadline=deadline)
            self._alive_at_s = time.monotonic()

    def set(self, code: EosProperty, value: int | ImageFormat, deadline: Deadline, *, again: bool = False) -> int:
        """Set a property and wait until the body reports it (C189); return the reported value.

        ``again``: also if the body has reported this value already. A body that accepts it and reports nothing is asked
        to report everything. If that does not tell, a note says so and the accepted value counts, except for exposure
        settings: DeviceTimeout("camera-not-confirmed"), because photographs would be measured with a wrong value.
        """
        wanted = pack_setting(code, value)[8:]
        if not again and self.state.is_set(code, wanted):
            return self.state.number(code)
        self.state.forget(code)
        self.channel.request(
            Operation.EOS_SET_PROPERTY,
            data=pack_setting(code, value),
            doing=f"set 0x{code:04x}",
            meanwhile=lambda: self.drain(deadline),
            deadline=deadline,
        )
        if again and not self.state.knows(code):
            self.drain(deadline)
            self.state.assume(code, wanted)  # a body that did not change it has nothing to report
        if not self._reported(code, deadline):
            what = f"The camera took a setting (0x{code:04x}) but did not confirm it."
            if code in _EXPOSURE or deadline.passed:
                # The setting is unknown now; a new connection starts with a full report.
                self.channel.link.close()
                raise DeviceTimeout(
                    "camera-not-confirmed",
                    what=what,
                    remedy="Turn its mode dial to M and leave its menus, then try again.",
                )
            self.channel.diary.add("camera-not-confirmed", what)
            self.state.assume(code, wanted)
        return self.state.number(code)

    def _reported(self, code: EosProperty, deadline: Deadline) -> bool:
        """Wait for the report; then have everything reported, and wait again."""
        if self._await_value(code, deadline.within(self.channel.timing.confirm_s)):
            return True
        if deadline.passed:
            return False
        self.channel.request(Operation.EOS_SET_EVENT_MODE, 1, doing="report everything", deadline=deadline)
        return self._await_value(code, deadline.within(self.channel.timing.confirm_s))

    def _await_value(self, code: EosProperty, until: Deadline) -> bool:
        pause_s = 0.001
        while True:
            try:
                self.drain(until)
            except DeviceTimeout:
                if self.channel.link.broken:
                    raise
            if self.state.knows(code) or until.passed:
                return self.state.knows(code)
            until.sleep(pause_s)
            pause_s = min(0.05, 2 * pause_s)
