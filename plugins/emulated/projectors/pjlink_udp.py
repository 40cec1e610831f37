"""What an emulated PJLink class 2 projector does on UDP: it answers searches, and tells of changes.

Written from the specification on its own: it shares no parser with the driver.
"""

from __future__ import annotations

import contextlib
import socket
import threading
from typing import Final

from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase
from plugins.emulated.switched import Switched

_TICK_S: Final = 0.02
_POWER: Final = {LampPhase.STANDBY: 0, LampPhase.LIT: 1, LampPhase.COOLING: 2, LampPhase.WARMING: 3}


class EmulatedPjLinkUdp(Switched):
    """The UDP side of a projector, on loopback. ``start`` and ``stop`` it, or use it in a ``with`` statement.

    Parameters
    ----------
    lamp : its lamp; power and errors follow from it
    mac : its address as it tells it, with or without colons
    controller : host and port registered for notifications; a search is answered to its sender
    answer_after_s : how long it takes to answer a search (real ones choose 0 to 10 s)
    """

    def __init__(
        self, lamp: EmulatedLamp, *, mac: str, controller: tuple[str, int] | None = None, answer_after_s: float = 0.0
    ) -> None:
        self._lamp = lamp
        self._mac = mac.encode("ascii")
        self._controller = controller
        self._answer_after_s = answer_after_s
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(_TICK_S)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pjlink udp", daemon=True)

    @property
    def address(self) -> tuple[str, int]:
        host, port = self._socket.getsockname()[:2]
        return str(host), int(port)

    def start(self) -> None:
        """Come up, and tell so."""
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join(timeout=2.0)
        self._socket.close()

    def select_input(self, name: str) -> None:
        """Somebody chose another input by the projector's own keys."""
        self._send(b"%2INPT=" + name.encode("ascii") + b"\r")

    def _run(self) -> None:
        before = self._state()
        self._send(b"%2LKUP=" + self._mac + b"\r")
        while not self._stop.is_set():
            self._answer()
            now = self._state()
            for line, old in zip(now, before, strict=True):
                if line != old:
                    self._send(line)
            before = now

    def _state(self) -> tuple[bytes, bytes]:
        errors = b"0%d%d000" % (2 * self._lamp.failed, 2 * self._lamp.too_hot)
        return b"%%2POWR=%d\r" % _POWER[self._lamp.phase], b"%2ERST=" + errors + b"\r"

    def _answer(self) -> None:
        with contextlib.suppress(TimeoutError, ConnectionError):
            data, sender = self._socket.recvfrom(256)
            if data == b"%2SRCH\r" and not self._stop.wait(self._answer_after_s):
                self._socket.sendto(b"%2ACKN=" + self._mac + b"\r", sender)

    def _send(self, data: bytes) -> None:
        if self._controller is not None:
            with contextlib.suppress(OSError):
                self._socket.sendto(data, self._controller)
