"""Codec of PJLink class 1 and the simple part of class 2: bytes to values and back, without I/O.

Source: "PJLink Specifications" 1.04 (class 1) and 2.10 (class 2) of JBMIA: TCP port 4352, lines of at most 136 bytes
that end in CR, a greeting first, answers within 2 s, closed after 30 s idle.

Class 2 also has datagrams (2.10, sections 3.2 and 3.3), on UDP port 4352 of both sides. A controller broadcasts
``%2SRCH``; every projector answers within 10 s, after a delay of its own, with its MAC address. A projector notifies
the controllers registered in its menu when it starts, and when its errors, power or input change.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from enum import Enum
from typing import Final, Literal

from hal.errors import ProtocolError
from hal.escapes import escaped
from hal.values import Power

PORT: Final = 4352
TERMINATOR: Final = b"\r"
LONGEST_LINE: Final = 7 + 128 + 1
MOST_LAMPS: Final = 8
MOST_INPUTS: Final = 50
LONGEST_PASSWORD: Final = 32

PjClass = Literal[1, 2]
_ANSWER: Final = re.compile(rb"%([12])([A-Za-z0-9]{4})=([^\r]{0,128})\r")
_GREETING: Final = re.compile(rb"PJLINK (?:0|1 ([0-9A-Z]{1,64})|(ERRA)) *\r", re.IGNORECASE)
_SECOND_LEVEL: Final = re.compile(rb"PJLINK 2 ([0-9A-F]{32}) *\r", re.IGNORECASE)
ASK_SECOND_LEVEL: Final = b"PJLINK 2\r"
"""Asks for the random number of the SHA-256 password check (version 2.10)."""
SALT_BYTES: Final = 16
_COMMAND: Final = re.compile(r"[A-Z0-9]{4}")
_LAMP: Final = re.compile(r"(\d{1,5}) ([01])")
_POWERS: Final = {"0": Power.OFF, "1": Power.ON, "2": Power.COOLING, "3": Power.WARMING}
_TROUBLES: Final = {
    "fan": "fan-failed",
    "lamp": "lamp-failed",
    "temperature": "over-temperature",
    "cover": "cover-open",
    "filter": "filter-clogged",
    "other": "other-failure",
}


class Failure(Enum):
    """The error answers of the specification, 2.2."""

    UNDEFINED = "ERR1"
    PARAMETER = "ERR2"
    UNAVAILABLE = "ERR3"
    FAILURE = "ERR4"


@dataclass(frozen=True, slots=True)
class Greeting:
    """The projector's first line. ``random`` is the salt for the password, or None if no password is needed."""

    random: str | None


@dataclass(frozen=True, slots=True)
class LampStatus:
    """One lamp: burning hours, and whether it is lit."""

    hours: int
    lit: bool


@dataclass(frozen=True, slots=True)
class MuteStatus:
    """Whether picture and sound are blocked."""

    video: bool
    audio: bool


def parse_greeting(line: bytes) -> Greeting | None:
    """Read the line that the projector sends first; None for ``PJLINK ERRA`` (the password was wrong).

    The specification's random number has 8 hex digits and its line nothing else; projectors are seen to differ.
    """
    match = _GREETING.fullmatch(bare(line))
    if match is None:
        raise _broken(line, "a greeting")
    if match[2] is not None:
        return None
    return Greeting(match[1].decode("ascii") if match[1] is not None else None)


def bare(line: bytes) -> bytes:
    """A line without what some projectors send before it: NUL, blanks, the rest of an ending such as CR LF ``>``."""
    return line.lstrip(b"\0 \n>")


def parse_second_level(line: bytes) -> bytes | None:
    """The random number (16 bytes) of the answer to ``ASK_SECOND_LEVEL``; None for any other line."""
    match = _SECOND_LEVEL.fullmatch(bare(line))
    return None if match is None else bytes.fromhex(match[1].decode("ascii"))


def second_level_digest(theirs: bytes, ours: bytes, password: str) -> bytes:
    """Prefix of the first command after ``PJLINK 2``: our random number, then the SHA-256 digest, both in hex.

    ``theirs`` and ``ours``: 16 bytes each; the digest is of both xor-ed, in hex, and the password. The specification
    2.10 was not available; three clients and emulators of other authors agree on this.
    """
    mixed = bytes(a ^ b for a, b in zip(theirs, ours, strict=True)).hex()
    return (ours.hex() + hashlib.sha256((mixed + password).encode("utf-8")).hexdigest()).encode("ascii")


