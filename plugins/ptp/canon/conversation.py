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


class EosTalk:
    """A channel to a body, and the body's reports."""

    def __init__(self, channel: Channel) -> None:
        self.channel = channel
        self.state = EosState()
        self._alive_at_s = time.monotonic()

    def drain(self, deadline: Deadline) -> None:
        """Read records until an answer has none."""
        for _ in range(_MOST_DRAINS):
            reply = self.channel.ask(Operation.EOS_GET_EVENT, doing="report its changes", deadline=deadline)
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

        ``again``: also if the body has reported this value already.
        """
        wanted = pack_setting(code, value)[8:]
        if not again and self.state.is_set(code, wanted):
            return self.state.number(code)
        self.state.forget(code)
        self.channel.ask(
            Operation.EOS_SET_PROPERTY,
            data=pack_setting(code, value),
            doing=f"set 0x{code:04x}",
            meanwhile=lambda: self.drain(deadline),
            deadline=deadline,
        )
        if again and not self.state.knows(code):
            self.drain(deadline)
            self.state.assume(code, wanted)  # a body that did not change it has nothing to report
        self._await_value(code, deadline.within(self.channel.timing.answer_s))
        return self.state.number(code)

    def _await_value(self, code: EosProperty, until: Deadline) -> None:
        pause_s = 0.001
        while True:
            self.drain(until)
            if self.state.knows(code):
                return
            if until.passed:
                # The setting is unknown now; a new connection starts with a full report.
                self.channel.link.close()
                raise DeviceTimeout(
                    "camera-not-confirmed",
                    what=f"The camera took a setting (0x{code:04x}) but did not confirm it.",
                    remedy="Turn its mode dial to M and leave its menus, then try again.",
                )
            until.sleep(pause_s)
            pause_s = min(0.05, 2 * pause_s)
