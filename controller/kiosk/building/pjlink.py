"""PJLink over TCP: the whole stage answers as one class 2 projector, so that any control desk can drive it."""

from __future__ import annotations

import asyncio
import hmac
import logging
import secrets
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Final

from pydantic import Field

from controller.core.errors import UsageError, VelaturaError
from controller.core.files import read_text
from controller.kiosk.building import pjlink_lines as lines
from controller.kiosk.building.protocol import NetworkOptions, Protocol
from controller.kiosk.building.verbs import Verbs
from hal.codecs.projectors import pjlink

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


async def serve(options: PjLinkOptions, verbs: Verbs) -> None:
    """Serve until cancelled. Raises OSError if it can't listen, and UsageError("pjlink-password-wrong")."""
    password = _password(options.password_file)
    clients: dict[asyncio.Task[None], asyncio.StreamWriter] = {}

    async def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        peer = str(writer.get_extra_info("peername")[0])
        try:
            if options.allows(peer) and len(clients) < MOST_CLIENTS:
                clients[task] = writer
                await _Session(reader, writer, verbs, password, peer).run()
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
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, verbs: Verbs, password: str, peer: str
    ) -> None:
        self._reader, self._writer, self._verbs, self._peer = reader, writer, verbs, peer
        self._password = password
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
                return None
            if len(theirs) != pjlink.SALT_BYTES:
                return None
            # The same digest from either side: both random numbers are mixed.
            right = pjlink.second_level_digest(self._salt, theirs, self._password)
        given, command = line[: len(right)].lower(), line[len(right) :]
        return command if hmac.compare_digest(given, right.lower()) else None

    def _answer(self, line: bytes) -> bytes:
        command = lines.parse_command(line)
        if command is None:
            return b"%1ERR1\r"
        try:
            return command.answer(self._done(command))
        except Exception:  # noqa: BLE001 - one command must not end the protocol
            _LOG.exception("A PJLink command failed.")
            return command.answer("ERR4")

    def _done(self, command: lines.Command) -> str:
        names: Sequence[str] = ()
        try:
            names = self._verbs.appearances()
        except VelaturaError:
            # A stage that is not set up has none; all else is answered.
            _LOG.debug("PJLink has no inputs.", exc_info=True)
        if lines.is_question(command):
            return lines.answer(command, self._verbs.status(), names, metadata.version("velatura"))
        wanted = lines.verb_for(command, names)
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
