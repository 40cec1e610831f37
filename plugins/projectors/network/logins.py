"""Opens a projector's own network port, with the login that its profile names.

Panasonic's NTCONTROL is a line that speaks the STX/ETX protocol of the serial port. The projector closes the connection
after each answer, unless its menu says otherwise. So each command has a connection of its own, with the greeting and
the digest of the password.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from hal.codecs.projectors import logins
from hal.codecs.projectors.logins import (
    NTCONTROL_END,
    NtGreeting,
    ntcontrol_command,
    parse_ntcontrol_answer,
    parse_ntcontrol_greeting,
    wrong_password,
)
from hal.codecs.projectors.profiles import NetworkTable
from hal.deadline import Deadline
from hal.errors import DeviceGone, ProtocolError
from hal.links import ByteLink, TcpLink
from hal.transcript import Transcript

STX: Final = b"\x02"
ETX: Final = b"\x03"
GREETING_S: Final = 5.0
_LONGEST: Final = 256
_NUMBER: Final = re.compile(rb"\AAD[0-9A-Z]{2};")


class NtControlLink:
    """``hal.links.ByteLink``. Connects at once, so that a wrong address or password is reported early.

    ``connect`` opens a connection; ``name``: of the projector, for messages.
    """

    def __init__(
        self,
        connect: Callable[[Deadline], ByteLink],
        name: str,
        *,
        user: str,
        password: str | None,
        deadline: Deadline,
        transcript: Transcript | None = None,
    ) -> None:
        self._connect = connect
        self._name = name
        self._user = user
        self._password = password
        self._transcript = transcript
        self._command = bytearray()
        self._link: ByteLink | None = None
        self._greeting = NtGreeting()
        self._closed = False
        self._greet(deadline)

    def read_until(self, terminator: bytes, *, limit: int, deadline: Deadline) -> bytes:
        if self._link is None:
            raise self._gone()
        line = self._link.read_until(NTCONTROL_END, limit=_LONGEST, deadline=deadline)
        answer = STX + parse_ntcontrol_answer(line, self._name) + ETX
        if self._transcript is not None:
            self._transcript.received(answer)
        return answer

    def read_exactly(self, count: int, *, deadline: Deadline) -> bytes:
        """Refused: the protocol has lines only, so a profile that counts bytes is for another one."""
        raise ProtocolError(
            "projector-garbage",
            what=f"The profile of the projector at {self._name} counts bytes, which NTCONTROL does not have.",
            remedy='Use the profile "panasonic" or "panasonic-dz".',
            theirs=False,
        )

    def write(self, data: bytes, *, deadline: Deadline) -> None:
        self._command += data
        while (end := self._command.find(ETX)) >= 0:
            # The number of a projector on a serial line is not used here.
            body = _NUMBER.sub(b"", bytes(self._command[:end]).rpartition(STX)[2])
            del self._command[: end + 1]
            if self._link is None:
                self._greet(deadline)
            assert self._link is not None
            if self._transcript is not None:
                self._transcript.sent(STX + body + ETX)
            link, greeting = self._link, self._greeting
            link.write(ntcontrol_command(body, greeting, self._user, self._password or ""), deadline=deadline)

    def drain(self) -> bytes:
        """Take what has arrived, and close the connection: the next command gets a new one."""
        link, self._link = self._link, None
        data = b""
        if link is not None:
            with contextlib.suppress(DeviceGone):
                data = link.drain()
            link.close()
        return data

    def close(self) -> None:
        self._closed = True
        self.drain()

    def _greet(self, deadline: Deadline) -> None:
        if self._closed:
            raise self._gone()
        deadline = deadline.within(GREETING_S)
        link = self._connect(deadline)
        try:
            greeting = parse_ntcontrol_greeting(link.read_until(NTCONTROL_END, limit=_LONGEST, deadline=deadline))
            if greeting.digest and self._password is None:
                raise wrong_password(self._name, missing=True)
        except BaseException:
            link.close()
            raise
        self._link, self._greeting = link, greeting

    def _gone(self) -> DeviceGone:
        return DeviceGone(
            "link-lost",
            what=f"{self._name} can't be reached: the connection was closed.",
            remedy="Check the address, the network cable and that the device has power.",
        )


LOGIN_S: Final = 5.0
"""Longest time of a login: a port that accepts connections and says nothing must not use up the caller's time."""
_LONGEST_GREETING: Final = 256


@dataclass(frozen=True, slots=True)
class Account:
    """``name``: of the projector, for messages; ``password`` None: there is none."""

    name: str
    user: str = ""
    password: str | None = None


def open_logged_in(
    host: str, port: int, table: NetworkTable, account: Account, *, deadline: Deadline, transcript: Transcript | None
) -> ByteLink:
    """Connect and log in. The transcript begins after the login, because that may hold the password.

    Raises
    ------
    DeviceGone, DeviceTimeout            as ``TcpLink``
    DeviceRefused("projector-password")  the password is missing or wrong
    DeviceBusy("projector-busy")         another program is connected
    ProtocolError                        the port speaks another protocol
    """
    deadline = deadline.within(LOGIN_S)
    if table.login == "ntcontrol":
        return NtControlLink(
            lambda until: TcpLink(host, port, deadline=until),
            account.name,
            user=account.user or table.user,
            password=account.password,
            deadline=deadline,
            transcript=transcript,
        )
    link = TcpLink(host, port, deadline=deadline)
    try:
        _LOGINS[table.login](link, account, deadline)
    except BaseException:
        link.close()
        raise
    link.record(transcript)
    return link


def _nothing(link: ByteLink, account: Account, deadline: Deadline) -> None:
    """Commands at once."""


def _escvpnet(link: ByteLink, account: Account, deadline: Deadline) -> None:
    link.write(logins.escvpnet_hello(account.password), deadline=deadline)
    answer = link.read_exactly(logins.ESCVPNET_BYTES, deadline=deadline)
    headers = logins.escvpnet_headers(answer, account.name)
    link.read_exactly(headers * logins.ESCVPNET_HEADER_BYTES, deadline=deadline)


def _adcp(link: ByteLink, account: Account, deadline: Deadline) -> None:
    greeting = link.read_until(logins.ADCP_END, limit=_LONGEST_GREETING, deadline=deadline)
    proof = logins.adcp_proof(greeting, account.password, account.name)
    if proof:
        link.write(proof, deadline=deadline)
        answer = link.read_until(logins.ADCP_END, limit=_LONGEST_GREETING, deadline=deadline)
        logins.check_adcp_accepted(answer, account.name)


def _jvc(link: ByteLink, account: Account, deadline: Deadline) -> None:
    logins.check_jvc_greeting(link.read_exactly(logins.JVC_BYTES, deadline=deadline), account.name)
    for request in logins.jvc_requests(account.password):
        link.write(request, deadline=deadline)
        if logins.jvc_accepted(link.read_exactly(logins.JVC_BYTES, deadline=deadline)):
            return
    raise logins.wrong_password(account.name, missing=account.password is None)


_LOGINS: Final[Mapping[str, Callable[[ByteLink, Account, Deadline], None]]] = {
    "none": _nothing,
    "escvpnet": _escvpnet,
    "adcp": _adcp,
    "jvc": _jvc,
}
