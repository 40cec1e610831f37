"""Records a PTP conversation on a tape: as containers of PTP over USB, whatever bus it really went over.

So a tape of one bus can be replayed on another, and holds no name or key of this computer.
"""

from __future__ import annotations

import struct
from typing import Final

from hal.codecs.ptp import usb as ptp_usb
from hal.deadline import Deadline
from hal.transcript import Transcript
from plugins.ptp.link import MOST_IN_MEMORY, LinkEvent, PtpLink, Reply, Sink

TRACK: Final = "ptp"


class RecordedLink:
    """See ``PtpLink``."""

    def __init__(self, link: PtpLink, track: Transcript) -> None:
        self._link = link
        self._track = track
        self._number = -1
        track.remark("connected")

    @property
    def broken(self) -> bool:
        return self._link.broken

    def transact(
        self,
        operation: int,
        *parameters: int,
        data: bytes | None = None,
        sink: Sink | None = None,
        most: int = MOST_IN_MEMORY,
        deadline: Deadline,
    ) -> Reply:
        self._number += 1
        self._track.sent(ptp_usb.pack_command(operation, self._number, parameters))
        if data is not None:
            self._track.sent(ptp_usb.pack_data(operation, self._number, data))
        streamed = bytearray()

        def copied(piece: memoryview) -> object:
            streamed.extend(piece)
            return None if sink is None else sink(piece)

        reply = self._link.transact(
            operation, *parameters, data=data, sink=None if sink is None else copied, most=most, deadline=deadline
        )
        received = bytes(streamed) or reply.data
        if received:
            self._track.received(ptp_usb.pack_data(operation, self._number, received))
        self._track.received(_container(ptp_usb.RESPONSE, reply.code, self._number, reply.parameters))
        return reply

    def events(self) -> list[LinkEvent]:
        found = self._link.events()
        for event in found:
            self._track.received(_container(ptp_usb.EVENT, event.code, 0, event.parameters))
        return found

    def wait_event(self, seconds: float, *, deadline: Deadline) -> None:
        self._link.wait_event(seconds, deadline=deadline)

    def close(self) -> None:
        self._link.close()


def _container(kind: int, code: int, number: int, parameters: tuple[int, ...]) -> bytes:
    body = struct.pack(f"<{len(parameters)}I", *parameters)
    return ptp_usb.HEADER.pack(ptp_usb.HEADER.size + len(body), kind, code, number) + body
