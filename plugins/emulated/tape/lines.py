"""Devices of a byte stream, on a pseudo terminal or a TCP port, from their track of a tape."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import threading
import time
import tty
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

from hal.serial_link import PtyLink
from hal.tape import Track
from hal.transcript import Direction, Entry
from plugins.emulated.tape.exchanges import Exchange, Replay

_TICK_S: Final = 0.02
_LONGEST_DELAY_S: Final = 10.0
_FORGET_S: Final = 0.5
"""Bytes that are no recorded command are forgotten after this time."""
_LARGEST: Final = 1 << 16
Pieces = tuple[tuple[float, bytes], ...]
"""(seconds after the command, bytes) of an answer."""


class LineReplay:
    """What the device of a track says: bytes in, (delay, bytes) out. ``unknown`` counts unrecorded commands."""

    def __init__(self, track: Track) -> None:
        self.unknown = 0
        self.greeting, exchanges = _exchanges(track.entries)
        asked = Counter(exchange.question for exchange in exchanges)
        # Text protocols mark queries; of others it is only known that what is sent again and again changes nothing.
        self._replay = Replay(exchanges, acts=lambda command: b"?" not in bytes(command) and asked[command] == 1)  # type: ignore[call-overload]
        self._commands = sorted({bytes(e.question) for e in exchanges}, key=len, reverse=True)  # type: ignore[call-overload]
        self._heard = b""
        self._heard_at_s = 0.0

    def connected(self) -> Pieces:
        """A new connection: what the device says unasked."""
        self._heard = b""
        return self.greeting

    def feed(self, data: bytes) -> list[Pieces]:
        """The answers to the commands that ``data`` completes."""
        now_s = time.monotonic()
        if self._heard and now_s - self._heard_at_s > _FORGET_S:
            self._heard, self.unknown = b"", self.unknown + 1
        self._heard, self._heard_at_s = (self._heard + data)[-_LARGEST:], now_s
        answers = []
        while (command := next((one for one in self._commands if self._heard.startswith(one)), None)) is not None:
            self._heard = self._heard[len(command) :]
            answers.append(self._replay.answer(command) or ())
        return answers


def _exchanges(entries: Iterable[Entry]) -> tuple[Pieces, list[Exchange[Pieces]]]:
    """The greeting of the first connection, and every command with what came before the next one."""
    greeting: list[tuple[float, bytes]] = []
    found: list[tuple[bytes, list[tuple[float, bytes]]]] = []
    answers, began_s, greeted = greeting, 0.0, False
    for entry in entries:
        if entry.way is Direction.REMARK:
            if entry.data == b"connected" or entry.data.startswith(b"opened "):
                answers, began_s = ([] if greeted else greeting), entry.at_s
                greeted = True
        elif entry.way is Direction.SENT and entry.data:
            found.append((entry.data, []))
            answers, began_s = found[-1][1], entry.at_s
        elif entry.data:
            answers.append((min(_LONGEST_DELAY_S, max(0.0, entry.at_s - began_s)), entry.data))
    return tuple(greeting), [Exchange(command, tuple(pieces)) for command, pieces in found]


class ReplayedLine:
    """Serves a ``LineReplay`` from ``start`` to ``stop``: base of the two ways. ``time_scale`` of recorded delays."""

    def __init__(self, replay: LineReplay, *, time_scale: float = 1.0) -> None:
        self.replay = replay
        self._time_scale = time_scale
        self._stopped = threading.Event()

    def _say(self, pieces: Pieces, write: Callable[[bytes], object]) -> None:
        began_s = time.monotonic()
        for after_s, data in pieces:
            self._stopped.wait(max(0.0, began_s + after_s * self._time_scale - time.monotonic()))
            write(data)


class ReplayedPort(ReplayedLine):
    """A device on a TCP port of this computer; one connection after the other."""

    def __init__(self, replay: LineReplay, *, port: int = 0, time_scale: float = 1.0) -> None:
        super().__init__(replay, time_scale=time_scale)
        self._listener = socket.create_server(("127.0.0.1", port))
        self._listener.settimeout(_TICK_S)
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"
        self._thread = threading.Thread(target=self._run, name="tape", daemon=True)

    def __enter__(self) -> ReplayedPort:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        self._thread.join()
        self._listener.close()

    def _run(self) -> None:
        while not self._stopped.is_set():
            try:
                connection, _ = self._listener.accept()
            except TimeoutError:
                continue
            with connection, contextlib.suppress(OSError):
                self._serve(connection)

    def _serve(self, connection: socket.socket) -> None:
        self._say(self.replay.connected(), connection.sendall)
        while not self._stopped.is_set():
            if not select.select([connection], [], [], _TICK_S)[0]:
                continue
            data = connection.recv(4096)
            if not data:
                return
            for pieces in self.replay.feed(data):
                self._say(pieces, connection.sendall)


class ReplayedTerminal(ReplayedLine):
    """A device on a pseudo terminal, reached by the link ``port``; it has any baud rate."""

    def __init__(self, replay: LineReplay, port: Path, *, time_scale: float = 1.0) -> None:
        super().__init__(replay, time_scale=time_scale)
        self.address = str(port)
        self._port = port
        self._thread = threading.Thread(target=self._run, name="tape", daemon=True)

    def __enter__(self) -> ReplayedTerminal:
        self._master, self._slave = os.openpty()  # the slave stays open, so that the master hears no hang-up
        tty.setraw(self._slave)
        self._link = PtyLink(self._port, os.ttyname(self._slave))
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        self._thread.join()
        self._link.remove()
        os.close(self._slave)
        os.close(self._master)

    def _run(self) -> None:
        while not self._stopped.is_set():
            if select.select([self._master], [], [], _TICK_S)[0]:
                for pieces in self.replay.feed(os.read(self._master, 4096)):
                    self._say(pieces, lambda data: os.write(self._master, data))
