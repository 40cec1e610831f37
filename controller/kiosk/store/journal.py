"""Events in systemd's journal, with their code, stage and number as fields (its native protocol)."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Callable, Mapping
from typing import Final

from controller.kiosk.interface import EventRow

SOCKET: Final = "/run/systemd/journal/socket"
_PRIORITIES: Final = {"info": "6", "warning": "4", "error": "3"}
"""Those of syslog."""


def journal_of(
    stage: str, environment: Mapping[str, str] = os.environ, path: str = SOCKET
) -> Callable[[EventRow], None] | None:
    """What sends an event to the journal; None where systemd did not start this process with its journal."""
    if "JOURNAL_STREAM" not in environment:
        return None

    def send(row: EventRow) -> None:
        datagram = fields(row, stage)
        # A journal that is full or gone must not stop the kiosk, which has its own event log.
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as channel:
            channel.setblocking(False)
            channel.sendto(datagram, path)

    return send


def fields(row: EventRow, stage: str) -> bytes:
    """An event as the journal's datagram."""
    named = {
        "MESSAGE": row.text,
        "PRIORITY": _PRIORITIES[row.level],
        "SYSLOG_IDENTIFIER": "velatura",
        "VELATURA_CODE": row.code,
        "VELATURA_STAGE": stage,
        "VELATURA_EVENT": str(row.number),
    }
    return b"".join(_field(name, value.encode("utf-8", "replace")) for name, value in named.items())


def _field(name: str, value: bytes) -> bytes:
    """With its length, so that a line break in a device's text begins no new field."""
    return name.encode() + b"\n" + len(value).to_bytes(8, "little") + value + b"\n"
