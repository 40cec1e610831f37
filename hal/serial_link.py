"""A byte link over a serial port (pyserial), real or pseudo terminal, and links to pseudo terminals.

The system gives the number of a closed terminal to the next program. The link of a killed program then leads to
another program's terminal, into which nothing may be written. So the owner of a link holds a lock as long as it owns
the terminal (``PtyLink``).
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import select
import termios
from pathlib import Path
from typing import BinaryIO, Final

import serial

from hal.deadline import Deadline
from hal.errors import DeviceError, DeviceGone, DeviceRefused
from hal.links import BufferedLink, port_taken
from hal.tape import Transcript

TERMINALS: Final = "/dev/pts/"


class PtyLink:
    """The link ``port`` to the terminal at ``path``, and its lock; created at once, kept until ``remove``.

    Raises ``OSError`` if it can't be created.
    """

    def __init__(self, port: Path, path: str) -> None:
        self._port = port
        port.parent.mkdir(parents=True, exist_ok=True)
        self._owner = _locked(_owner_of(port))
        # Before the link, so that a program that follows the link finds its owner.
        self._owner.write(path.encode())
        self._owner.flush()
        temporary = port.with_name(f".{port.name}.new")
        temporary.unlink(missing_ok=True)
        temporary.symlink_to(path)
        temporary.replace(port)

    def remove(self) -> None:
        """Remove the link, then release the lock."""
        self._port.unlink(missing_ok=True)
        _owner_of(self._port).unlink(missing_ok=True)
        self._owner.close()


def leads_to_its_owner(port: Path) -> bool:
    """Whether ``port`` may be opened: not our link, or one with a running owner. A link without owner is removed."""
    try:
        target = os.readlink(port)  # noqa: PTH115 - the text of the link, however it is written
    except OSError:
        return True  # no link, or a name that no file can have: opening it says what is wrong
    if not target.startswith(TERMINALS):
        return True
    try:
        owner = _owner_of(port).open("rb")
    except OSError:
        return True  # made by another program, without a lock
    with owner:
        try:
            fcntl.flock(owner, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return owner.read().decode(errors="replace") == target
        # A read-only folder keeps its stale link, which is not followed either.
        with contextlib.suppress(OSError):
            port.unlink(missing_ok=True)
            _owner_of(port).unlink(missing_ok=True)
    return False


def _owner_of(port: Path) -> Path:
    return port.with_name(f".{port.name}.owner")


def _locked(path: Path) -> BinaryIO:
    """The file, new or emptied, with its lock held."""
    while True:
        file = path.open("ab")
        fcntl.flock(file, fcntl.LOCK_EX)
        with contextlib.suppress(FileNotFoundError):
            if path.stat().st_ino == os.fstat(file.fileno()).st_ino:
                file.truncate(0)
                return file
        file.close()  # it was removed between the two calls


# After a hang-up pyserial raises SerialException (an OSError) from read and write, termios.error from flushes, and
# TypeError or ValueError once the descriptor is gone.
_LOST = (OSError, termios.error, TypeError, ValueError)
_BLOCK = 4096


class SerialLink(BufferedLink):
    """A serial port at ``port``, 8 data bits, no parity, 1 stop bit, no flow control, held exclusively.

    ``port`` should be a stable name (``/dev/serial/by-id/...``): it is resolved at every opening, so that a device
    that came back as another tty is found again.

    Raises
    ------
    DeviceGone     the port does not exist, or was unplugged
    DeviceBusy     another program holds it
    DeviceRefused  this user may not open it
    """

    def __init__(self, port: Path, *, baud: int, deadline: Deadline, transcript: Transcript | None = None) -> None:
        super().__init__(str(port), transcript)
        self._check(deadline, "was not opened")
        if not leads_to_its_owner(port):
            raise self._not_opened(None)
        try:
            self._serial = serial.Serial(str(port), baudrate=baud, timeout=0, write_timeout=0, exclusive=True)
        except _LOST as error:
            raise self._not_opened(error) from error
        if transcript is not None:
            transcript.remark(f"opened {port.resolve()} at {baud} baud")

    def _receive(self, wait_s: float) -> bytes:
        try:
            readable, _, _ = select.select([self._serial.fileno()], [], [], wait_s)
            return bytes(self._serial.read(_BLOCK)) if readable else b""
        except _LOST as error:
            raise self._unplugged() from error

    def _send(self, data: bytes, wait_s: float) -> int:
        try:
            _, writable, _ = select.select([], [self._serial.fileno()], [], wait_s)
            return int(self._serial.write(data) or 0) if writable else 0
        except _LOST as error:
            raise self._unplugged() from error

    def close(self) -> None:
        with contextlib.suppress(*_LOST):
            self._serial.close()

    def _unplugged(self) -> DeviceGone:
        return DeviceGone(
            "port-lost",
            what=f"The serial port {self.name} was disconnected.",
            remedy="Plug the adapter in again. Velatura then finds the port by its name.",
        )

    def _not_opened(self, error: BaseException | None) -> DeviceError:
        number = getattr(error, "errno", None)
        if number in (errno.EAGAIN, errno.EWOULDBLOCK, errno.EBUSY) or "exclusively lock" in str(error):
            return port_taken(self.name)
        if number in (errno.EACCES, errno.EPERM):
            return DeviceRefused(
                "port-forbidden",
                what=f"This user may not open the serial port {self.name}.",
                remedy="Add the user to the group that owns it (usually dialout), and log in again.",
            )
        return DeviceGone(
            "port-missing",
            what=f"The serial port {self.name} does not exist.",
            remedy="Check that the adapter is plugged in. Check the name of the port in stage.toml.",
        )
