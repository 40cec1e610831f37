"""Device profiles of projectors: what a family sends, answers and needs, as a validated value (``firmware_configs/``).

Words for trouble: a word that ends in ``-warning`` (``lamp-hours-warning``) tells of something to look at; any other
(``lamp-failed``, ``over-temperature``, ``fan-failed``, ``cover-open``) of a projector that cannot go on.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from hal.errors import ProtocolError
from hal.toml_table import Table, parse_toml
from hal.values import LampRules, Power

COMMANDS: Final = ("power_on", "power_off", "shutter_close", "shutter_open")
QUERIES: Final = ("power", "lamp_hours", "shutter", "model", "firmware")
POWERS: Final = tuple(power.value for power in Power)
_PLACEHOLDER: Final = re.compile(r"\{([^{}]*)\}")
_WORD: Final = re.compile(r"[a-z][a-z0-9-]{0,39}")
_DAY_S: Final = 86_400.0


@dataclass(frozen=True, slots=True)
class Timing:
    """How patient a driver is, in seconds.

    ``answer_s``: until an answer counts as lost; ``late_s``: until a lost answer can no longer arrive late;
    ``command_s``: until a power command is acknowledged; ``confirm_s``: until an accepted power command shows in the
    power state; ``interval_s``, ``boot_interval_s``: shortest time between two questions, ordinarily and while the
    projector starts or cools.
    """

    answer_s: float
    late_s: float
    command_s: float
    confirm_s: float
    interval_s: float
    boot_interval_s: float


@dataclass(frozen=True, slots=True)
class Query:
    """One question: what to send, the shapes of its answer (``{value}`` marks the value) and what values mean."""

    send: str
    answers: tuple[str, ...]
    values: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Notices:
    """Lines that the projector sends unasked: ``prefix`` and a code, which tells of its power or of trouble."""

    prefix: str
    power: Mapping[str, Power]
    trouble: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class SerialTable:
    """The command table of a serial family. ``{address}`` in a command stands for the projector's address."""

    baud: int
    terminator: bytes
    address: str
    longest_answer: int
    commands: Mapping[str, str]
    queries: Mapping[str, Query]
    accepted: tuple[str, ...]
    refused: tuple[str, ...]
    notices: Notices


@dataclass(frozen=True, slots=True)
class ProjectorProfile:
    """A family of projectors. ``serial`` is None for those that speak PJLink."""

    name: str
    maker: str
    family: str
    source: str
    lamp: LampRules
    timing: Timing
    serial: SerialTable | None


def parse_profile(text: str, *, file: str = "profile") -> ProjectorProfile:
    """Read a profile from TOML text.

    Raises
    ------
    ProtocolError("profile-wrong")  naming the key, its line where it has one, and what is allowed
    """
    root = parse_toml(text, file=file)
    head = root.table("profile")
    protocol = head.string("protocol")
    if protocol not in ("serial", "pjlink"):
        raise head.wrong("protocol", f"{protocol!r} is not one of serial, pjlink")
    profile = ProjectorProfile(
        name=head.string("name"),
        maker=head.string("maker"),
        family=head.string("family"),
        source=head.string("source"),
        lamp=_lamp(root.table("lamp")),
        timing=_timing(root.table("timing")),
        serial=_serial(root) if protocol == "serial" else None,
    )
    head.finish()
    root.finish()
    return profile


def _lamp(table: Table) -> LampRules:
    rules = LampRules(
        warm_up_s=table.seconds("warm_up_s", 0, 3600),
        stable_s=table.seconds("stable_s", 0, _DAY_S),
        cool_down_s=table.seconds("cool_down_s", 0, 3600),
        minimum_off_s=table.seconds("minimum_off_s", 0, _DAY_S),
    )
    if rules.stable_s < rules.warm_up_s:
        raise table.wrong("stable_s", "a lamp cannot be stable before it has warmed up (warm_up_s)")
    if rules.minimum_off_s < rules.cool_down_s:
        raise table.wrong("minimum_off_s", "a lamp cannot strike again before it has cooled (cool_down_s)")
    table.finish()
    return rules


