"""Questions to the player over its socket, each with a time in which it has to answer."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from controller.core.errors import WorkError


def connected(path: Path, timeout_s: float) -> socket.socket:
    """A connection to the player that serves ``path``. Raises OSError, and TimeoutError."""
    channel = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        channel.settimeout(timeout_s)
        channel.connect(str(path))
    except BaseException:
        channel.close()
        raise
    return channel


class PlayerChannel:
    """One connection, opened at the first question and again after ``close``."""

    def __init__(
        self,
        connect: Callable[[Path, float], socket.socket] = connected,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._connect, self._monotonic = connect, monotonic
        self._socket: socket.socket | None = None
        self._numbers = 0

    def request(self, path: Path, request: dict[str, Any], timeout_s: float) -> dict[str, Any]:
        """The answer of the player that serves ``path``.

        Raises TimeoutError, OSError, ValueError, and WorkError for what the player refuses.
        """
        if self._socket is None:
            self._socket = self._connect(path, timeout_s)
        self._numbers += 1
        number, until_s = self._numbers, self._monotonic() + timeout_s
        self._socket.settimeout(timeout_s)
        self._socket.sendall(json.dumps({"id": number, **request}).encode() + b"\n")
        waiting = b""
        while True:
            self._socket.settimeout(max(0.01, until_s - self._monotonic()))
            data = self._socket.recv(1 << 16)
            if not data:
                raise ConnectionError
            waiting += data
            *lines, waiting = waiting.split(b"\n")
            for line in lines:
                answer = json.loads(line)
                # An answer that came too late for an earlier question is passed over.
                if answer.get("id") == number:
                    return _accepted(answer)

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def _accepted(answer: dict[str, Any]) -> dict[str, Any]:
    if answer["ok"]:
        return answer
    error = answer["error"]
    if error["code"] == "superseded":
        return answer
    raise WorkError(str(error["code"]), what=str(error["what"]), remedy=str(error["remedy"]))
