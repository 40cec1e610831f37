"""An emulated projector on a pseudo terminal: real bytes, a real baud rate, and a plug that can be pulled."""

from __future__ import annotations

import contextlib
import os
import select
import termios
import threading
import time
import tty
from collections import deque
from pathlib import Path
from typing import Final

from hal.errors import DeviceError
from hal.serial_link import PtyLink
from plugins.emulated.projectors.board import Board, OptomaBoard
from plugins.emulated.projectors.lamp import EmulatedLamp
from plugins.emulated.projectors.projector import BoardProjector

_TICK_S: Final = 0.02


class EmulatedSerialProjector(BoardProjector):
    """A projector on a pty, reached by the symlink ``port`` as a real one is by ``/dev/serial/by-id/...``.

    Parameters
    ----------
    port : where the symlink to the tty is made
    lamp : its lamp; the optical bench reads the same one
    board : what it does with the bytes; an Optoma of a later model, unless given
    baud : the rate it listens at; at any other the line carries noise both ways
    wedges_below_s : with two commands within this time while it warms or cools, it hangs until its mains were cut
    boot_s : from mains on until its control board answers

    ``faults`` are its knobs, ``scenario`` a script that turns them. ``start`` and ``stop`` it, or use it in a ``with``
    statement. Its serial adapter has its power from the computer, and stays when the mains are cut.
    """

    def __init__(
        self,
        port: Path,
        lamp: EmulatedLamp,
        board: Board | None = None,
        *,
        baud: int = 9600,
        wedges_below_s: float = 0.0,
        boot_s: float = 0.0,
    ) -> None:
        super().__init__(lamp, board or OptomaBoard(lamp), wedges_below_s=wedges_below_s, boot_s=boot_s)
        self.port = port
        self._speed = getattr(termios, f"B{baud}")
        self._lock = threading.Lock()
        self._master: int | None = None
        self._slave: int | None = None
        self._path: str | None = None
        self._last_path: str | None = None
        self._link: PtyLink | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._due: deque[tuple[float, bytes]] = deque()

    def start(self) -> None:
        """Plug in and listen. Raises DeviceError("no-pty") if the system has no pseudo terminal left."""
        self.replug()
        self._stop.clear()
        self._thread = threading.Thread(target=self._run, name=f"projector {self.port.name}", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Unplug and end. Harmless when called twice."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=2.0)
            self._thread = None
        self.unplug()

    @property
    def address(self) -> str:
        """The name of its port."""
        return str(self.port)

    @property
    def path(self) -> str | None:
        """The tty behind the symlink now; None while unplugged."""
        with self._lock:
            return self._path

    def unplug(self) -> None:
        """Pull the adapter: the tty hangs up and its name disappears. The projector itself stays as it is."""
        with self._lock:
            if self._master is None:
                return
            if self._link is not None:
                self._link.remove()
                self._link = None
            for handle in (self._master, self._slave):
                if handle is not None:
                    os.close(handle)
            self._master = self._slave = self._path = None
            self._due.clear()

    def replug(self) -> None:
        """Plug the adapter in again: it comes back as another tty, and the symlink follows."""
        with self._lock:
            if self._master is not None:
                return
            self._master, self._slave, self._path = self._another_pty()
            self._last_path = self._path
            self._link = PtyLink(self.port, self._path)

    def _another_pty(self) -> tuple[int, int, str]:
        """A pty at another path than the last one: the system would hand out the free number again."""
        made = _new_pty()
        if made[2] != self._last_path:
            return made
        another = _new_pty()
        os.close(made[0])
        os.close(made[1])
        return another

    def _run(self) -> None:
        while not self._stop.is_set():
            if self.scenario is not None:
                self.scenario.tick()
            with self._lock:
                master = self._master
            if master is None:
                self._stop.wait(_TICK_S)
                continue
            try:
                self._turn(master)
            except OSError:
                # The plug was pulled between two looks; the next one sees it.
                self._stop.wait(_TICK_S)

    def _turn(self, master: int) -> None:
        readable, _, _ = select.select([master], [], [], _TICK_S)
        data = self._arrived(master) if readable else b""
        if not self.awake:
            self._due.clear()
            return
        if data:
            self._hear(data)
        for notice in self._board.notices():
            if not self.faults.now.silent and not self.wedged:
                self._due.append((time.monotonic(), notice))
        while self._due and self._due[0][0] <= time.monotonic():
            self._say(master, self._due.popleft()[1])

    def _arrived(self, master: int) -> bytes:
        """What came over this plug; nothing once it is pulled, for its number may be another emulator's by then."""
        with self._lock:
            if master != self._master:
                return b""
            try:
                return self._heard(os.read(master, 4096))
            except BlockingIOError:
                return b""

    def _hear(self, data: bytes) -> None:
        if self.scenario is not None:
            self.scenario.heard(len(data))
        self._hang_if_too_soon()
        for answer in self._board.feed(data, busy=self.faults.now.busy):
            if not self.faults.loses_this_one() and not self.wedged:
                carried, wait_s = self.faults.bent(answer)
                self._due.append((time.monotonic() + wait_s, carried))

    def _say(self, master: int, data: bytes) -> None:
        with self._lock:
            if master == self._master:  # a new plug must not hear the old one's answers
                with contextlib.suppress(BlockingIOError):  # no one reads: a serial line does not wait
                    os.write(master, self._heard(data))

    def _heard(self, data: bytes) -> bytes:
        """What arrives of ``data``: at another baud rate than ours, noise."""
        if self._slave is None:
            return data
        same = termios.tcgetattr(self._slave)[5] == self._speed
        return data if same else bytes((byte ^ 0x5A) | 0x80 for byte in data)


def _new_pty() -> tuple[int, int, str]:
    """A raw pseudo terminal: master, slave (kept open, so that a client may come and go), and the slave's path."""
    try:
        master, slave = os.openpty()
    except OSError as error:
        raise DeviceError(
            "no-pty",
            what=f"No pseudo terminal could be created: {error.strerror}.",
            remedy="Close other terminals, or mount /dev/pts, and start the bench again.",
        ) from error
    with contextlib.suppress(termios.error):
        tty.setraw(slave)
    path = os.ttyname(slave)
    os.set_blocking(master, False)
    return master, slave, path
