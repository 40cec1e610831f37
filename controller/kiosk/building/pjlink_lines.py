"""The stage as a PJLink class 2 projector: a line of bytes to the verb it means and its answer. No I/O.

Sources: "PJLink Specifications" 1.04 and 2.10 of JBMIA. Input 31 is the first appearance, up to 39, then 41
to 49 and 51 to 59; input 21 is the playlist. There is no sound, no filter, no volume.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from controller.kiosk.interface import KioskState
from controller.run.state_machine import State
from hal.codecs.projectors.pjlink import LONGEST_LINE, MOST_LAMPS

INPUTS: Final = tuple(f"{kind}{number}" for kind in "345" for number in range(1, 10))
"""The codes of the appearances, in the bundle's order; any more of them have none."""
PLAYLIST: Final = "21"
_COMMAND: Final = re.compile(rb"%([12])([A-Za-z0-9]{4}) ([^\r\n]{1,128})\r?\n?")
_CLASS_2: Final = {"INNM", "FREZ", "IRES", "RRES", "FILT", "RLMP", "RFIL", "SNUM", "SVER", "SVOL", "MVOL"}
_MUTES: Final = {"10": False, "11": True, "30": False, "31": True}
_MOST_LAMP_HOURS: Final = 99999
_STANDBY: Final = (State.OFF.value, State.SOLVING.value, State.PUBLISHING.value)
_WARMING: Final = (State.POWERING.value, State.WARMING.value)
_MAKER: Final = "Velatura"


@dataclass(frozen=True, slots=True)
class Command:
    """A command: its class "1" or "2", its name in capitals, and its parameter ("?" asks)."""

    pj_class: str
    name: str
    parameter: str

    def answer(self, text: str) -> bytes:
        return f"%{self.pj_class}{self.name}={text}\r".encode()


@dataclass(frozen=True, slots=True)
class Wanted:
    """A verb of ``verbs.Verbs`` with its values, for a command that changes something."""

    verb: str
    values: dict[str, Any]


def parse_command(line: bytes) -> Command | None:
    """The command in a line; None for what is no command."""
    match = _COMMAND.fullmatch(line) if len(line) <= LONGEST_LINE else None
    if match is None:
        return None
    name = match[2].decode("ascii").upper()
    return Command(match[1].decode("ascii"), name, match[3].decode("utf-8", "replace").strip())


def inputs(names: Sequence[str]) -> dict[str, str]:
    """The appearances by the codes of their inputs."""
    return dict(zip(INPUTS, names, strict=False))


def verb_for(command: Command, names: Sequence[str]) -> Wanted | str:
    """What a command that changes something means, or the error code of the specification (2.2)."""
    value = command.parameter
    shown = {code: Wanted("play", {"name": name}) for code, name in inputs(names).items()}
    if shown:
        shown[PLAYLIST] = Wanted("rotate", {})
    if not _known(command):
        return "ERR1"
    if command.name == "POWR" and value in ("0", "1"):
        return Wanted("open" if value == "1" else "close", {})
    if command.name == "INPT" and value.upper() in shown:
        return shown[value.upper()]
    if command.name == "AVMT" and value in _MUTES:
        return Wanted("black", {"on": _MUTES[value]})
    if command.name == "FREZ" and value in ("0", "1"):
        return Wanted("pause", {"on": value == "1"})
    return "ERR2" if command.name in ("POWR", "INPT", "AVMT", "FREZ") else "ERR1"


def answer(command: Command, now: KioskState, names: Sequence[str], version: str) -> str:
    """What a question is answered, or the error code of the specification."""
    if not _known(command):
        return "ERR1"
    if command.name == "INNM":
        return {PLAYLIST: "Playlist", **inputs(names)}.get(command.parameter[1:].upper(), "ERR2")
    answers = {
        "POWR": _power(now),
        "INPT": _input(now, names),
        "AVMT": "31" if now.black else "30",
        "ERST": _errors(now),
        "LAMP": _lamps(now),
        "INST": " ".join((PLAYLIST, *inputs(names))) if names else "ERR3",
        "NAME": _short(now.stage, 64),
        "INF1": _MAKER,
        "INF2": "Stage",
        "INFO": now.state,
        "CLSS": "2",
        "FREZ": "1" if now.paused else "0",
        "IRES": "*",
        "SNUM": _MAKER,
        "SVER": _short(version, 32),
    }
    return answers.get(command.name, "ERR1")


def is_question(command: Command) -> bool:
    return command.parameter == "?" or (command.name == "INNM" and command.parameter.startswith("?"))


def _known(command: Command) -> bool:
    return command.pj_class == "2" or command.name not in _CLASS_2


def _power(now: KioskState) -> str:
    if now.state == State.COOLING.value:
        return "2"
    if now.state in _WARMING:
        return "3"
    if now.state in _STANDBY:
        return "1" if any(lamp.lit for lamp in now.lamps) else "0"
    if now.state == State.FAULT.value:
        return "1" if any(lamp.lit for lamp in now.lamps) else "0"
    return "1"


def _input(now: KioskState, names: Sequence[str]) -> str:
    if now.in_turn and names:
        return PLAYLIST
    return next((code for code, name in inputs(names).items() if name == now.playing), "ERR3")


def _errors(now: KioskState) -> str:
    """Fan, lamp, temperature, cover, filter, other: 0 well, 1 a warning, 2 an error. A problem of a projector counts as
    one of its lamp; only a stage with a fault shows no picture.
    """
    fault = now.state == State.FAULT.value
    projectors = any(row.problem for row in now.devices if row.kind == "projector")
    others = any(row.problem for row in now.devices if row.kind != "projector") or now.warnings or now.failures
    lamp = "2" if fault and projectors else "1" if projectors else "0"
    other = "2" if fault and not projectors else "1" if others else "0"
    return f"0{lamp}000{other}"


def _lamps(now: KioskState) -> str:
    lamps = now.lamps[:MOST_LAMPS]
    return " ".join(f"{min(int(lamp.hours), _MOST_LAMP_HOURS)} {int(lamp.lit)}" for lamp in lamps) or "ERR1"


def _short(text: str, most: int) -> str:
    """At most ``most`` bytes of UTF-8, without characters that would end the line."""
    plain = "".join(character for character in text if character.isprintable())
    return plain.encode()[:most].decode(errors="ignore")
