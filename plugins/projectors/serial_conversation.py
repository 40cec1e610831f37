"""Communication with a serial projector: one query at a time, and never an old answer for a new query. A message is a
line, a counted frame or a JSON object, as the projector's table says.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from hal.codecs.projectors.profiles import Timing
from hal.codecs.projectors.serial_protocol import (
    OBJECT_END,
    Answer,
    Reply,
    UnaskedMessage,
    command_bytes,
    head_bytes,
    is_complete,
    parse_line,
    query_bytes,
    rest_bytes,
)
from hal.codecs.projectors.serial_table import Frame, Query, SerialTable
from hal.deadline import Deadline
from hal.errors import DeviceBusy, DeviceGone, DeviceTimeout, ProtocolError
from hal.links import ByteLink


def read_message(link: ByteLink, table: SerialTable, deadline: Deadline) -> bytes:
    """The next message. Raises what the link raises, and ProtocolError for one that can't be of this family."""
    if table.frame is not None:
        return _framed(link, table.frame, table.longest_answer, deadline)
    return _object(link, table, deadline) if table.json else _ended(link, table, deadline)


def _framed(link: ByteLink, frame: Frame, longest: int, deadline: Deadline) -> bytes:
    head = link.read_exactly(head_bytes(frame), deadline=deadline)
    return head + link.read_exactly(rest_bytes(frame, head, longest=longest), deadline=deadline)


def _object(link: ByteLink, table: SerialTable, deadline: Deadline) -> bytes:
    """A JSON object, up to the brace that closes it."""
    data = link.read_until(OBJECT_END, limit=table.longest_answer, deadline=deadline)
    while not is_complete(data) and len(data) < table.longest_answer:
        data += link.read_until(OBJECT_END, limit=table.longest_answer - len(data), deadline=deadline)
    return data


def _ended(link: ByteLink, table: SerialTable, deadline: Deadline) -> bytes:
    """A line up to its terminator; a terminator in quotes does not end the line."""
    quote = table.quirks.quote.encode("latin-1")
    line = link.read_until(table.terminator, limit=table.longest_answer, deadline=deadline)
    while quote and line.count(quote) % 2 and len(line) < table.longest_answer:
        line += link.read_until(table.terminator, limit=table.longest_answer - len(line), deadline=deadline)
    return line


REAPPEAR_S: Final = 4.0
"""Time to wait for an unplugged port: USB adapters need a second or two to come back."""
COOLS: Final = "projector-cools"
"""Code of the DeviceBusy of a projector whose lamp cools."""
SERIAL_CHECK: Final = "its serial cable, and the baud rate and profile in stage.toml"
"""What to check if a projector on a serial line is silent."""


