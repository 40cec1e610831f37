"""PJLink over TCP: the whole stage answers as one class 2 projector, so that any control desk can drive it.

First the lines, without input or output: a line of bytes to the verb that it means and its answer. Sources: "PJLink
Specifications" 1.04 and 2.10 of JBMIA. Input 31 is the first appearance, up to 39, then 41 to 49 and 51 to 59; input 21
is the playlist. There is no sound, no filter, no volume.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import logging
import re
import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Final

from pydantic import Field

from controller.core.errors import UsageError, VelaturaError
from controller.core.files import read_text
from controller.kiosk.building.protocol import NetworkOptions, Protocol
from controller.kiosk.building.verbs import MOST_SOURCES, Verbs
from controller.kiosk.state import KioskState
from controller.run.state_machine import State
from hal.codecs.projectors import pjlink
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


IDLE_S: Final = 30.0
"""As the specification says (2.10, 2.1): a connection without commands is closed."""
MOST_CLIENTS: Final = 16
_LOG: Final = logging.getLogger("velatura.building")


class PjLinkOptions(NetworkOptions):
    """``password_file`` contains only the password (1 to 32 letters and digits); without it everybody in ``allow`` may
    use it.
    """

    port: int = Field(default=pjlink.PORT, ge=1, le=65535)
    password_file: Path | None = None


WRONG_S: Final = 0.01
"""How long an address waits after its first wrong password."""
GROWTH: Final = 1.3
"""Of that time with each other one: a desk that asks ten times does not notice, and 10,000 words last for days."""
LONGEST_WAIT_S: Final = 30.0
MOST_REMEMBERED: Final = 1 << 18


class Logins:
    """What is remembered of all log-ins: who guesses waits longer and longer, and none is taken twice."""

    def __init__(self, verbs: Verbs) -> None:
        self._verbs = verbs
        self._wrong: dict[str, int] = {}
        self._due_s: dict[str, float] = {}
        self._used: dict[bytes, None] = {}

    async def wait(self, peer: str) -> None:
        """Wait until it is this log-in's turn: those of an address that guesses come one after the other."""
        now_s = asyncio.get_running_loop().time()
        turn_s = min(max(now_s, self._due_s.get(peer, 0.0)), now_s + LONGEST_WAIT_S)
        if peer in self._wrong:
            self._due_s[peer] = turn_s + self._pause_s(peer)
            await asyncio.sleep(turn_s - now_s)

    def judge(self, peer: str, right: bool, digest: bytes) -> bool:
        """Whether the log-in is taken. ``digest``: what proved it; a second one like it is only a copy of the first."""
        if right and digest not in self._used:
            self._used[digest] = None
            if len(self._used) > MOST_REMEMBERED:
                del self._used[next(iter(self._used))]
            self._wrong.pop(peer, None)
            return True
        wrong = self._wrong[peer] = self._wrong.get(peer, 0) + 1
        if len(self._wrong) > MOST_SOURCES:
            del self._wrong[next(iter(self._wrong))]
        after_s = asyncio.get_running_loop().time() + self._pause_s(peer)
        self._due_s[peer] = max(self._due_s.get(peer, 0.0), after_s)
        if wrong & (wrong - 1) == 0:
            times = "a wrong password" if wrong == 1 else f"{wrong} wrong passwords in a row"
            self._verbs.record("pjlink-password-refused", f"{peer} sent {times}.")
        return False

    def _pause_s(self, peer: str) -> float:
        return float(min(WRONG_S * GROWTH ** min(self._wrong[peer] - 1, 100), LONGEST_WAIT_S))


async def serve(options: PjLinkOptions, verbs: Verbs) -> None:
    """Serve until cancelled. Raises OSError if it can't listen, and UsageError("pjlink-password-wrong")."""
    password, logins = _password(options.password_file), Logins(verbs)
    clients: dict[asyncio.Task[None], asyncio.StreamWriter] = {}

    async def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        peer = str(writer.get_extra_info("peername")[0])
        try:
            if options.allows(peer) and len(clients) < MOST_CLIENTS:
                clients[task] = writer
                await _Session(reader, writer, verbs, password, peer, logins).run()
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            _LOG.debug("A PJLink connection ended.", exc_info=True)
        finally:
            clients.pop(task, None)
            writer.close()

    server = await asyncio.start_server(connected, options.host, options.port, limit=pjlink.LONGEST_LINE + 128)
    try:
        await server.serve_forever()
    finally:
        server.close()
        # They are not cancelled: asyncio would log that as an error of the connection (Python 3.11).
        for writer in clients.values():
            writer.close()
        await asyncio.gather(*clients, return_exceptions=True)


