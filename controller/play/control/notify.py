"""Tells systemd that the player is ready, alive or ending (sd_notify(3)); does nothing where systemd does not ask."""

from __future__ import annotations

import contextlib
import os
import socket
import sys
import time


def log(sentence: str) -> None:
    """Write a sentence for the log. A log that is full must not stop the picture."""
    with contextlib.suppress(OSError):
        print(sentence, file=sys.stderr, flush=True)  # noqa: T201


class Notifier:
    """Sends to the datagram socket named by ``NOTIFY_SOCKET``; alive at a third of ``WATCHDOG_USEC``."""

    def __init__(self) -> None:
        address = os.environ.get("NOTIFY_SOCKET", "")
        # "@" stands for the zero byte of an abstract address.
        self._address = "\0" + address[1:] if address.startswith("@") else address
        limit_us = os.environ.get("WATCHDOG_USEC", "")
        self.interval_s = int(limit_us) / 3e6 if limit_us.isdecimal() and self._address else None
        self._alive_at_s = 0.0

    def ready(self) -> None:
        self._send("READY=1")

    def stopping(self) -> None:
        self._send("STOPPING=1")

    def alive(self) -> None:
        """Feed the watchdog if it is time to. Call it from the loop itself, so that a hung loop is found."""
        now = time.monotonic()
        if self.interval_s is not None and now >= self._alive_at_s + self.interval_s:
            self._alive_at_s = now
            self._send("WATCHDOG=1")

    def _send(self, state: str) -> None:
        if not self._address:
            return
        # A service manager that is gone must not stop the picture.
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as channel:
            channel.setblocking(False)
            channel.sendto(state.encode(), self._address)