class SerialConversation:
    """Queries and commands over a link that may be unplugged and come back.

    An answer does not contain its query. So every unread line is removed from the link before a query, and after a
    lost answer no query is sent until that answer can no longer come.

    ``notice`` is called for every unsolicited line; ``slow`` is true if the projector starts or cools, and must not
    be asked often; ``check``: what a technician should check if it is silent.
    """

    def __init__(
        self,
        open_link: Callable[[Deadline], ByteLink],
        *,
        name: str,
        timing: Timing,
        table: SerialTable,
        notice: Callable[[UnaskedMessage], None],
        slow: Callable[[], bool],
        check: str = SERIAL_CHECK,
    ) -> None:
        self._check_what = check
        self._open_link = open_link
        self._name = name
        self._timing = timing
        self._table = table
        self._notice = notice
        self._slow = slow
        self._link: ByteLink | None = None
        self._closed = False
        self._sent = b""
        self._number = 1
        self._sent_at_s = -1e9
        self._owed = 0
        self._owed_until_s = 0.0
        self._garbage: ProtocolError | None = None

    def open(self, deadline: Deadline) -> None:
        """Open the link now, so that a wrong port is reported at once."""
        self._link = self._open_link(deadline)

    def close(self) -> None:
        """Close the link for good. A call in another thread ends with DeviceGone."""
        self._closed = True
        self._hang_up()

    def _hang_up(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            link.close()

    def query(self, question: str, *, deadline: Deadline) -> str:
        """The value of the answer to a query of the profile; repeated if the answer is lost.

        Raises
        ------
        DeviceTimeout  no answer to either
        ProtocolError  the data was not an answer
        DeviceBusy     the projector refuses to answer now (code ``COOLS``: because its lamp cools)
        DeviceGone     the port was unplugged and did not come back
        """
        query = self._table.queries[question]
        self._garbage = None
        settled = False
        for attempt in (1, 2):
            try:
                if settled:
                    self._clear(self._connected(deadline))  # half an answer must not be joined with the next
                else:
                    self._settled(deadline)
                    settled = True
                self._say(query_bytes(self._table, query, self._table.address, self._number), deadline)
                reply = self._listen(query, deadline.within(self._timing.answer_s))
            except DeviceGone:
                self._hang_up()
                if attempt == 2:
                    raise
                continue
            if isinstance(reply, Answer):
                return reply.value
            if reply is not None:
                raise self._busy(question, cooling=reply is Reply.COOLING)
            self._check(deadline)
        raise self._garbage or self.no_answer()

    def command(self, command: str, *, deadline: Deadline) -> Reply | None:
        """Send a command once; None if no reply came. Never sent again: the caller must check its effect."""
        self._settled(deadline)
        try:
            self._say(command_bytes(self._table, command, self._table.address, self._number), deadline)
            reply = self._listen(None, deadline.within(self._timing.command_s))
        except DeviceGone:
            self._hang_up()
            return None
        return reply if isinstance(reply, Reply) else None

    def check_open(self) -> None:
        """Raise DeviceGone("projector-closed") after ``close``."""
        if self._closed:
            raise DeviceGone(
                "projector-closed",
                what=f"The projector at {self._name} is no longer open.",
                remedy="Open the stage again.",
            )

    def no_answer(self) -> DeviceTimeout:
        return DeviceTimeout(
            "projector-no-answer",
            what=f"The projector at {self._name} did not answer.",
            remedy=f"Check its mains power, {self._check_what}.",
        )

    def _settled(self, deadline: Deadline) -> None:
        """``_settle``, on a new link if this one was lost: a network port is closed after a while without commands."""
        try:
            self._settle(deadline)
        except DeviceGone:
            self._hang_up()
            self._settle(deadline)

    def _settle(self, deadline: Deadline) -> None:
        """Wait until the projector may be asked again, and remove old data from the link."""
        link = self._connected(deadline)
        interval_s = self._timing.boot_interval_s if self._slow() else self._timing.interval_s
        while (wait_s := self._sent_at_s + interval_s - time.monotonic()) > 0:
            self._check(deadline)
            deadline.sleep(wait_s)
        while self._owed and time.monotonic() < self._owed_until_s:
            self._check(deadline)
            late = deadline.within(self._owed_until_s - time.monotonic())
            if (line := self._line(link, late)) is not None and not self._swallow(line):
                self._owed -= 1
        self._owed = 0
        self._clear(link)

    def _clear(self, link: ByteLink) -> None:
        """Remove all data from the link; notices are passed on."""
        left = link.drain()
        for line in left.split(self._table.terminator) if self._table.terminator else ():
            self._swallow(line)

    def _say(self, data: bytes, deadline: Deadline) -> None:
        link = self._connected(deadline)
        self._check(deadline)
        try:
            link.write(data, deadline=deadline)
        except DeviceTimeout as error:
            raise self.no_answer() from error
        self._sent, self._sent_at_s = data, time.monotonic()
        self._number += 1
        self._owed += 1
        self._owed_until_s = self._sent_at_s + self._timing.late_s

    def _listen(self, query: Query | None, deadline: Deadline) -> Answer | Reply | None:
        """The reply to the last message, or None if none came in time; notices are passed on."""
        link = self._connected(deadline)
        while (line := self._line(link, deadline)) is not None:
            try:
                meaning = parse_line(self._table, line, query, sent=self._sent)
            except ProtocolError as error:
                self._garbage = error
                continue
            if isinstance(meaning, UnaskedMessage):
                self._notice(meaning)
            elif meaning is Reply.NOTHING or (query is not None and meaning is Reply.ACCEPTED):
                continue  # some models accept a query before they answer it
            else:
                self._owed -= 1
                return meaning
        return None

    def _line(self, link: ByteLink, deadline: Deadline) -> bytes | None:
        """The next line that is not empty, or the next frame; None when the deadline passes."""
        while True:
            try:
                line = read_message(link, self._table, deadline)
            except ProtocolError as error:
                self._garbage = error
                link.drain()
                continue
            except DeviceTimeout:
                return self._abnormal(link)
            if line.strip():
                return line

    def _abnormal(self, link: ByteLink) -> bytes | None:
        """Data without a terminator, if it is complete by the rule for abnormal states."""
        end = self._table.quirks.abnormal_terminator
        left = link.drain() if end else b""
        return left if end and left.strip() and left.endswith(end) else None

    def _swallow(self, line: bytes) -> bool:
        """Pass on a notice; return False for an old answer, True for what an old answer may still follow."""
        try:
            meaning = parse_line(self._table, line, sent=self._sent)
        except ProtocolError:
            return False
        if isinstance(meaning, UnaskedMessage):
            self._notice(meaning)
        return meaning not in (Reply.REFUSED, Reply.COOLING)

    def _connected(self, deadline: Deadline) -> ByteLink:
        """The link; opened again, by the same name, if it was lost."""
        patience = deadline.within(REAPPEAR_S)
        link = self._link
        while link is None:
            self._check(deadline)
            self.check_open()
            try:
                link = self._link = self._open_link(deadline)
            except (DeviceGone, DeviceBusy):
                if patience.passed:
                    raise
                patience.sleep(0.1)
        if self._closed:
            link.close()  # ``close`` may have run before it existed
        self.check_open()
        return link

    def _check(self, deadline: Deadline) -> None:
        explained = self.no_answer()
        deadline.check(explained.code, what=explained.what, remedy=explained.remedy)

    def _busy(self, question: str, *, cooling: bool) -> DeviceBusy:
        return DeviceBusy(
            COOLS if cooling else "projector-busy",
            what=f"The projector at {self._name} does not report its {question.replace('_', ' ')} now.",
            remedy="Wait until it has finished starting or cooling, then try again.",
        )
