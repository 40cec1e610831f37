"""What a projector's own network port wants before commands: bytes to values and back, without I/O.

Facts and their sources: docs/reference/projectors.md. ``LOGINS`` names those that a profile may have.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from typing import Final

from hal.errors import DeviceBusy, DeviceRefused, ProtocolError
from hal.escapes import escaped

LOGINS: Final = ("none", "escvpnet", "ntcontrol", "adcp", "jvc")
"""``none``: the bytes of the serial line, at once."""

ESCVPNET_BYTES: Final = 16
ESCVPNET_HEADER_BYTES: Final = 18
_ESCVPNET: Final = b"ESC/VP.net"
_ESCVPNET_PASSWORD: Final = 16
_NTCONTROL: Final = re.compile(rb"NTCONTROL (?:0|([12]) ([0-9A-Za-z]{1,64})) *\r", re.IGNORECASE)
_ADCP: Final = re.compile(rb"[!-~]{1,128}\r\n")
NTCONTROL_END: Final = b"\r"
ADCP_END: Final = b"\r\n"
JVC_BYTES: Final = 5
_JVC_SALT: Final = "JVCKWPJ"
_JVC_SHORTEST: Final = 10


def escvpnet_hello(password: str | None) -> bytes:
    """CONNECT of ESC/VP.net: name, version 1.0, type 3, reserved, status, number of headers, and the password's header.

    A header is its kind (1: password), its attribute (1: plain text), and 16 bytes.
    """
    if password is None:
        return _ESCVPNET + b"\x10\x03\0\0\0\0"
    return _ESCVPNET + b"\x10\x03\0\0\0\x01" + b"\x01\x01" + _sized(password, _ESCVPNET_PASSWORD)


def escvpnet_headers(answer: bytes, name: str) -> int:
    """How many headers follow the answer to CONNECT.

    Raises
    ------
    DeviceRefused("projector-password")  status 41 or 43: the password is missing or wrong
    DeviceBusy("projector-busy")         status 53: others are connected
    ProtocolError                        any other answer
    """
    if len(answer) != ESCVPNET_BYTES or not answer.startswith(_ESCVPNET) or answer[11] != 0x03:
        raise _garbage(answer)
    status = answer[14]
    if status in (0x41, 0x43):
        raise wrong_password(name, missing=status == 0x41)
    if status == 0x53:
        raise _occupied(name)
    if status != 0x20:
        raise _garbage(answer)
    return answer[15]


@dataclass(frozen=True, slots=True)
class NtGreeting:
    """The first line of NTCONTROL. ``digest``: ``md5`` or ``sha256``, "" without password; ``random``: its salt."""

    digest: str = ""
    random: str = ""


def parse_ntcontrol_greeting(line: bytes) -> NtGreeting:
    """Read ``NTCONTROL 0``, ``NTCONTROL 1 zzzzzzzz`` or ``NTCONTROL 2 zzzzzzzz``; ProtocolError for anything else."""
    match = _NTCONTROL.fullmatch(line)
    if match is None:
        raise _garbage(line)
    if match[1] is None:
        return NtGreeting()
    return NtGreeting("md5" if match[1] == b"1" else "sha256", match[2].decode("ascii"))


def ntcontrol_command(body: bytes, greeting: NtGreeting, user: str, password: str) -> bytes:
    """A command: the digest of ``user:password:random`` in hex if a password is wanted, ``00``, the body, CR."""
    proof = b""
    if greeting.digest:
        text = f"{user}:{password}:{greeting.random}".encode()
        proof = hashlib.new(greeting.digest, text, usedforsecurity=False).hexdigest().encode("ascii")
    return proof + b"00" + body + NTCONTROL_END


def parse_ntcontrol_answer(line: bytes, name: str) -> bytes:
    """The body of an answer: without ``00``; ``ERR1`` to ``ERR5`` stay as they are.

    Raises DeviceRefused("projector-password") for ``ERRA``.
    """
    body = line.removesuffix(NTCONTROL_END)
    if body.startswith(b"ERRA"):
        raise wrong_password(name, missing=False)
    return body.removeprefix(b"00")


def adcp_proof(greeting: bytes, password: str | None, name: str) -> bytes:
    """What answers the first line of ADCP: b"" for ``NOKEY``, else the SHA-256 of its random text and the password.

    Raises DeviceRefused("projector-password") if a password is wanted and there is none, and ProtocolError.
    """
    if _ADCP.fullmatch(greeting) is None:
        raise _garbage(greeting)
    random = greeting.removesuffix(ADCP_END)
    if random.upper() == b"NOKEY":
        return b""
    if password is None:
        raise wrong_password(name, missing=True)
    return hashlib.sha256(random + password.encode("utf-8")).hexdigest().encode("ascii") + ADCP_END


def check_adcp_accepted(line: bytes, name: str) -> None:
    """Check the answer to the proof. DeviceRefused("projector-password") for ``err_auth``, ProtocolError for others."""
    word = line.strip().lower()
    if word == b"err_auth":
        raise wrong_password(name, missing=False)
    if word != b"ok":
        raise _garbage(line)


def check_jvc_greeting(greeting: bytes, name: str) -> None:
    """Check ``PJ_OK``. DeviceBusy for ``PJ_NG`` (another program is connected), ProtocolError for others."""
    if greeting == b"PJ_NG":
        raise _occupied(name)
    if greeting != b"PJ_OK":
        raise _garbage(greeting)


def jvc_requests(password: str | None) -> tuple[bytes, ...]:
    """What to answer ``PJ_OK`` with, one after the other until one is accepted.

    Models of 2021 take the password itself, filled up with NUL to ten bytes; later ones a SHA-256 of it.
    """
    if password is None:
        return (b"PJREQ",)
    hashed = hashlib.sha256((password + _JVC_SALT).encode("utf-8")).hexdigest().encode("ascii")
    return (b"PJREQ_" + _sized(password, _JVC_SHORTEST), b"PJREQ_" + hashed)


def jvc_accepted(answer: bytes) -> bool:
    """True for ``PJACK``, False for ``PJNAK``; ProtocolError for others."""
    if answer not in (b"PJACK", b"PJNAK"):
        raise _garbage(answer)
    return answer == b"PJACK"


def wrong_password(name: str, *, missing: bool) -> DeviceRefused:
    """The error of a projector that wants a password, or another one."""
    return DeviceRefused(
        "projector-password",
        what=f"The projector at {name} {'requires a password' if missing else 'did not accept the password'}.",
        remedy="Set password in stage.toml to the password of the projector's network menu.",
    )


def _occupied(name: str) -> DeviceBusy:
    return DeviceBusy(
        "projector-busy",
        what=f"The projector at {name} is connected to another program.",
        remedy="End the other program, or wait half a minute.",
    )


def _sized(password: str, size: int) -> bytes:
    return password.encode("utf-8").ljust(size, b"\0")


def _garbage(line: bytes) -> ProtocolError:
    return ProtocolError(
        "projector-garbage",
        what=f'The projector greeted with "{escaped(line[:64])}", which its profile does not know.',
        remedy="Check the address and port, and that the profile in stage.toml is for this model.",
    )