class _Session:
    """One connection."""

    def __init__(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, verbs: Verbs, password: str, peer: str,
        logins: Logins,
    ) -> None:  # fmt: skip
        self._reader, self._writer, self._verbs, self._peer = reader, writer, verbs, peer
        self._password, self._logins = password, logins
        self._random = secrets.token_hex(4)
        self._salt: bytes | None = None

    async def run(self) -> None:
        """Until the client goes, is silent for too long, or sends a wrong password."""
        open_to_all = not self._password
        await self._send(b"PJLINK 0\r" if open_to_all else f"PJLINK 1 {self._random}\r".encode())
        entered = open_to_all
        while True:
            async with asyncio.timeout(IDLE_S):
                line = await self._reader.readuntil(pjlink.TERMINATOR)
            line = line.lstrip(b"\n")
            if not entered and line == pjlink.ASK_SECOND_LEVEL:
                self._salt = secrets.token_bytes(pjlink.SALT_BYTES)
                await self._send(b"PJLINK 2 " + self._salt.hex().upper().encode() + b"\r")
                continue
            if not entered:
                await self._logins.wait(self._peer)
                checked = self._without_digest(line)
                if checked is None:
                    await self._send(b"PJLINK ERRA\r")
                    return
                line, entered = checked, True
            await self._send(await asyncio.to_thread(self._answer, line))

    async def _send(self, answer: bytes) -> None:
        self._writer.write(answer)
        await self._writer.drain()

    def _without_digest(self, line: bytes) -> bytes | None:
        """The command behind the right digest of the password, else None."""
        if self._salt is None:
            right = pjlink.digest(self._random, self._password)
        else:
            length = 2 * pjlink.SALT_BYTES
            try:
                theirs = bytes.fromhex(line[:length].decode("ascii"))
            except ValueError:
                theirs = b""
            if len(theirs) != pjlink.SALT_BYTES:
                self._logins.judge(self._peer, False, b"")
                return None
            # The same digest from either side: both random numbers are mixed.
            right = pjlink.second_level_digest(self._salt, theirs, self._password)
        given, command = line[: len(right)].lower(), line[len(right) :]
        # The client chooses half of what is mixed at the second level, so that it could lead to an earlier digest.
        proof = given[-2 * hashlib.sha256().digest_size :]
        return command if self._logins.judge(self._peer, hmac.compare_digest(given, right.lower()), proof) else None

    def _answer(self, line: bytes) -> bytes:
        command = parse_command(line)
        if command is None:
            return b"%1ERR1\r"
        try:
            return command.answer(self._done(command))
        except Exception:  # noqa: BLE001 - one command must not end the protocol
            _LOG.exception("A PJLink command failed.")
            return command.answer("ERR4")

    def _done(self, command: Command) -> str:
        names: Sequence[str] = ()
        try:
            names = self._verbs.appearances()
        except VelaturaError:
            # A stage that is not set up has none; all else is answered.
            _LOG.debug("PJLink has no inputs.", exc_info=True)
        if is_question(command):
            return answer(command, self._verbs.status(), names, metadata.version("velatura"))
        wanted = verb_for(command, names)
        if isinstance(wanted, str):
            return wanted
        try:
            self._verbs.do(wanted.verb, wanted.values, source=self._peer)
        except VelaturaError:
            _LOG.debug("A PJLink command was refused.", exc_info=True)
            return "ERR3"
        return "OK"


def _password(file: Path | None) -> str:
    """Raises UsageError("pjlink-password-wrong")."""
    if file is None:
        return ""
    text = read_text(file).strip()
    if not (text.isascii() and text.isalnum() and len(text) <= pjlink.LONGEST_PASSWORD):
        raise UsageError(
            "pjlink-password-wrong",
            what=f"The PJLink password in {file} is not 1 to {pjlink.LONGEST_PASSWORD} letters and digits.",
            remedy="Write another one into the file.",
        )
    return text


PROTOCOL: Final = Protocol("pjlink", "PJLink", PjLinkOptions, serve)
