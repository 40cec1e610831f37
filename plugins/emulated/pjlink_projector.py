"""An emulated network projector: PJLink class 1 and 2 over TCP.

Written from the PJLink specification on its own: it shares no parser with the driver, so that a common mistake would
show.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import hmac
import random
import socket
import threading
import time
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Final

from hal.errors import DeviceError
from plugins.emulated.faults import Faults
from plugins.emulated.lamp import EmulatedLamp, LampPhase
from plugins.emulated.scenario import ScenarioPlayer

_CR: Final = b"\r"
_LONGEST: Final = 200
_TICK_S: Final = 0.05
_POWER: Final = {LampPhase.STANDBY: b"0", LampPhase.LIT: b"1", LampPhase.COOLING: b"2", LampPhase.WARMING: b"3"}
_FIXED: Final = {
    b"INF1": b"Velatura",
    b"INF2": b"Emulated PJLink projector",
    b"INFO": b"",
    b"CLSS": b"2",
    b"INST": b"11 12 31 32",
}
_SECOND: Final = {b"SNUM": b"VE-0001", b"SVER": b"1.0"}


class PjLinkBoard:
    """What the projector answers to a command: bytes in, bytes out; the lamp is the state."""

    def __init__(self, lamp: EmulatedLamp, name: str) -> None:
        self._lamp = lamp
        self._name = name.encode("utf-8")
        self._input = b"31"
        self._audio_muted = False

    def answer(self, line: bytes, *, busy: bool) -> bytes:
        """The answer to one command line without its CR; b"" for what is not PJLink at all."""
        if len(line) < 8 or line[:1] != b"%" or line[1:2] not in b"12" or line[6:7] != b" ":
            return b""
        pj_class, name, parameter = line[1:2], line[2:6].upper(), line[7:]
        return b"%" + pj_class + name + b"=" + (b"ERR3" if busy else self._act(pj_class, name, parameter)) + _CR

    def _act(self, pj_class: bytes, name: bytes, parameter: bytes) -> bytes:
        if parameter == b"?":
            return self._told(pj_class, name)
        actions: dict[bytes, Callable[[bytes], bytes]] = {
            b"POWR": self._switch,
            b"AVMT": self._mute,
            b"INPT": self._select,
        }
        return actions[name](parameter) if name in actions else b"ERR1"

    def _told(self, pj_class: bytes, name: bytes) -> bytes:
        if name in _FIXED:
            return _FIXED[name]
        if pj_class == b"2" and name in _SECOND:
            return _SECOND[name]
        if name in (b"INPT", b"AVMT") and not self._burning():
            return b"ERR3"
        state: dict[bytes, Callable[[], bytes]] = {
            b"POWR": lambda: _POWER[self._lamp.phase],
            b"LAMP": lambda: b"%d %d" % (self._lamp.hours, self._burning()),
            b"ERST": lambda: b"0%d%d000" % (2 * self._lamp.failed, 2 * self._lamp.too_hot),
            b"NAME": lambda: self._name,
            b"INPT": lambda: self._input,
            b"AVMT": self._muted,
        }
        return state[name]() if name in state else b"ERR1"

    def _burning(self) -> bool:
        return self._lamp.phase in (LampPhase.WARMING, LampPhase.LIT)

    def _muted(self) -> bytes:
        video, audio = self._lamp.shutter_closed, self._audio_muted
        return b"31" if video and audio else b"11" if video else b"21" if audio else b"30"

    def _switch(self, parameter: bytes) -> bytes:
        if parameter == b"1":
            if not self._lamp.strike():
                return b"ERR3"
            return b"ERR4" if self._lamp.failed else b"OK"
        if parameter == b"0":
            self._lamp.extinguish()
            return b"OK"
        return b"ERR2"

    def _mute(self, parameter: bytes) -> bytes:
        if parameter not in (b"10", b"11", b"20", b"21", b"30", b"31"):
            return b"ERR2"
        if not self._burning():
            return b"ERR3"
        on = parameter[1:] == b"1"
        if parameter[:1] in b"13":
            self._lamp.shutter_closed = on
        if parameter[:1] in b"23":
            self._audio_muted = on
        return b"OK"

    def _select(self, parameter: bytes) -> bytes:
        if parameter not in _FIXED[b"INST"].split():
            return b"ERR2"
        if not self._burning():
            return b"ERR3"
        self._input = parameter
        return b"OK"


class EmulatedPjLinkProjector:
    """A projector on loopback TCP. ``start`` and ``stop`` it, or use it in a ``with`` statement.

    Parameters
    ----------
    lamp : its lamp; the optical bench reads the same one
    port : TCP port, 0 for any free one (see ``address`` once started)
    password : asked of every client, or None
    idle_s : seconds after which an idle connection is closed (the specification says 30)
    chatty : it tells that it came up before it answers, and pads with NUL, as users report of some
    wedges_below_s : asked twice within this time while it warms or cools, it hangs: ``wedged`` is true for good

    ``faults`` are its knobs, ``scenario`` a script that turns them at what it hears; ``silent`` and ``slow_s`` hold for
    the greeting too.
    """

    def __init__(
        self,
        lamp: EmulatedLamp,
        *,
        port: int = 0,
        password: str | None = None,
        name: str = "emulated",
        idle_s: float = 30.0,
        seed: int = 1,
        chatty: bool = False,
        wedges_below_s: float = 0.0,
    ) -> None:
        self.lamp = lamp
        self.faults = Faults()
        self.scenario: ScenarioPlayer | None = None
        self._board = PjLinkBoard(lamp, name)
        self._board_lock = threading.Lock()
        self._wanted_port = port
        self._password = password
        self._idle_s = idle_s
        self._chatty = chatty
        self._wedges_below_s = wedges_below_s
        self._heard_at_s = 0.0
        self.wedged = False
        self._random = random.Random(seed)
        self._stop = threading.Event()
        self._listener: socket.socket | None = None
        self._threads: list[threading.Thread] = []

    @property
    def address(self) -> str:
        """``127.0.0.1:port``, once started."""
        if self._listener is None:
            raise DeviceError(
                "emulator-not-started",
                what="The emulated projector has no address before it is started.",
                remedy="Start it first.",
            )
        return "{}:{}".format(*self._listener.getsockname()[:2])

    def start(self) -> None:
        """Listen. Raises DeviceError("port-in-use") naming the port."""
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind(("127.0.0.1", self._wanted_port))
            listener.listen(8)
        except OSError as error:
            listener.close()
            raise _no_port(self._wanted_port, error) from error
        listener.settimeout(_TICK_S)
        self._stop.clear()
        self._listener = listener
        self._spawn(self._accept, listener)

    def stop(self) -> None:
        """Close every connection and end. Harmless when called twice."""
        self._stop.set()
        for thread in self._threads:
            thread.join(timeout=2.0)
        self._threads.clear()
        if self._listener is not None:
            self._listener.close()
            self._listener = None

    def __enter__(self) -> EmulatedPjLinkProjector:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _spawn(self, work: Callable[[socket.socket], None], on: socket.socket) -> None:
        self._threads = [thread for thread in self._threads if thread.is_alive()]
        thread = threading.Thread(target=work, args=(on,), name="pjlink projector", daemon=True)
        self._threads.append(thread)
        thread.start()

    def _accept(self, listener: socket.socket) -> None:
        while not self._stop.is_set():
            with contextlib.suppress(TimeoutError):
                client, _ = listener.accept()
                self._spawn(self._serve, client)

    def _serve(self, client: socket.socket) -> None:
        with client, contextlib.suppress(OSError):
            client.settimeout(_TICK_S)
            salt = None if self._password is None else f"{self._random.getrandbits(32):08x}"
            self._send(client, b"PJLINK 0\r" if salt is None else f"PJLINK 1 {salt}\r".encode())
            proof = None if salt is None else hashlib.md5(f"{salt}{self._password}".encode(), usedforsecurity=False)
            expected = None if proof is None else proof.hexdigest().encode()
            for line in self._lines(client):
                if self.scenario is not None:
                    self.scenario.tick()
                    self.scenario.heard(len(line) + 1)
                if expected is not None:
                    if not hmac.compare_digest(line[:32].lower(), expected):
                        self._send(client, b"PJLINK ERRA\r")
                        return
                    line, expected = line[32:], None  # noqa: PLW2901 - the proof goes before the first command only
                self._wedge()
                with self._board_lock:
                    answer = self._board.answer(line, busy=self.faults.now.busy)
                if answer and not self.wedged:
                    self._send(client, b"%2LKUP=02:00:00:00:00:01\r\0\0" + answer if self._chatty else answer)

    def _wedge(self) -> None:
        now_s, before_s = time.monotonic(), self._heard_at_s
        self._heard_at_s = now_s
        occupied = self.lamp.phase in (LampPhase.WARMING, LampPhase.COOLING)
        self.wedged |= occupied and now_s - before_s < self._wedges_below_s

    def _lines(self, client: socket.socket) -> Iterator[bytes]:
        """Lines without their CR until the client goes, is idle too long, or sends a line that never ends."""
        buffer = bytearray()
        heard = time.monotonic()
        while not self._stop.is_set() and time.monotonic() - heard < self._idle_s and len(buffer) < _LONGEST:
            while (end := buffer.find(_CR)) >= 0:
                line = bytes(buffer[:end])
                del buffer[: end + 1]
                yield line
            try:
                data = client.recv(1024)
            except TimeoutError:
                continue
            if not data:
                return
            heard = time.monotonic()
            buffer += data

    def _send(self, client: socket.socket, data: bytes) -> None:
        lost = self.faults.loses_this_one()
        carried, wait_s = self.faults.bent(data)
        if wait_s:
            self._stop.wait(wait_s)
        if not lost:
            client.sendall(carried)


def _no_port(port: int, error: OSError) -> DeviceError:
    if error.errno == errno.EADDRINUSE:
        return DeviceError(
            "port-in-use",
            what=f"TCP port {port} is in use by another program.",
            remedy=f"Stop that program (ss -ltnp | grep {port} names it), or choose another port.",
        )
    return DeviceError(
        "port-not-opened",
        what=f"TCP port {port} could not be opened: {error.strerror}.",
        remedy="Choose a port of 1024 or above.",
    )
