"""PJLink over one connection, which is kept: greeting, password, queries and commands; what a projector does in its own
way is learned while it is open (``Habits``).
"""

from __future__ import annotations

import secrets
from collections.abc import Callable
from typing import Final, TypeVar

from hal.codecs.projectors import pjlink
from hal.codecs.projectors.pjlink import Failure, PjClass, is_notification
from hal.codecs.projectors.profiles import ProjectorProfile
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
    when asked often while they start. ``closes``: it closes the connection after each answer. ``proves_each``: it wants
    the password's digest with each command of a connection. ``second_level``: it checks the password by SHA-256; None
    until MD5 was refused. ``mute``: the kind of AVMT that it accepts.
    """

    def __init__(self, name: str, profile: ProjectorProfile) -> None:
        self.slow = True
        self.closes = False
        self.proves_each = False
        self.second_level: bool | None = None
        self.mute = "1"
        super().__init__(name, _FIELDS)
        self._timing, self._lamp = profile.timing, profile.lamp
        self._asked_at_s = -1e9
        self.unavailable_since_s: float | None = None
        """Since when it answers that it can't tell its power state now."""
        self._switched_on_at_s = -1e9

    def switched(self, on: bool) -> None:
        """The last message was to switch it on or off."""
        self._switched_on_at_s = self._asked_at_s if on else -1e9

    def power_unavailable(self, deadline: Deadline) -> Power | None:
        """The power state of a projector that answers ERR3 to the question for it; None: not known yet.

        Lit ones may say so for a moment. After that its lamp starts or cools. Many say so in standby, for ever.
        """
        now_s = deadline.time.monotonic()
        if self.unavailable_since_s is None:
            self.unavailable_since_s = now_s
        since_s = now_s - self.unavailable_since_s
        if now_s - self._switched_on_at_s < self._lamp.warm_up_s:
            return Power.WARMING
        if since_s < self._timing.question_s:
            return None
        return Power.COOLING if since_s < self._timing.question_s + self._lamp.cool_down_s else Power.OFF

    def wait(self, deadline: Deadline) -> None:
        """Wait until the next query may be sent."""
        interval_s = self._timing.boot_interval_s if self.slow else self._timing.interval_s
        while (wait_s := self._asked_at_s + interval_s - deadline.time.monotonic()) > 0 and not deadline.passed:
            deadline.sleep(wait_s)
        self._asked_at_s = deadline.time.monotonic()


T = TypeVar("T")
_IDLE_S: Final = 2.0
_PADDED_LINE: Final = 8 * pjlink.LONGEST_LINE


