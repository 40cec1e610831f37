"""Codec of serial projectors by a profile's table: bytes to values and back, without I/O.

Source: the command tables of ``firmware_configs/projectors``, each of which names its documents.

Some families speak JSON-RPC 2.0: one object follows the other, with nothing between them. A profile writes such a
message as a method, or as a method, a property and a value with spaces between them, e.g.
``property.set optics.shutter.target Closed``. Facts and their sources: docs/reference/projectors.md.
"""

from __future__ import annotations

import enum
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, auto
from functools import lru_cache
from typing import Any, Final

from hal.codecs.projectors.serial_table import Frame, Query, SerialTable
from hal.errors import ProtocolError
from hal.escapes import escaped
from hal.values import Power

OBJECT_END: Final = b"}"
_LARGEST_NUMBER: Final = 1_000_000


class MessageKind(Enum):
    """Meaning of an object. OTHER: a notification, or the answer to another message."""

    RESULT = auto()
    ERROR = auto()
    OTHER = auto()


@dataclass(frozen=True, slots=True)
class Message:
    """An object; ``text``: its result or its error as text."""

    said: MessageKind
    text: str = ""


def json_bytes(template: str, number: int) -> bytes:
    """A request with ``number`` as its id."""
    method, *rest = template.split(" ", 2)
    request: dict[str, Any] = {"jsonrpc": "2.0", "method": method}
    if rest:
        request["params"] = dict(zip(("property", "value"), rest, strict=False))
    request["id"] = number % _LARGEST_NUMBER
    return json.dumps(request).encode("ascii")


def is_complete(data: bytes) -> bool:
    """Whether ``data``, which ends in a brace, is a whole object."""
    return _loaded(data) is not None


def parse_message(data: bytes, sent: bytes) -> Message:
    """Read an object as the answer to ``sent``; ProtocolError("projector-garbage") for anything else."""
    message = _loaded(data)
    if message is None:
        raise ProtocolError(
            "projector-garbage",
            what=f'The projector sent "{escaped(data[:64])}", which is not a JSON object.',
            remedy="Check the address and port, and that the profile in stage.toml is for this model.",
        )
    asked = _loaded(sent) or {}
    if "id" not in asked or str(message.get("id")) != str(asked["id"]):
        return Message(MessageKind.OTHER)
    if "error" in message and message["error"] is not None:
        error = message["error"]
        return Message(MessageKind.ERROR, _line(error.get("message", "") if isinstance(error, dict) else error))
    return Message(MessageKind.RESULT, _line(message.get("result")))


def _loaded(data: bytes) -> dict[str, Any] | None:
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None


def _line(value: object) -> str:
    """A result as one line of printable text; "" for none."""
    text = "" if value is None else value if isinstance(value, str) else json.dumps(value)
    return "".join(character for character in text[:256] if " " <= character <= "~")


MOST_HOURS: Final = 99_999
_LONGEST_VALUE: Final = 64
_HEX_DIGITS: Final = re.compile(r"[0-9A-Fa-f]{1,8}")
_SHAPE_PARTS: Final = re.compile(r"\{value\}|\{any\}|\?\*\d+|\?| |[^{?]+|.", re.DOTALL)


