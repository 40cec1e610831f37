"""PTP over USB: transactions on the bulk pipes (PIMA 15740, annex D); ``ptp_usb_events`` reads the interrupt pipe.

One thread at a time may use a link. Everything waits in slices, so that the
caller's deadline and cancellation are kept; a transaction that was left in the middle is cancelled (0x64) and breaks
the link, because its late answer could be taken for the next one.
"""

from __future__ import annotations

import contextlib
import threading
import time
from array import array
from collections.abc import Callable
from typing import Final, Self, TypeVar

from hal.codecs.ptp import usb as ptp_usb
from hal.codecs.ptp.usb import HEADER, ClassRequest
from hal.codecs.ptp.values import Answer, broken
from hal.deadline import Deadline
from hal.errors import DeviceError, ProtocolError
from plugins.ptp.ip import still_time
from plugins.ptp.link import MOST_IN_MEMORY, LinkEvent, Reply, Sink, camera_lost
from plugins.ptp.usb.pipes import InterruptReader, Pipes, PipeStalled

Result = TypeVar("Result")

_SLICE_S: Final = 0.1
_BLOCK: Final = 1 << 20
_REQUEST_S: Final = 0.3
_RESET_S: Final = 2.0
_EMPTY_S: Final = 0.01
_MOST_LEFTOVERS: Final = 256
_MOST_ODD: Final = 16
"""Maximum number of empty packets and answers to earlier requests before an answer."""


