"""The command table of a serial family of projectors, as a validated value: the serial part of a profile."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

from hal.codecs.projectors.toml_table import Table
from hal.values import Power

COMMANDS: Final = (
    "power_on", "power_off", "shutter_close", "shutter_open", "lens_shutter_close", "lens_shutter_open",
)  # fmt: skip
ADJUSTMENTS: Final = ("input", "keystone", "lamp_mode")
"""Queries of what people set in its menus."""
QUERIES: Final = ("power", "lamp_hours", "shutter", "model", "firmware", *ADJUSTMENTS)
MAY_BE_UNKNOWN: Final = ("power_on", "power_off", "power", "lamp_hours")
POWERS: Final = tuple(power.value for power in Power)
READS: Final = {"text": "", "hex-digits": "", "ascii": "hex", "little-endian": "hex", "big-endian": "hex"}
UNITS: Final = {"hours": 1, "minutes": 60, "seconds": 3600}
_PLACEHOLDER: Final = re.compile(r"\{([^{}]*)\}")
_WORD: Final = re.compile(r"[a-z][a-z0-9-]{0,39}")
_BYTE: Final = r"[0-9A-Fa-f]{2}"
_HEX_SHAPE: Final = re.compile(
    rf"(?:{_BYTE}|\?(?:\*[1-9][0-9]{{0,2}})?|\{{value\}})(?: (?:{_BYTE}|\?(?:\*[1-9][0-9]{{0,2}})?|\{{value\}}))*"
)


@dataclass(frozen=True, slots=True)
class Query:
    """One query: its bytes, the shapes of its answer (``{value}`` marks the value) and the meaning of values.

    ``absent``: values for "not known now"; ``unknown``: power states with an unknown meaning, ``*`` any other number.
    ``reads``: how a number or name is written: ``text``, ``hex-digits``, or in binary frames ``little-endian``,
    ``big-endian`` and ``ascii`` (up to a NUL). ``per_hour``: units of lamp time in an hour.
    """

    send: str
    answers: tuple[str, ...]
    values: Mapping[str, str]
    absent: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()
    reads: str = "text"
    per_hour: int = 1


@dataclass(frozen=True, slots=True)
class Notices:
    """Lines that the projector sends unasked: ``prefix`` and a code for its power or a fault."""

    prefix: str
    power: Mapping[str, Power]
    trouble: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Frame:
    """Format of answers that carry their own length.

    ``count_at``: offset of the count in the frame; ``hexadecimal``: the count is two hex digits, else one byte;
    ``overhead``: bytes of the frame that the count leaves out. ``checksum``: the last byte is the sum of all others
    (``sum``), or of all but the first (``sum-but-first``). ``lengths``: the length by the first byte; then there is no
    count.
    """

    count_at: int
    hexadecimal: bool
    overhead: int
    checksum: str
    lengths: Mapping[int, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Quirks:
    """Special behaviour of a family.

    ``prompt``: bytes before a line that mean nothing; ``echo``: what was sent comes back first, any number of times;
    ``addressed``: a regular expression for the addresses that may stand before an answer, after its first mark;
    ``quote``: a terminator between two of these does not end the line;
    ``abnormal_terminator``: in an abnormal state an answer ends in this instead of the terminator. ``ack_first``: every
    message is acknowledged by a line of its own, which is never an answer.
    """

    prompt: str = ""
    echo: bool = False
    addressed: str = ""
    quote: str = ""
    abnormal_terminator: bytes = b""
    ack_first: bool = False


@dataclass(frozen=True, slots=True)
class SerialTable:
    """The command table of a serial family. ``{address}`` in a command stands for the projector's address.

    ``baud`` is 0 for a family that has only a network port.

    Answers end in ``terminator``, or carry their length (``frame``). ``binary``: commands and shapes are written as
    hexadecimal bytes, where ``?`` stands for any byte and ``?*9`` for nine. ``cooling``: replies that refuse because
    the lamp cools; ``ignored``: lines without meaning. ``json``: each message is a JSON-RPC object, written as
    in ``hal.codecs.projectors.serial_protocol``; a shape is the text of a result, and each error refuses.
    """

    baud: int
    terminator: bytes
    address: str
    longest_answer: int
    commands: Mapping[str, str]
    queries: Mapping[str, Query]
    accepted: tuple[str, ...]
    refused: tuple[str, ...]
    notices: Notices
    cooling: tuple[str, ...] = ()
    ignored: tuple[str, ...] = ()
    frame: Frame | None = None
    binary: bool = False
    json: bool = False
    quirks: Quirks = Quirks()


def parse_serial(root: Table, unknown: tuple[str, ...]) -> SerialTable:
    """Read the tables ``serial``, ``commands``, ``queries``, ``replies``, ``notices``, ``frame`` and ``quirks``.

    ``unknown``: commands and queries with unknown codes; they must be absent. Raises ProtocolError as
    ``hal.codecs.projectors.profiles.parse_profile``.
    """
    line = root.table("serial")
    frame = _frame(root.table("frame")) if root.has("frame") else None
    notation = line.choice("notation", ("text", "hex", "json"), "text")
    binary = notation == "hex"
    whole = frame is not None or notation == "json"  # an answer shows its own end
    terminator = b"" if whole else _bytes(line, "terminator", line.string("terminator"))
    if not terminator and not whole:
        raise line.wrong("terminator", "it is empty")
    address = line.string("address", "")
    if not ((address.isascii() and address.isalnum()) or not address):
        raise line.wrong("address", f"{address!r} may have only letters and digits")
    replies = root.table("replies", required=notation != "json")
    made = SerialTable(
        baud=0 if root.has("network") and not line.has("baud") else line.integer("baud", 300, 921_600),
        terminator=terminator,
        address=address,
        longest_answer=line.integer("longest_answer", 4, 4096),
        commands=_commands(root.table("commands"), unknown, binary),
        queries=_queries(root.table("queries"), unknown, binary),
        accepted=_shapes(replies, "accepted", binary, required=notation != "json"),
        refused=_shapes(replies, "refused", binary, required=False),
        cooling=_shapes(replies, "cooling", binary, required=False),
        ignored=_shapes(replies, "ignored", binary, required=False),
        notices=_notices(root.table("notices", required=False)),
        frame=frame,
        binary=binary,
        json=notation == "json",
        quirks=_quirks(root.table("quirks", required=False)),
    )
    line.finish()
    replies.finish()
    return made


def _frame(table: Table) -> Frame:
    if table.has("lengths"):
        lengths = table.integers("lengths", 1, 255)
        if wrong := [key for key in lengths if not re.fullmatch(_BYTE, key)]:
            raise table.wrong("lengths", f"{wrong[0]!r} is not a byte such as 1D")
        made = Frame(0, False, 1, "none", {int(key, 16): length for key, length in lengths.items()})
        table.finish()
        return made
    made = Frame(
        count_at=table.integer("count_at", 0, 64),
        hexadecimal=table.choice("count", ("byte", "hex")) == "hex",
        overhead=table.integer("overhead", 1, 64),
        checksum=table.choice("checksum", ("sum", "sum-but-first", "none")),
    )
    if made.overhead <= made.count_at:
        raise table.wrong("overhead", "it must include the bytes up to the count (count_at)")
    table.finish()
    return made


def _quirks(table: Table) -> Quirks:
    table.has("any_case")  # of older profiles: case never counts now
    made = Quirks(
        prompt=table.string("prompt", ""),
        echo=table.flag("echo"),
        addressed=table.string("addressed", ""),
        ack_first=table.flag("ack_first"),
        quote=table.string("quote", ""),
        abnormal_terminator=_bytes(table, "abnormal_terminator", table.string("abnormal_terminator", "")),
    )
    try:
        re.compile(made.addressed)
    except re.error as error:
        raise table.wrong("addressed", f"it is not a regular expression: {error}") from None
    table.finish()
    return made


def _commands(table: Table, unknown: tuple[str, ...], binary: bool) -> dict[str, str]:
    commands = {}
    for name in COMMANDS:
        _check_unknown(table, name, unknown)
        if table.has(name) or (name.startswith("power") and name not in unknown):
            commands[name] = _template(table, name, table.string(name), {"address"}, binary)
    for close, opens in (("shutter_close", "shutter_open"), ("lens_shutter_close", "lens_shutter_open")):
        if (close in commands) != (opens in commands):
            raise table.wrong(close, f"give both {close} and {opens}, or neither")
    if "lens_shutter_close" in commands and "shutter_close" not in commands:
        raise table.wrong("lens_shutter_close", "give shutter_close too, for models that refuse it")
    table.finish()
    return commands


def _queries(table: Table, unknown: tuple[str, ...], binary: bool) -> dict[str, Query]:
    queries = {}
    for name in QUERIES:
        _check_unknown(table, name, unknown)
        if table.has(name) or (name == "power" and name not in unknown):
            queries[name] = _query(table.table(name), name, binary)
    if not queries:
        raise table.wrong("power", "give at least one query, to check for the projector")
    table.finish()
    return queries


def _check_unknown(table: Table, name: str, unknown: tuple[str, ...]) -> None:
    if name in unknown and table.has(name):
        raise table.wrong(name, "it is also in profile.unknown")


def _query(table: Table, name: str, binary: bool) -> Query:
    values = table.mapping("values", allowed=POWERS if name == "power" else None)
    if name == "power" and not {"on", "off"} <= set(values.values()):
        raise table.wrong("values", "it must list the answers for on and off")
    answers = table.strings("answers")
    for answer in answers:
        if _template(table, "answers", answer, {"value", "any"}, binary).count("{value}") != 1:
            raise table.wrong("answers", f"{answer!r} must contain {{value}} once")
    reads = table.choice("reads", tuple(READS), "text")
    if READS[reads] == "hex" and not binary:
        raise table.wrong("reads", f'{reads!r} needs serial.notation = "hex"')
    made = Query(
        send=_template(table, "send", table.string("send"), {"address"}, binary),
        answers=answers,
        values=values,
        absent=table.strings("absent", ()),
        unknown=table.strings("unknown", ()) if name == "power" else (),
        reads=reads,
        per_hour=UNITS[table.choice("unit", tuple(UNITS), "hours")],
    )
    table.finish()
    return made


def _notices(table: Table) -> Notices:
    power = {code: Power(word) for code, word in table.mapping("power", allowed=POWERS).items()}
    trouble = table.mapping("trouble")
    for code, word in trouble.items():
        if code in power:
            raise table.wrong("trouble", f"the code {code} is also in power")
        if not _WORD.fullmatch(word):
            raise table.wrong("trouble", f"{word!r} is not lower case with hyphens")
    prefix = table.string("prefix", "")
    if (power or trouble) and not prefix:
        raise table.wrong("prefix", "notices need a prefix")
    table.finish()
    return Notices(prefix, power, trouble)


def _shapes(table: Table, key: str, binary: bool, *, required: bool = True) -> tuple[str, ...]:
    """Lines with a meaning; one of them may be empty (only the terminator)."""
    shapes = table.strings(key, None if required else (), empty=True)
    for shape in shapes:
        if shape:
            _template(table, key, shape, {"any"}, binary)
    return shapes


def _template(table: Table, key: str, text: str, allowed: Iterable[str], binary: bool) -> str:
    """Check a command or shape: not empty, bytes of Latin-1 or hexadecimal, known placeholders only."""
    if not text:
        raise table.wrong(key, "it is empty")
    for name in _PLACEHOLDER.findall(text):
        if name not in allowed:
            raise table.wrong(key, f"{{{name}}} is not one of the placeholders {{{', '.join(sorted(allowed))}}}")
    wild = "address" not in allowed
    if binary and (not _HEX_SHAPE.fullmatch(text) or (not wild and not set("?{").isdisjoint(text))):
        raise table.wrong(key, f"{text!r} must be bytes such as 0F with spaces between them")
    _bytes(table, key, text)
    return text


def _bytes(table: Table, key: str, text: str) -> bytes:
    try:
        return text.encode("latin-1")
    except UnicodeEncodeError:
        raise table.wrong(key, f"{text!r} has a character that is not a byte (Latin-1)") from None