class Reply(enum.Enum):
    """Meaning of a line that is neither an answer nor a notice. NOTHING: an echo, a prompt, a line to ignore."""

    ACCEPTED = "accepted"
    REFUSED = "refused"
    COOLING = "cooling"
    NOTHING = "nothing"


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to a query: the text at ``{value}`` of the profile, or its word.

    In binary frames it is hexadecimal, unless the query defines its notation.
    """

    value: str


@dataclass(frozen=True, slots=True)
class UnaskedMessage:
    """A line that the projector sent unasked, with either ``power`` or ``trouble``."""

    power: Power | None
    trouble: str | None


def command_bytes(table: SerialTable, name: str, address: str, number: int = 1) -> bytes:
    """The bytes of a command of the profile, e.g. ``power_on``; ``number`` of the message, where it carries one."""
    return _filled(table, table.commands[name], address, number)


def query_bytes(table: SerialTable, query: Query, address: str, number: int = 1) -> bytes:
    """The bytes of a question; ``number`` as in ``command_bytes``."""
    return _filled(table, query.send, address, number)


def _filled(table: SerialTable, template: str, address: str, number: int) -> bytes:
    if table.json:
        return json_bytes(template, number)
    return bytes.fromhex(template) if table.binary else template.replace("{address}", address).encode("latin-1")


def head_bytes(frame: Frame) -> int:
    """How many bytes of a frame must be there to know its length."""
    return frame.count_at + (2 if frame.hexadecimal else 1)


def rest_bytes(frame: Frame, head: bytes, *, longest: int) -> int:
    """How many bytes follow the first ``head_bytes`` of a frame. ProtocolError for a count that cannot be."""
    if frame.lengths:
        if head[0] not in frame.lengths:
            raise _garbage(head)
        return frame.lengths[head[0]] - 1
    digits = head[frame.count_at :]
    if frame.hexadecimal and not re.fullmatch(rb"[0-9A-Fa-f]{2}", digits):
        raise _garbage(head)
    length = frame.overhead + (int(digits, 16) if frame.hexadecimal else digits[0])
    if not len(head) <= length <= longest:
        raise _garbage(head)
    return length - len(head)


def parse_line(
    table: SerialTable, line: bytes, query: Query | None = None, *, sent: bytes = b""
) -> Answer | UnaskedMessage | Reply:
    """Read one line or frame of the projector as the answer to ``query`` (None: a command).

    ``line`` may have its terminator or not; ``sent``: what was sent last, to know its echo.

    Raises
    ------
    ProtocolError("projector-garbage")  for a line that the profile does not know
    """
    if table.json:
        return _object(table, parse_message(line, sent), query, line)
    text = _text(table, line, sent)
    if table.notices.prefix and text.upper().startswith(table.notices.prefix.upper()):
        return _notice(table, text)
    meaning = _reply(table, text, ((table.cooling, Reply.COOLING), (table.refused, Reply.REFUSED)))
    if meaning is None and table.quirks.ack_first:
        meaning = _reply(table, text, ((table.accepted, Reply.ACCEPTED),))
    if meaning is None and query is not None and (answer := _shaped(table, query, text, line)) is not None:
        return answer
    meaning = meaning or _reply(table, text, ((table.accepted, Reply.ACCEPTED), (table.ignored, Reply.NOTHING)))
    if meaning is None and not text and (table.quirks.prompt or table.quirks.echo):
        meaning = Reply.NOTHING
    if meaning is None:
        raise _garbage(line)
    return meaning


def _shaped(table: SerialTable, query: Query, text: str, line: bytes) -> Answer | Reply | None:
    for shape in query.answers:
        if (match := _pattern(shape, table.binary).fullmatch(text)) is not None:
            return _answer(table, query, match[1], line)
    return None


def _object(table: SerialTable, message: Message, query: Query | None, line: bytes) -> Answer | Reply:
    """Read a JSON object: only the answer to the message that was sent last means anything."""
    if message.said is MessageKind.OTHER:
        return Reply.NOTHING
    if message.said is MessageKind.ERROR:
        return _reply(table, message.text, ((table.cooling, Reply.COOLING),)) or Reply.REFUSED
    if query is None:
        return Reply.ACCEPTED
    answer = _shaped(table, query, message.text, line)
    if answer is None:
        raise _garbage(line)
    return answer


def _reply(table: SerialTable, text: str, meanings: Sequence[tuple[tuple[str, ...], Reply]]) -> Reply | None:
    for shapes, reply in meanings:
        if any(_pattern(shape, table.binary).fullmatch(text) for shape in shapes):
            return reply
    return None


def _text(table: SerialTable, line: bytes, sent: bytes) -> str:
    """What a line says: without terminator, prompt, echo and addresses; a binary frame as hexadecimal without its
    checksum.
    """
    if table.binary:
        if table.frame is not None and table.frame.checksum != "none":
            begin = 1 if table.frame.checksum == "sum-but-first" else 0
            if len(line) < 2 or sum(line[begin:-1]) & 0xFF != line[-1]:
                raise _garbage(line)
            line = line[:-1]
        return line.hex().upper()
    bare = line.removesuffix(table.terminator) if table.terminator else line
    text = bare.strip(b"\r\n\0 ").decode("latin-1")
    if table.quirks.prompt:
        text = text.lstrip(table.quirks.prompt + "\r\n ")
    echo = sent.strip(b"\r\n\0 ").decode("latin-1")
    if table.quirks.echo and echo:
        # Letter by letter: an answer may differ from it only in case.
        while text.startswith(echo):
            text = text.removeprefix(echo).lstrip(table.quirks.prompt + "\r\n ")
    if table.quirks.addressed:
        text = re.sub(rf"\A(\W?)(?:{table.quirks.addressed})", r"\1", text, flags=re.IGNORECASE)
    return text


def _notice(table: SerialTable, text: str) -> UnaskedMessage:
    code = text[len(table.notices.prefix) :].strip()
    code = _plain(code) if code.isdigit() else code
    if code in table.notices.power:
        return UnaskedMessage(table.notices.power[code], None)
    if (word := table.notices.trouble.get(code)) is not None:
        return UnaskedMessage(None, word)
    for begins, word in table.notices.trouble.items():
        if not begins.isdigit() and code.startswith(begins):
            return UnaskedMessage(None, word)
    if not (len(code) <= 4 and code.isascii() and code.isalnum()):
        raise _garbage(text.encode("latin-1"))
    # Report a code that is not in the manual, but do not stop.
    return UnaskedMessage(None, f"notice-{code.lower()}-warning")


def _answer(table: SerialTable, query: Query, value: str, line: bytes) -> Answer | Reply:
    value = _read(query, value).strip()
    plain = str.upper if table.binary else _plain
    known, wanted = {plain(name): word for name, word in query.values.items()}, plain(value)
    if wanted in map(plain, query.absent):
        return Reply.REFUSED
    if known and wanted not in known:
        if value in query.unknown or ("*" in query.unknown and value.isdigit()):
            return Answer(Power.UNKNOWN.value)
        raise _garbage(line)
    if not value:
        raise _garbage(line)
    return Answer(known[wanted] if known else value)


def _plain(value: str) -> str:
    """A value as it is compared: models differ in case, and in how many zeros come before a number."""
    return value.upper().lstrip("0") or "0"


def _read(query: Query, value: str) -> str:
    """A value of a binary frame as the text that it stands for."""
    if query.reads == "text":
        return value
    if query.reads == "hex-digits":
        return str(int(value, 16)) if _HEX_DIGITS.fullmatch(value) else value
    data = bytes.fromhex(value)
    if query.reads == "ascii":
        text = data.partition(b"\0")[0].decode("latin-1")
        return "".join(character for character in text if " " <= character <= "~").strip()
    return str(int.from_bytes(data, "little" if query.reads == "little-endian" else "big"))


@lru_cache(maxsize=512)
def _pattern(shape: str, binary: bool) -> re.Pattern[str]:
    byte = "[0-9A-F]{2}"
    meanings = {"{any}": f"[ -~]{{0,{4 * _LONGEST_VALUE}}}", "{value}": f"([ -~]{{1,{_LONGEST_VALUE}}}?)"}
    if binary:
        meanings = {"{value}": f"((?:{byte}){{1,{_LONGEST_VALUE}}})", " ": "", "?": byte}
    parts = []
    for part in _SHAPE_PARTS.findall(shape):
        if part in meanings:
            parts.append(meanings[part])
        elif not binary:
            parts += [" +" if mark == " " else mark if mark.isalnum() else f" *{re.escape(mark)} *" for mark in part]
        elif part.startswith("?*"):
            parts.append(f"(?:{byte}){{{int(part[2:])}}}")
        else:
            parts.append(part.replace(" ", "").upper())
    # Users report models that differ from their makers' documents in case and in blanks.
    return re.compile("".join(parts), re.IGNORECASE)


def parse_power(value: str) -> Power:
    """The power state of an answer's value. Raises ProtocolError for any other word."""
    try:
        return Power(value)
    except ValueError:
        raise _garbage(value.encode("latin-1", "replace")) from None


def parse_hours(value: str, per_hour: int = 1) -> int:
    """Lamp hours of an answer in units of ``per_hour`` an hour, e.g. "01200".

    Raises ProtocolError for anything but digits, and for more than 99,999 hours.
    """
    digits = value.strip()
    if not (digits.isascii() and digits.isdigit() and len(digits) <= 10):
        raise _garbage(value.encode("latin-1", "replace"))
    hours = int(digits) // per_hour
    if hours > MOST_HOURS:
        raise _garbage(value.encode("latin-1", "replace"))
    return hours


def _garbage(line: bytes) -> ProtocolError:
    return ProtocolError(
        "projector-garbage",
        what=f'The projector sent "{escaped(line[:64])}", which is not in its profile.',
        remedy="Check the baud rate, the cable, and that the profile in stage.toml is for this model.",
    )