class PtpUsbLink:
    """An open camera on USB; see ``PtpLink``. ``pipes`` belong to it and are closed with it."""

    def __init__(self, pipes: Pipes) -> None:
        self._pipes = pipes
        self._transaction = -1
        self._first = array("B", bytes(pipes.packet))
        self._block = array("B", bytes(_BLOCK // pipes.packet * pipes.packet))
        self._spare = b""
        self._at_work = False
        self._ending = threading.Lock()
        self._closed = False
        self._interrupts = InterruptReader(pipes)

    @classmethod
    def over(cls, pipes: Pipes, *, deadline: Deadline) -> Self:
        """Start on ``pipes``: end unfinished transactions of another program. Closes the pipes if that fails."""
        link = cls(pipes)
        try:
            link._tidy_up(deadline)
        except BaseException:
            pipes.close()
            raise
        link._interrupts.start()
        return link

    @property
    def broken(self) -> bool:
        return self._closed or self._interrupts.ended is not None

    def transact(
        self,
        operation: int,
        *parameters: int,
        data: bytes | None = None,
        sink: Sink | None = None,
        most: int = MOST_IN_MEMORY,
        deadline: Deadline,
    ) -> Reply:
        still_time(deadline)
        with self._ending:
            self._check_open()
            self._at_work = True
        self._transaction = (self._transaction + 1) % 0xFFFF_FFFF
        number = self._transaction
        finished = False
        try:
            self._send(ptp_usb.pack_command(operation, number, parameters), deadline)
            if data is not None:
                self._send(ptp_usb.pack_data(operation, number, data), deadline)
            reply = self._answer(number, sink, most, deadline)
            finished = True
        except PipeStalled as stalled:
            raise camera_lost("it stalled twice") from stalled
        finally:
            with self._ending:
                self._at_work = False
                # The rest of the answer may still come; it must not be taken for the next one.
                closed = self._closed = self._closed or not finished
            if closed:
                self._let_go(unfinished=not finished)
        return reply

    def events(self) -> list[LinkEvent]:
        found = self._interrupts.taken()
        if not found:
            self._check_open()
        return found

    def wait_event(self, seconds: float, *, deadline: Deadline) -> None:
        until = deadline.within(seconds)
        while not until.passed and not self.broken:
            until.sleep(0)
            if self._interrupts.wait(min(_SLICE_S, until.left_s())):
                return

    def close(self) -> None:
        """A thread in a transaction notices this and closes the pipes itself."""
        with self._ending:
            at_work, closed, self._closed = self._at_work, self._closed, True
        if not closed and not at_work:
            self._let_go(unfinished=False)

    def _let_go(self, *, unfinished: bool) -> None:
        if unfinished and self._interrupts.ended is None:
            with contextlib.suppress(DeviceError, PipeStalled):
                self._pipes.send_request(ClassRequest.CANCEL, ptp_usb.pack_cancel(self._transaction), _REQUEST_S)
        self._interrupts.close()

    def _check_open(self) -> None:
        if self._interrupts.ended is not None:
            raise self._interrupts.ended
        if self._closed:
            raise camera_lost("it was closed")

    def _tidy_up(self, deadline: Deadline) -> None:
        """Reset a camera that is not ready; drop old data in its pipe."""
        if self._status() not in (None, Answer.OK):
            with contextlib.suppress(PipeStalled):
                self._pipes.send_request(ClassRequest.RESET, b"", _REQUEST_S)
            ready = deadline.within(_RESET_S)
            while self._status() not in (None, Answer.OK) and not ready.passed:
                ready.sleep(0.02)
            self._pipes.clear_halts()
        for _ in range(_MOST_LEFTOVERS):
            still_time(deadline)
            if not self._patiently(lambda: self._pipes.read(self._block, _EMPTY_S)):
                return
        raise broken("unrequested data without an end")

    def _status(self) -> int | None:
        """The code of its status; None if the camera does not support the request."""
        try:
            return ptp_usb.parse_status(self._pipes.class_request(ClassRequest.STATUS, 64, _REQUEST_S)).code
        except (PipeStalled, ProtocolError):
            return None

    def _send(self, data: bytes, deadline: Deadline) -> None:
        whole = len(data) % self._pipes.packet == 0
        while data:
            still_time(deadline)
            piece = data[:_BLOCK]
            data = data[self._patiently(lambda piece=piece: self._write(piece, deadline)) :]  # type: ignore[misc]
        if whole:
            self._write(b"", deadline)  # a full last packet does not end a transfer

    def _write(self, piece: bytes, deadline: Deadline) -> int:
        self._check_open()
        return self._pipes.write(piece, min(_SLICE_S if piece else _EMPTY_S, max(0.001, deadline.left_s())))

    def _patiently(self, work: Callable[[], Result]) -> Result:
        """Do ``work``; if the camera stalls, clear the halt and do it again."""
        try:
            return work()
        except PipeStalled:
            self._pipes.clear_halts()
            return work()

    def _answer(self, number: int, sink: Sink | None, most: int, deadline: Deadline) -> Reply:
        """Read containers until the response; the data phase, if any, goes to ``sink`` or is kept."""
        kept = bytearray()
        take: Sink = kept.extend if sink is None else sink
        had_data = False
        for _ in range(_MOST_ODD):
            start = self._begin(deadline)
            length, kind, _, transaction = ptp_usb.parse_header(start)
            rest = memoryview(start)[HEADER.size :]
            stale = transaction < number
            if kind == ptp_usb.DATA:
                if (had_data and not stale) or transaction > number:
                    raise broken(f"data of request {transaction} while request {number} was asked")
                had_data = had_data or not stale
                self._stream(length, rest, _nowhere if stale else take, most, deadline)
            elif kind == ptp_usb.RESPONSE:
                if length > len(rest):
                    raise broken(f"a response of {len(rest)} bytes instead of {length}")
                self._spare = bytes(rest[length:])
                if stale:
                    continue
                if transaction != number:
                    raise broken(f"the answer to request {transaction} while request {number} was asked")
                return Reply(int.from_bytes(start[6:8], "little"), ptp_usb.parse_parameters(rest[:length]), bytes(kept))
            else:
                raise broken(f"a container of kind {kind} instead of an answer")
        raise broken("answers to other requests, without an end")

    def _begin(self, deadline: Deadline) -> bytes:
        """The first bytes of the next container, its header among them."""
        start, self._spare = self._spare, b""
        empty = 0
        while len(start) < HEADER.size:
            count, late = self._read(self._first, deadline)
            if count == 0 and not late:
                empty += 1
                if empty > _MOST_ODD:
                    raise broken("nothing but empty packets")
            start += self._first[:count].tobytes()
        return start

    def _stream(self, length: int, start: memoryview, take: Sink, most: int, deadline: Deadline) -> None:
        """Pass ``length`` bytes on, -1: until a short packet, of which ``start`` has come already."""
        if length > most:
            raise broken(f"{length} bytes of data where at most {most} were expected")
        if length >= 0 and len(start) > length:
            start, self._spare = start[:length], bytes(start[length:])
        received = len(start)
        if received:
            take(start)
        packet = self._pipes.packet
        more = length < 0 and (received + HEADER.size) % packet == 0
        while more or received < length:
            buffer = self._buffer(len(self._block) if length < 0 else length - received)
            count, late = self._read(buffer, deadline)
            if length >= 0 and count > length - received:
                # Some cameras send the response directly after the data, in the same packet.
                self._spare = buffer[length - received : count].tobytes()
                count = length - received
            received += count
            if received > most:
                raise broken(f"{received} bytes of data where at most {most} were expected")
            if count:
                take(memoryview(buffer)[:count])
            if length < 0:
                more = late or count == len(buffer)
            elif received < length and not late and (count % packet or not count):
                raise broken(f"{received} bytes of data where {length} were announced")

    def _buffer(self, wanted: int) -> array[int]:
        """Room for ``wanted`` bytes, and for no packet more: what follows them is another container."""
        if wanted >= len(self._block):
            return self._block
        packets = -(-wanted // self._pipes.packet)
        return array("B", bytes(packets * self._pipes.packet))

    def _read(self, buffer: array[int], deadline: Deadline) -> tuple[int, bool]:
        """(bytes, whether the wait ended before the transfer did). Waits until something has come."""
        while True:
            still_time(deadline)
            self._check_open()
            wait_s = min(_SLICE_S, max(0.001, deadline.left_s()))
            began = time.monotonic()
            count = self._patiently(lambda wait_s=wait_s: self._pipes.read(buffer, wait_s))  # type: ignore[misc]
            late = time.monotonic() - began >= wait_s
            if count or not late:
                return count, late


def _nowhere(piece: memoryview) -> None:
    """Drops data of an earlier request."""
