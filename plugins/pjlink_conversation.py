"""Talking PJLink over one connection: greeting, password, questions and commands."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from hal import pjlink
from hal.deadline import Deadline
from hal.errors import DeviceBusy, DeviceGone, DeviceRefused, DeviceTimeout, ProtocolError
from hal.links import ByteLink
from hal.pjlink import Failure, PjClass
from hal.pjlink_udp import is_notification
from hal.profiles import Timing
from hal.values import Power

_PADDED_LINE: Final = 8 * pjlink.LONGEST_LINE


class Pace:
    """How soon the next question may follow: users report projectors that hang when asked often while they start.

    ``slow``: the projector starts, cools, or did not answer.
    """

    def __init__(self, timing: Timing) -> None:
        self.slow = True
        self._timing = timing
        self._asked_at_s = -1e9

    def wait(self, deadline: Deadline) -> None:
        interval_s = self._timing.boot_interval_s if self.slow else self._timing.interval_s
        while (wait_s := self._asked_at_s + interval_s - time.monotonic()) > 0 and not deadline.passed:
            deadline.sleep(wait_s)
        self._asked_at_s = time.monotonic()


class PjLinkConversation:
    """One connection, made when first needed; made again when an answer is lost, because the next would be its."""

    def __init__(
        self,
        connect: Callable[[Deadline], ByteLink],
        name: str,
        password: str | None,
        timing: Timing,
        pace: Pace,
    ) -> None:
        self._connect = connect
        self._name = name
        self._password = password
        self._answer_s = timing.answer_s
        self._command_s = timing.command_s
        self._pace = pace
        self._link: ByteLink | None = None
        self._prefix = b""

    def power(self, deadline: Deadline) -> Power:
        told = self.ask("POWR", deadline)
        if isinstance(told, Failure):
            raise DeviceBusy(
                "projector-busy",
                what=f"The projector at {self._name} would not tell its power state: it answered {told.value}.",
                remedy="Wait until it has finished starting or cooling, and ask again.",
            )
        power = pjlink.parse_power(told)
        self._pace.slow = power in (Power.WARMING, Power.COOLING)
        return power

    def text(self, name: str, deadline: Deadline, pj_class: PjClass = 1) -> str:
        told = self.ask(name, deadline, pj_class)
        return pjlink.parse_text(told) if isinstance(told, str) else ""

    def ask(self, name: str, deadline: Deadline, pj_class: PjClass = 1) -> str | Failure:
        """A question, asked once more over a new connection if its answer is lost."""
        try:
            return self._say(name, "?", deadline, self._answer_s, pj_class)
        except (DeviceTimeout, DeviceGone):
            if deadline.passed:
                raise
            return self._say(name, "?", deadline, self._answer_s, pj_class)

    def tell(self, name: str, parameter: str, deadline: Deadline) -> str | Failure:
        """A command, sent once. After one that switches, the projector is busy with its lamp."""
        try:
            return self._say(name, parameter, deadline, self._command_s, 1)
        finally:
            self._pace.slow |= name == "POWR"

    def close(self) -> None:
        if self._link is not None:
            self._link.close()
            self._link = None

    def check(self, deadline: Deadline) -> None:
        explained = self.no_answer()
        deadline.check(explained.code, what=explained.what, remedy=explained.remedy)

    def no_answer(self) -> DeviceTimeout:
        return DeviceTimeout(
            "projector-no-answer",
            what=f"The projector at {self._name} did not answer.",
            remedy="Check its mains power and network cable, its address, and that PJLink is on in its network menu.",
        )

    def _say(
        self, name: str, parameter: str, deadline: Deadline, patience_s: float, pj_class: PjClass
    ) -> str | Failure:
        self._pace.wait(deadline)
        self.check(deadline)
        try:
            link = self._greeted(deadline.within(patience_s))
            until = deadline.within(patience_s)
            link.write(self._prefix + pjlink.command(name, parameter, pj_class=pj_class), deadline=until)
            self._prefix = b""
            line = _answer_line(link, until)
        except DeviceTimeout as error:
            self.close()
            self._pace.slow = True
            raise self.no_answer() from error
        except (DeviceGone, ProtocolError) as error:
            self.close()
            self._pace.slow |= isinstance(error, DeviceGone)
            raise
        if pjlink.is_refusal(line):
            raise self._wrong_password()
        return pjlink.parse_answer(line, name, pj_class=pj_class)

    def _greeted(self, deadline: Deadline) -> ByteLink:
        if self._link is not None:
            return self._link
        self._link = self._connect(deadline)
        line = self._link.read_until(pjlink.TERMINATOR, limit=pjlink.LONGEST_LINE, deadline=deadline)
        greeting = pjlink.parse_greeting(line)
        if greeting is None or (greeting.random is not None and self._password is None):
            raise self._wrong_password()
        self._prefix = b"" if greeting.random is None else pjlink.digest(greeting.random, self._password or "")
        return self._link

    def _wrong_password(self) -> DeviceRefused:
        had = "did not accept the password" if self._password is not None else "wants a password"
        return DeviceRefused(
            "projector-password",
            what=f"The projector at {self._name} {had}.",
            remedy="Set password in stage.toml to the PJLink password of the projector's network menu.",
        )


def _answer_line(link: ByteLink, deadline: Deadline) -> bytes:
    """The next line that is an answer: users report projectors that tell of themselves first, and pad with NUL."""
    while True:
        line = link.read_until(pjlink.TERMINATOR, limit=_PADDED_LINE, deadline=deadline).lstrip(b"\0")
        if not is_notification(line):
            return line
