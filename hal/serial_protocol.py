"""Codec of table-driven serial projectors: bytes in, values out, and back, as a profile says. It does no I/O.

Source: the command tables of ``firmware_configs/projectors``, each of which names its documents.
"""

from __future__ import annotations

import enum
import re
from dataclasses import dataclass
from functools import lru_cache

from hal.errors import ProtocolError
from hal.escapes import escaped
from hal.profiles import Query, SerialTable
from hal.values import Power

MOST_HOURS = 99_999


class Reply(enum.Enum):
    """What a line means when it is neither an answer nor a notice."""

    ACCEPTED = "accepted"
    REFUSED = "refused"


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to a question: the text where the profile has ``{value}``."""

    value: str


@dataclass(frozen=True, slots=True)
class Notice:
    """A line that the projector sent unasked. Either ``power`` or ``trouble`` is told."""

    power: Power | None
    trouble: str | None


def command_bytes(table: SerialTable, name: str, address: str) -> bytes:
    """The bytes of a command of the profile, e.g. ``power_on``."""
    return _filled(table.commands[name], address)


def query_bytes(query: Query, address: str) -> bytes:
    """The bytes of a question."""
    return _filled(query.send, address)


def _filled(template: str, address: str) -> bytes:
    return template.replace("{address}", address).encode("latin-1")


def parse_line(table: SerialTable, line: bytes, query: Query | None = None) -> Answer | Notice | Reply:
    """Read one line of the projector, with or without its terminator, as the answer to ``query`` (None: a command).

    Raises
    ------
    ProtocolError("projector-garbage")  for a line that the profile does not know
    """
    text = line.removesuffix(table.terminator).strip(b"\r\n\0 ").decode("latin-1")
    if table.notices.prefix and text.startswith(table.notices.prefix):
        return _notice(table, text)
    if query is not None:
        for shape in query.answers:
            if (match := _pattern(shape).fullmatch(text)) is not None:
                return _answer(query, match[1], line)
    if text in table.accepted:
        return Reply.ACCEPTED
    if text in table.refused:
        return Reply.REFUSED
    raise _garbage(line)


def _notice(table: SerialTable, text: str) -> Notice:
    code = text.removeprefix(table.notices.prefix).strip()
    if code in table.notices.power:
        return Notice(table.notices.power[code], None)
    if not (len(code) <= 4 and code.isascii() and code.isalnum()):
        raise _garbage(text.encode("latin-1"))
    # A code that the manual does not list is worth a look, and no reason to stop.
    return Notice(None, table.notices.trouble.get(code, f"notice-{code.lower()}-warning"))


def _answer(query: Query, value: str, line: bytes) -> Answer:
    if not query.values:
        return Answer(value)
    if value not in query.values:
        raise _garbage(line)
    return Answer(query.values[value])


@lru_cache(maxsize=256)
def _pattern(shape: str) -> re.Pattern[str]:
    before, _, after = shape.partition("{value}")
    return re.compile(f"{re.escape(before)}([ -~]{{1,64}}){re.escape(after)}")


def parse_power(value: str) -> Power:
    """The power state that an answer's value names. Raises ProtocolError for any other word."""
    try:
        return Power(value)
    except ValueError:
        raise _garbage(value.encode("latin-1", "replace")) from None


def parse_hours(value: str) -> int:
    """Lamp hours of an answer, e.g. "01200". Raises ProtocolError for anything but 1 to 5 digits."""
    digits = value.strip()
    if not (digits.isascii() and digits.isdigit() and len(digits) <= 5):
        raise _garbage(value.encode("latin-1", "replace"))
    return int(digits)


def _garbage(line: bytes) -> ProtocolError:
    return ProtocolError(
        "projector-garbage",
        what=f'The projector sent "{escaped(line[:64])}", which its protocol does not have.',
        remedy="Check the baud rate, the cable, and that the profile in stage.toml is the one of this model.",
    )