def _timing(table: Table) -> Timing:
    timing = Timing(
        answer_s=table.seconds("answer_s", 0.01, 60),
        late_s=table.seconds("late_s", 0.01, 120),
        command_s=table.seconds("command_s", 0.01, 300),
        confirm_s=table.seconds("confirm_s", 0.01, 300),
        interval_s=table.seconds("interval_s", 0, 60),
        boot_interval_s=table.seconds("boot_interval_s", 0, 60),
    )
    if timing.late_s < timing.answer_s:
        raise table.wrong("late_s", "an answer cannot be late before it is due (answer_s)")
    if timing.boot_interval_s < timing.interval_s:
        raise table.wrong(
            "boot_interval_s", "a starting projector must not be asked more often than others (interval_s)"
        )
    if timing.confirm_s < timing.boot_interval_s:
        raise table.wrong("confirm_s", "there must be time for one question (boot_interval_s)")
    table.finish()
    return timing


def _serial(root: Table) -> SerialTable:
    line = root.table("serial")
    replies = root.table("replies")
    made = SerialTable(
        baud=line.whole("baud", 300, 921_600),
        terminator=_bytes(line, "terminator", line.string("terminator")),
        address=line.string("address", ""),
        longest_answer=line.whole("longest_answer", 4, 4096),
        commands=_commands(root.table("commands")),
        queries=_queries(root.table("queries")),
        accepted=replies.strings("accepted"),
        refused=replies.strings("refused"),
        notices=_notices(root.table("notices", required=False)),
    )
    if not made.terminator:
        raise line.wrong("terminator", "it is empty")
    if not ((made.address.isascii() and made.address.isalnum()) or not made.address):
        raise line.wrong("address", f"{made.address!r} is not made of letters and digits")
    line.finish()
    replies.finish()
    return made


def _commands(table: Table) -> dict[str, str]:
    commands = {}
    for name in COMMANDS:
        if table.has(name) or name.startswith("power"):
            commands[name] = _template(table, name, table.string(name), {"address"})
    if ("shutter_close" in commands) != ("shutter_open" in commands):
        raise table.wrong("shutter_close", "shutter_close and shutter_open must both be there, or neither")
    table.finish()
    return commands


def _queries(table: Table) -> dict[str, Query]:
    queries = {}
    for name in QUERIES:
        if not table.has(name) and name != "power":
            continue
        inner = table.table(name)
        power = name == "power"
        values = inner.mapping("values", allowed=POWERS if power else None)
        if power and not {"on", "off"} <= set(values.values()):
            raise inner.wrong("values", "it must say which answers mean on and off")
        answers = inner.strings("answers")
        for answer in answers:
            if _template(inner, "answers", answer, {"value"}).count("{value}") != 1:
                raise inner.wrong("answers", f"{answer!r} must hold {{value}} once")
        queries[name] = Query(_template(inner, "send", inner.string("send"), {"address"}), answers, values)
        inner.finish()
    table.finish()
    return queries


def _notices(table: Table) -> Notices:
    power = {code: Power(word) for code, word in table.mapping("power", allowed=POWERS).items()}
    trouble = table.mapping("trouble")
    for code, word in trouble.items():
        if code in power:
            raise table.wrong("trouble", f"the code {code} stands in power as well")
        if not _WORD.fullmatch(word):
            raise table.wrong("trouble", f"{word!r} is not lower case with hyphens")
    prefix = table.string("prefix", "")
    if (power or trouble) and not prefix:
        raise table.wrong("prefix", "notices need the prefix that they begin with")
    table.finish()
    return Notices(prefix, power, trouble)


def _template(table: Table, key: str, text: str, allowed: set[str]) -> str:
    """Check a command or answer: not empty, bytes of Latin-1, known placeholders only."""
    if not text:
        raise table.wrong(key, "it is empty")
    for name in _PLACEHOLDER.findall(text):
        if name not in allowed:
            raise table.wrong(key, f"{{{name}}} is not one of the placeholders {{{', '.join(sorted(allowed))}}}")
    _bytes(table, key, text)
    return text


def _bytes(table: Table, key: str, text: str) -> bytes:
    try:
        return text.encode("latin-1")
    except UnicodeEncodeError:
        raise _not_bytes(table, key, text) from None


def _not_bytes(table: Table, key: str, text: str) -> ProtocolError:
    return table.wrong(key, f"{text!r} holds a character that is not a byte (Latin-1)")