def digest(random: str, password: str) -> bytes:
    """Prefix of the first command if the greeting has a random number: md5, 32 hex digits (5.1)."""
    return hashlib.md5((random + password).encode("utf-8"), usedforsecurity=False).hexdigest().encode("ascii")


def command(name: str, parameter: str = "?", *, pj_class: PjClass = 1) -> bytes:
    """The bytes of a command, e.g. ``%1POWR ?\\r``. ProtocolError (ours) for what the specification does not allow."""
    if not _COMMAND.fullmatch(name) or not 0 < len(parameter) <= 128 or not parameter.isascii() or "\r" in parameter:
        raise ProtocolError(
            "pjlink-command-wrong",
            what=f"{name!r} with {parameter!r} is not a PJLink command.",
            remedy="This is a mistake in the driver. Report it to the maintainers.",
            theirs=False,
        )
    return f"%{pj_class}{name} {parameter}\r".encode("ascii")


def parse_answer(line: bytes, name: str, *, pj_class: PjClass = 1) -> str | Failure:
    """The text after ``=`` of the answer to ``name``, or the reported failure.

    Raises ProtocolError for an answer to another command, of another class, too long, or no answer at all.
    """
    match = _ANSWER.fullmatch(line)
    if match is None or match[2].decode("ascii").upper() != name or int(match[1]) != pj_class:
        raise _broken(line, f"an answer to {name}")
    # Names may be UTF-8 (class 2); an invalid byte must not stop the rest.
    text = match[3].decode("utf-8", "replace")
    failures = {failure.value: failure for failure in Failure}
    return failures.get(text.upper(), text)


def is_refusal(line: bytes) -> bool:
    """Whether a line reports a wrong password."""
    return line.strip(b"\0 \r\n>").upper() == b"PJLINK ERRA"


def accepted(text: str) -> None:
    """Check the answer to a setting: it must be OK."""
    if text.upper() != "OK":
        raise _broken(text.encode(), "an acceptance")


def parse_power(text: str) -> Power:
    """POWR: 0 standby, 1 on, 2 cooling, 3 warm-up (4.2); some projectors have more states, which are UNKNOWN."""
    if not re.fullmatch("[0-9]", text, re.ASCII):
        raise _broken(text.encode(), "a power state")
    return _POWERS.get(text, Power.UNKNOWN)


def parse_errors(text: str) -> tuple[str, ...]:
    """ERST: six digits for fan, lamp, temperature, cover, filter, other; 0 fine, 1 warning, 2 error (4.7).

    Returns words of trouble as in ``hal.codecs.projectors.profiles``, e.g. ``("fan-warning", "over-temperature")``.
    """
    if not re.fullmatch(r"[012]{6}", text, re.ASCII):
        raise _broken(text.encode(), "an error status")
    troubles = []
    for part, digit in zip(_TROUBLES, text, strict=True):
        if digit == "1":
            troubles.append(f"{part}-warning")
        elif digit == "2":
            troubles.append(_TROUBLES[part])
    return tuple(troubles)


def parse_lamps(text: str) -> tuple[LampStatus, ...]:
    """LAMP: pairs of hours and 0 or 1, at most eight, e.g. ``1200 1 80 0`` (4.8)."""
    words = text.split(" ")
    pairs = [" ".join(words[i : i + 2]) for i in range(0, len(words), 2)]
    lamps = [match for pair in pairs if (match := _LAMP.fullmatch(pair)) is not None and pair.isascii()]
    if len(lamps) != len(pairs) or len(lamps) > MOST_LAMPS:
        raise _broken(text.encode(), "a lamp status")
    return tuple(LampStatus(int(match[1]), match[2] == "1") for match in lamps)


def parse_input(text: str) -> str:
    """INPT: kind 1 to 6 and number, e.g. ``31`` the first digital input (4.4)."""
    if not re.fullmatch(r"[1-6][1-9A-Z]", text, re.ASCII):
        raise _broken(text.encode(), "an input")
    return text


def parse_inputs(text: str) -> tuple[str, ...]:
    """INST: the existing inputs, e.g. ``11 12 31`` (4.9)."""
    words = text.split(" ")
    if len(words) > MOST_INPUTS:
        raise _broken(text.encode(), "a list of inputs")
    return tuple(parse_input(word) for word in words)


