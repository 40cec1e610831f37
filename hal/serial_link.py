"""A byte link over a serial port (pyserial), real or pseudo terminal."""

from __future__ import annotations

import contextlib
import errno
import select
import termios
from pathlib import Path

import serial

from hal.deadline import Deadline
from hal.errors import DeviceError, DeviceGone, DeviceRefused
from hal.links import BufferedLink, port_taken
from hal.pty_links import leads_to_its_owner
from hal.transcript import Transcript

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