class PjLinkConversation:
    """One connection, opened when first needed, and again when the projector has closed it (the specification lets it,
    after 30 s without a command) or an answer is lost, which could come later.
    """

    def __init__(
        self, connect: Callable[[Deadline], ByteLink], name: str, password: str | None, profile: ProjectorProfile
    ) -> None:
        self._connect = connect
        self._name = name
        self._password = password
        self._answer_s = profile.timing.answer_s
        self._command_s = profile.timing.command_s
        self.habits = Habits(name, profile)
        self._link: ByteLink | None = None
        self._closed = False
        self._answered_at_s = 0.0
        self._prefix = b""
        self.reused = False
        """Whether the last query or command used a connection that was used before."""

    def power(self, deadline: Deadline) -> Power:
        """FAULT if it answers that it failed, UNKNOWN if it gives a state that the specification does not have."""
        reply = self.query("POWR", deadline)
        if reply is not Failure.UNAVAILABLE:
            self.habits.unavailable_since_s = None
        power = self._failed_power(reply, deadline) if isinstance(reply, Failure) else pjlink.parse_power(reply)
        self.habits.slow = power in (Power.WARMING, Power.COOLING)
        return power

    def _failed_power(self, reply: Failure, deadline: Deadline) -> Power:
        power = self.habits.power_unavailable(deadline) if reply is Failure.UNAVAILABLE else None
        if reply is Failure.FAILURE:
            power = Power.FAULT
        if power is None:
            raise DeviceBusy(
                "projector-busy",
                what=f"The projector at {self._name} did not report its power state: it answered {reply.value}.",
                remedy="Wait two minutes: it may be starting or cooling. If it stays so, set its standby mode to one "
                "with network, or switch it on with its own button.",
            )
        return power

    def optional(self, name: str, parse: Callable[[str], T], deadline: Deadline, pj_class: PjClass = 1) -> T | None:
        """The answer to an optional query; None if it is refused, missing or not understood.

        Raises only Cancelled and the refusal of the password: only the power state is worth an error.
        """
        if not self.habits.may_ask(name):
            return None
        try:
            reply = self._once_more_if_closed(name, deadline, pj_class)
            answer = None if isinstance(reply, Failure) else parse(reply.strip())
        except (DeviceTimeout, DeviceGone):
            if not deadline.passed:
                self.habits.silent(name)
            return None
        except ProtocolError as error:
            # Further data on this connection may be the rest of it.
            self._hang_up()
            self.habits.odd(name, error.what)
            return None
        self.habits.understood(name)
        return answer

    def _once_more_if_closed(self, name: str, deadline: Deadline, pj_class: PjClass) -> str | Failure:
        try:
            return self._say(name, "?", deadline, self._answer_s, pj_class)
        except DeviceGone:
            if self._closed or deadline.passed or not self.reused:
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
            if self._closed or deadline.passed:
                raise
            return self._say(name, "?", deadline, self._answer_s, pj_class)

    def set(self, name: str, parameter: str, deadline: Deadline) -> str | Failure:
        """A command, sent once. After one that switches, the projector is busy with its lamp."""
        try:
            return self._say(name, parameter, deadline, self._command_s, 1)
        finally:
            if name == "POWR":
                self.habits.slow = True
                self.habits.switched(parameter == "1")

    def close(self) -> None:
        """Close for good. A call in another thread ends with DeviceGone."""
        self._closed = True
        self._hang_up()

    def _hang_up(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            link.close()

    def check_open(self) -> None:
        """Raise DeviceGone("projector-closed") after ``close``."""
        if self._closed:
            raise DeviceGone(
                "projector-closed",
                what=f"The projector at {self._name} is no longer open.",
                remedy="Open the stage again.",
            )

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
        self.habits.wait(deadline)
        self.check(deadline)
        message = pjlink.command(name, parameter, pj_class=pj_class)
        try:
            line = self._accepted(message, deadline, patience_s)
        except DeviceTimeout as error:
            self._hang_up()
            self.habits.slow = True
            raise self.no_answer() from error
        except DeviceGone:
            self._hang_up()
            self.habits.slow |= not self.reused
            self.habits.closes |= self.reused and self._just_answered(deadline)
            raise
        except BaseException:
            self._hang_up()
            raise
        if pjlink.is_refusal(line):
            self._hang_up()
            raise self._wrong_password()
        self._answered_at_s = deadline.time.monotonic()
        return pjlink.parse_answer(line, name, pj_class=pj_class)

    def _just_answered(self, deadline: Deadline) -> bool:
        """Whether the last answer came so short ago that a connection is not closed because it is idle."""
        return deadline.time.monotonic() - self._answered_at_s < _IDLE_S

    def _accepted(self, message: bytes, deadline: Deadline, patience_s: float) -> bytes:
        """The answer. A refusal of the digest is one of the message, too: nothing was done, and it is sent again."""
        habits = self.habits
        line = self._exchanged(message, deadline, patience_s, second_level=habits.second_level is True)
        if pjlink.is_refusal(line) and self.reused:
            # The password was right on this connection: it wants the proof again, or a connection for each command.
            habits.closes, habits.proves_each = habits.proves_each, True
            self._hang_up()
            line = self._exchanged(message, deadline, patience_s, second_level=habits.second_level is True)
        if pjlink.is_refusal(line) and habits.second_level is None and self._password is not None:
            line = self._by_second_level(message, deadline, patience_s)
        return line

    def _by_second_level(self, message: bytes, deadline: Deadline, patience_s: float) -> bytes:
        """The answer, after the other password check; one that does not know it has refused the password itself."""
        self._hang_up()
        self.habits.second_level = False
        try:
            line = self._exchanged(message, deadline, patience_s, second_level=True)
        except (DeviceTimeout, DeviceGone) as error:
            if deadline.passed:
                raise
            raise self._wrong_password() from error
        self.habits.second_level = not pjlink.is_refusal(line)
        return line

    def _exchanged(self, message: bytes, deadline: Deadline, patience_s: float, *, second_level: bool) -> bytes:
        if self._link is not None:
            try:
                # Of an answer before nothing is left, and a connection that was closed meanwhile carries no command.
                self._link.drain()
            except DeviceGone:
                self.habits.closes |= self._just_answered(deadline)
                self._hang_up()
        if self.habits.closes:
            self._hang_up()
        self.reused = self._link is not None
        link = self._greeted(deadline.within(patience_s), second_level)
        until = deadline.within(patience_s)
        link.write(self._prefix + message, deadline=until)
        if not self.habits.proves_each:
            self._prefix = b""
        return _answer_line(link, until)

    def _greeted(self, deadline: Deadline, second_level: bool) -> ByteLink:
        if self._link is not None:
            return self._link
        self.check_open()
        self._link = link = self._connect(deadline)
        self.check_open()  # it may have been closed meanwhile
        line = link.read_until(pjlink.TERMINATOR, limit=_PADDED_LINE, deadline=deadline)
        greeting = pjlink.parse_greeting(line)
        if greeting is None or (greeting.random is not None and self._password is None):
            raise self._wrong_password()
        self._prefix = b"" if greeting.random is None else self._proof(link, greeting.random, deadline, second_level)
        return link

    def _proof(self, link: ByteLink, random: str, deadline: Deadline, second_level: bool) -> bytes:
        """Prefix of the first message, so that the projector accepts it."""
        password = self._password or ""
        if not second_level:
            return pjlink.digest(random, password)
        link.write(pjlink.ASK_SECOND_LEVEL, deadline=deadline)
        theirs = pjlink.parse_second_level(_answer_line(link, deadline))
        if theirs is None:
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
