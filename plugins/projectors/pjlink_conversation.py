"""PJLink over one connection: greeting, password, queries and commands; what a projector does in its own way is learned
while it is open (``Habits``).
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable
from typing import Final, TypeVar

from hal.codecs.projectors import pjlink
from hal.codecs.projectors.pjlink import Failure, PjClass, is_notification
from hal.codecs.projectors.profiles import Timing
from hal.deadline import Deadline
from hal.errors import DeviceBusy, DeviceGone, DeviceRefused, DeviceTimeout, ProtocolError
from hal.links import ByteLink
from hal.values import Power
from plugins.projectors.answers import OptionalAnswers

_FIELDS: Final = {
    "INST": "inputs",
    "LAMP": "lamp hours",
    "ERST": "faults",
    "CLSS": "extras of PJLink class 2",
    "INF1": "maker",
    "INF2": "model",
    "INFO": "firmware",
    "SVER": "firmware",
    "SNUM": "serial number",
}


class Habits(OptionalAnswers):
    """For one projector. ``name``: its name for the technician, for notes.

    ``slow``: it starts, cools, or did not answer, so the next query has to wait: users report projectors that hang
    when asked often while they start. ``closes``: it closes the connection after each answer. ``second_level``: it
    checks the password by SHA-256; None until MD5 was refused. ``mute``: the kind of AVMT that it accepts.
    """

    def __init__(self, name: str, timing: Timing) -> None:
        self.slow = True
        self.closes = False
        self.second_level: bool | None = None
        self.mute = "1"
        super().__init__(name, _FIELDS)
        self._timing = timing
        self._asked_at_s = -1e9

    def wait(self, deadline: Deadline) -> None:
        """Wait until the next query may be sent."""
        interval_s = self._timing.boot_interval_s if self.slow else self._timing.interval_s
        while (wait_s := self._asked_at_s + interval_s - time.monotonic()) > 0 and not deadline.passed:
            deadline.sleep(wait_s)
        self._asked_at_s = time.monotonic()


T = TypeVar("T")
_PADDED_LINE: Final = 8 * pjlink.LONGEST_LINE


class PjLinkConversation:
    """One connection, opened when first needed, and again when an answer is lost, which could come later."""

    def __init__(
        self,
        connect: Callable[[Deadline], ByteLink],
        name: str,
        password: str | None,
        timing: Timing,
        habits: Habits,
    ) -> None:
        self._connect = connect
        self._name = name
        self._password = password
        self._answer_s = timing.answer_s
        self._command_s = timing.command_s
        self._habits = habits
        self._link: ByteLink | None = None
        self._prefix = b""
        self.reused = False
        """Whether the last query or command used a connection that was used before."""

    def power(self, deadline: Deadline) -> Power:
        reply = self.query("POWR", deadline)
        if isinstance(reply, Failure):
            raise DeviceBusy(
                "projector-busy",
                what=f"The projector at {self._name} did not report its power state: it answered {reply.value}.",
                remedy="Wait until it has finished starting or cooling, then try again.",
            )
        power = pjlink.parse_power(reply)
        self._habits.slow = power in (Power.WARMING, Power.COOLING)
        return power

    def optional(self, name: str, parse: Callable[[str], T], deadline: Deadline, pj_class: PjClass = 1) -> T | None:
        """The answer to an optional query; None if it is refused, missing or not understood.

        Raises only Cancelled and the refusal of the password: only the power state is worth an error.
        """
        if not self._habits.may_ask(name):
            return None
        try:
            reply = self._once_more_if_closed(name, deadline, pj_class)
            answer = None if isinstance(reply, Failure) else parse(reply.strip())
        except (DeviceTimeout, DeviceGone):
            if not deadline.passed:
                self._habits.silent(name)
            return None
        except ProtocolError as error:
            # Further data on this connection may be the rest of it.
            self.close()
            self._habits.odd(name, error.what)
            return None
        self._habits.understood(name)
        return answer

    def _once_more_if_closed(self, name: str, deadline: Deadline, pj_class: PjClass) -> str | Failure:
        try:
            return self._say(name, "?", deadline, self._answer_s, pj_class)
        except DeviceGone:
            if deadline.passed or not self.reused:
                raise
            return self._say(name, "?", deadline, self._answer_s, pj_class)

    def text(self, name: str, deadline: Deadline, pj_class: PjClass = 1) -> str:
        """An optional text; "" if unknown."""
        return self.optional(name, pjlink.parse_text, deadline, pj_class) or ""

    def query(self, name: str, deadline: Deadline, pj_class: PjClass = 1) -> str | Failure:
        """A query, repeated over a new connection if its answer is lost."""
        try:
            return self._say(name, "?", deadline, self._answer_s, pj_class)
        except (DeviceTimeout, DeviceGone):
            if deadline.passed:
                raise
            return self._say(name, "?", deadline, self._answer_s, pj_class)

    def set(self, name: str, parameter: str, deadline: Deadline) -> str | Failure:
        """A command, sent once. After one that switches, the projector is busy with its lamp."""
        try:
            return self._say(name, parameter, deadline, self._command_s, 1)
        finally:
            self._habits.slow |= name == "POWR"

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
        self._habits.wait(deadline)
        self.check(deadline)
        message = pjlink.command(name, parameter, pj_class=pj_class)
        try:
            line = self._exchanged(message, deadline, patience_s, second_level=self._habits.second_level is True)
            if pjlink.is_refusal(line) and self._habits.second_level is None and self._password is not None:
                # It refused the digest, and with it the message: nothing was done.
                line = self._by_second_level(message, deadline, patience_s)
        except DeviceTimeout as error:
            self.close()
            self._habits.slow = True
            raise self.no_answer() from error
        except (DeviceGone, ProtocolError) as error:
            self.close()
            self._habits.slow |= isinstance(error, DeviceGone) and not self.reused
            self._habits.closes |= isinstance(error, DeviceGone) and self.reused
            raise
        if pjlink.is_refusal(line):
            self.close()
            raise self._wrong_password()
        return pjlink.parse_answer(line, name, pj_class=pj_class)

    def _by_second_level(self, message: bytes, deadline: Deadline, patience_s: float) -> bytes:
        """The answer, after the other password check; one that does not know it has refused the password itself."""
        self.close()
        self._habits.second_level = False
        try:
            line = self._exchanged(message, deadline, patience_s, second_level=True)
        except (DeviceTimeout, DeviceGone) as error:
            if deadline.passed:
                raise
            self.close()
            raise self._wrong_password() from error
        self._habits.second_level = not pjlink.is_refusal(line)
        return line

    def _exchanged(self, message: bytes, deadline: Deadline, patience_s: float, *, second_level: bool) -> bytes:
        if self._habits.closes:
            self.close()
        self.reused = self._link is not None
        link = self._greeted(deadline.within(patience_s), second_level)
        until = deadline.within(patience_s)
        link.write(self._prefix + message, deadline=until)
        self._prefix = b""
        return _answer_line(link, until)

    def _greeted(self, deadline: Deadline, second_level: bool) -> ByteLink:
        if self._link is not None:
            return self._link
        self._link = self._connect(deadline)
        line = self._link.read_until(pjlink.TERMINATOR, limit=_PADDED_LINE, deadline=deadline)
        greeting = pjlink.parse_greeting(line)
        if greeting is None or (greeting.random is not None and self._password is None):
            raise self._wrong_password()
        self._prefix = b"" if greeting.random is None else self._proof(greeting.random, deadline, second_level)
        return self._link

    def _proof(self, random: str, deadline: Deadline, second_level: bool) -> bytes:
        """Prefix of the first message, so that the projector accepts it."""
        password = self._password or ""
        if not second_level or self._link is None:
            return pjlink.digest(random, password)
        self._link.write(pjlink.ASK_SECOND_LEVEL, deadline=deadline)
        theirs = pjlink.parse_second_level(_answer_line(self._link, deadline))
        if theirs is None:
            self.close()
            raise self._wrong_password()
        return pjlink.second_level_digest(theirs, secrets.token_bytes(pjlink.SALT_BYTES), password)

    def _wrong_password(self) -> DeviceRefused:
        had = "did not accept the password" if self._password is not None else "requires a password"
        return DeviceRefused(
            "projector-password",
            what=f"The projector at {self._name} {had}.",
            remedy="Set password in stage.toml to the PJLink password of the projector's network menu.",
        )


def _answer_line(link: ByteLink, deadline: Deadline) -> bytes:
    """The next line that is an answer: some projectors send notices first, and pad with NUL."""
    while True:
        line = pjlink.bare(link.read_until(pjlink.TERMINATOR, limit=_PADDED_LINE, deadline=deadline))
        if line != pjlink.TERMINATOR and not is_notification(line):
            return line
