"""Opens a projector's own network port, with the login that its profile names."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from hal.codecs.projectors import logins
from hal.codecs.projectors.network_table import NetworkTable
from hal.deadline import Deadline
from hal.links import ByteLink, TcpLink
from hal.transcript import Transcript
from plugins.projectors.network.nt_control import NtControlLink

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
