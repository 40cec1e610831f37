"""Serial lines behind a device server: ``socket://host:port`` (bytes only) and ``rfc2217://host:port``.

RFC 2217 sets the baud rate of the distant port; pyserial speaks it. A device server with plain sockets has the rate in
its own settings.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import warnings
from typing import Any, Final
from urllib.parse import urlsplit

from serial import rfc2217

from hal.deadline import SLICE_S, Deadline
from hal.errors import DeviceError, DeviceGone, DeviceTimeout, PluginError
from hal.links import BufferedLink, ByteLink, TcpLink
from hal.tape import Transcript

SCHEMES: Final = ("socket", "rfc2217")
_LOST: Final = (OSError, ValueError, TypeError, AttributeError)


def is_url(port: str) -> bool:
    """Whether a port of stage.toml is behind a device server, and not a file."""
    return "://" in port


def parse_url(port: str) -> tuple[str, str, int]:
    """Scheme, host and TCP port of a URL. Raises PluginError("setting-wrong")."""
    parts, number = None, None
    with contextlib.suppress(ValueError):
        parts = urlsplit(port)
        number = parts.port
    if parts is None or parts.scheme not in SCHEMES or not parts.hostname or not number or parts.path.strip("/"):
        raise PluginError(
            "setting-wrong",
            what=f"The port {port!r} is not a serial port over the network.",
            remedy='Write it in stage.toml like this: "socket://192.168.0.20:23" or "rfc2217://192.168.0.20:2217".',
        )
    return parts.scheme, parts.hostname, number


def open_url(port: str, *, baud: int, deadline: Deadline, transcript: Transcript | None = None) -> ByteLink:
    """Open the line. Raises DeviceGone, DeviceTimeout, Cancelled and PluginError("setting-wrong")."""
    scheme, host, number = parse_url(port)
    if scheme == "socket":
        return TcpLink(host, number, deadline=deadline, transcript=transcript)
    return Rfc2217Link(host, number, baud=baud, deadline=deadline, transcript=transcript)


class Rfc2217Link(BufferedLink):
    """A distant serial port by RFC 2217, 8 data bits, no parity, 1 stop bit.

    pyserial's opening and closing take seconds and know no deadline: they run on a thread, which is left behind if the
    deadline passes, and then closes what it opened.

    Raises
    ------
    DeviceGone     no device server there, or it does not speak RFC 2217
    DeviceTimeout  it did not accept the settings before the deadline
    """

    def __init__(
        self, host: str, port: int, *, baud: int, deadline: Deadline, transcript: Transcript | None = None
    ) -> None:
        super().__init__(f"rfc2217://{host}:{port}", transcript)
        self._check(deadline, "was not opened")
        opened: queue.SimpleQueue[Any] = queue.SimpleQueue()
        left = threading.Event()
        # Not every device server reports DTR and RTS, which projectors do not use: their answers are not waited for.
        url = f"rfc2217://{f'[{host}]' if ':' in host else host}:{port}?ign_set_control"
        threading.Thread(target=_open, args=(url, baud, opened, left), name="rfc2217", daemon=True).start()
        made: Any = None
        try:
            while made is None:
                with contextlib.suppress(queue.Empty):
                    made = opened.get(timeout=min(SLICE_S, max(0.001, deadline.left_s())))
                if made is None:
                    self._check(deadline, "did not accept a connection")
        except DeviceError:
            left.set()
            with contextlib.suppress(queue.Empty):
                _close(opened.get_nowait())
            raise
        if isinstance(made, BaseException):
            raise self._lost(made) from made
        self._serial = made

    def _receive(self, wait_s: float) -> bytes:
        try:
            waiting = self._serial.in_waiting
            if not waiting and wait_s <= 0:
                return b""
            return bytes(self._serial.read(max(1, waiting)))
        except _LOST as error:
            raise self._lost(error) from error

    def _send(self, data: bytes, wait_s: float) -> int:
        try:
            return int(self._serial.write(data) or 0)
        except TimeoutError as error:
            raise DeviceTimeout(
                "link-no-answer",
                what=f"{self.name} did not take the command in time.",
                remedy="Check that the device server has power and its network cable is connected.",
            ) from error
        except _LOST as error:
            raise self._lost(error) from error

    def close(self) -> None:
        threading.Thread(target=_close, args=(self._serial,), name="rfc2217", daemon=True).start()

    def _lost(self, error: BaseException) -> DeviceGone:
        return DeviceGone(
            "link-lost",
            what=f"{self.name} can't be reached, or does not speak RFC 2217.",
            remedy="Check the address, the network cable, and that RFC 2217 is on in the device server's settings.",
        )


class _Port(rfc2217.Serial):  # type: ignore[misc]
    """pyserial's client, which forgets its socket, open, if the other end has closed the connection."""

    def close(self) -> None:
        connection = getattr(self, "_socket", None)
        super().close()
        if connection is not None:
            with contextlib.suppress(OSError):
                connection.close()


def _open(url: str, baud: int, opened: queue.SimpleQueue[Any], left: threading.Event) -> None:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # pyserial 3.5 names its thread in an old way
            made = _Port(url, baudrate=baud, timeout=SLICE_S)
    except Exception as error:  # noqa: BLE001 - it is raised again in the waiting thread
        opened.put(error)
        return
    opened.put(made)
    if left.is_set():
        with contextlib.suppress(queue.Empty):
            _close(opened.get_nowait())


def _close(made: Any) -> None:
    """Close what was opened; pyserial waits for its reader."""
    if not isinstance(made, BaseException):
        with contextlib.suppress(*_LOST):
            made.close()