def parse_mute(text: str) -> MuteStatus:
    """AVMT: 11 picture, 21 sound, 31 both, 30 none (4.6); some projectors say 10 or 20 for none."""
    if not re.fullmatch(r"[123][01]", text, re.ASCII):
        raise _broken(text.encode(), "a mute status")
    on = text[1] == "1"
    return MuteStatus(video=on and text[0] in "13", audio=on and text[0] in "23")


def parse_text(text: str) -> str:
    """NAME, INF1, INF2, INFO, SNUM, SVER: free text; control characters are dropped, it may be empty."""
    return "".join(character for character in text if character.isprintable()).strip()


def parse_class(text: str) -> PjClass:
    """CLSS: 1 or 2 (4.14)."""
    if text == "1":
        return 1
    if text == "2":
        return 2
    raise _broken(text.encode(), "a class")


def _broken(line: bytes, wanted: str) -> ProtocolError:
    return ProtocolError(
        "pjlink-garbage",
        what=f'The projector sent "{escaped(line[:80])}" instead of {wanted} of PJLink.',
        remedy="Check that the address is the projector's PJLink port. Update the projector's firmware.",
    )


SEARCH: Final = b"%2SRCH\r"
LONGEST_DATAGRAM: Final = 1024
_LINE: Final = re.compile(rb"%2(ACKN|LKUP|ERST|POWR|INPT)=([ -~]{0,64})", re.IGNORECASE)
_MAC: Final = re.compile(r"[0-9a-f]{2}(?::[0-9a-f]{2}){5}|[0-9a-f]{12}")


@dataclass(frozen=True, slots=True)
class SearchAck:
    """A projector answers a search. ``mac`` as ``00:11:22:aa:bb:cc``."""

    mac: str


@dataclass(frozen=True, slots=True)
class LinkUp:
    """A projector has just started and accepts commands now."""

    mac: str


@dataclass(frozen=True, slots=True)
class TroubleChanged:
    """Its errors are these now; words as in ``hal.codecs.projectors.pjlink.parse_errors``; empty: no error any more."""

    trouble: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class PowerChanged:
    power: Power


@dataclass(frozen=True, slots=True)
class InputChanged:
    """The input is this now, e.g. ``31``."""

    input: str


Notification = SearchAck | LinkUp | TroubleChanged | PowerChanged | InputChanged


def parse_datagram(data: bytes) -> tuple[Notification, ...]:
    """Read a datagram: one line or several, each with its CR.

    Raises ProtocolError for anything else; nothing of a datagram counts then.
    """
    lines = data[: LONGEST_DATAGRAM + 1].rstrip(b"\0").split(b"\r")
    if len(data) > LONGEST_DATAGRAM or len(lines) < 2 or lines.pop() != b"":
        raise _garbage(data)
    return tuple(_parsed(line) for line in lines)


def is_notification(line: bytes) -> bool:
    """Whether a line is a notification: some projectors send them on the TCP connection, too, before an answer."""
    match = _LINE.match(line.lstrip(b"\0"))
    # ERST, POWR and INPT are also queries of class 1 and 2: only these two can never be an answer.
    return match is not None and match[1].upper() in (b"ACKN", b"LKUP")


def _parsed(line: bytes) -> Notification:
    match = _LINE.fullmatch(line)
    if match is None:
        raise _garbage(line)
    name, value = match[1].upper(), match[2].decode("ascii")
    if name == b"ERST":
        return TroubleChanged(parse_errors(value))
    if name == b"POWR" and value in _POWERS:
        return PowerChanged(_POWERS[value])
    if name == b"INPT":
        return InputChanged(parse_input(value))
    if name == b"POWR":
        raise _garbage(line)
    return SearchAck(_mac(value)) if name == b"ACKN" else LinkUp(_mac(value))


def _mac(text: str) -> str:
    plain = text.lower()
    if not _MAC.fullmatch(plain):
        raise _garbage(text.encode())
    digits = plain.replace(":", "")
    return ":".join(digits[i : i + 2] for i in range(0, 12, 2))


def _garbage(data: bytes) -> ProtocolError:
    return ProtocolError(
        "pjlink-garbage",
        what=f'A datagram "{escaped(data[:80])}" is not from PJLink.',
        remedy="Do nothing: another program on the network uses UDP port 4352.",
    )
