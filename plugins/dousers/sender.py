"""Sends the levels of one universe by sACN (ANSI E1.31), as a process of its own: a busy controller never delays a
packet, and the stream is ended by its own packets when the controller dies.

It reads lines of JSON: first {"target": a ``Target``, "sequence": of the packet before}, then {"number": of the change,
"levels": {channel: level}}. It writes {"sent": number of the last change that was sent, "sequence": of the last packet,
"trouble": why packets do not go out, or ""}. It ends with its input.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import sys
import time
from typing import Any, Final

from sacn import DataPacket

from plugins.dousers.stream import Target

REPEATS: Final = 3
"""Packets of every change, and of the end (E1.31, 6.2.6 and 6.6.2)."""
REPEAT_S: Final = 0.03
KEEP_S: Final = 0.8
"""Time between packets without a change; receivers count a source as lost after 2.5 s."""
_HOPS: Final = 8
_LARGEST: Final = 1 << 16


class Sender:
    """One universe. ``change`` sets levels; ``send`` sends them once; all others are 0."""

    def __init__(self, target: Target, sequence: int) -> None:
        self.trouble = ""
        self._target = target
        self._packet = DataPacket(
            tuple(bytes.fromhex(target.identity)), "Velatura", target.universe, priority=target.priority,
            sequence=sequence,
        )  # fmt: skip
        self._socket: socket.socket | None = None
        self._well = 0

    @property
    def sequence(self) -> int:
        """Of the last packet, 0 to 255."""
        return int(self._packet.sequence)

    def change(self, levels: dict[int, int]) -> None:
        self._packet.dmxData = tuple(levels.get(channel, 0) for channel in range(1, 513))

    def send(self) -> None:
        """Send a packet. A node that refuses one says so when the next one is sent: two must go well in a row."""
        self._packet.sequence_increase()
        try:
            self._socket = self._socket or self._opened()
            self._socket.send(bytes(self._packet.getBytes()))
        except OSError as error:
            self._well, self.trouble = 0, error.strerror or str(error)
            self._close()
        else:
            self._well += 1
            if self._well > 1:
                self.trouble = ""

    def end(self) -> None:
        """Tell receivers that the stream ends, so that they need not wait until it counts as lost."""
        self._packet.option_StreamTerminated = True
        for _ in range(REPEATS):
            self.send()
        self._close()

    def _opened(self) -> socket.socket:
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            made.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, _HOPS)
            if self._target.interface:
                own = socket.inet_aton(self._target.interface)
                made.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, own)
            # Connected: only then does the system report a node that does not listen.
            host = self._packet.calculate_multicast_addr() if self._target.multicast else self._target.host
            made.connect((host, self._target.port))
        except OSError:
            made.close()
            raise
        return made

    def _close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def run(source: int, sink: int) -> None:
    """``source`` and ``sink``: file descriptors of what it reads and writes. Returns when ``source`` ends."""
    lines = _Lines(source)
    first = lines.next(None)
    if first is None:
        return
    sender = Sender(Target(**first["target"]), first["sequence"])
    number, repeats, due_s = 0, 0, float("inf")
    while (line := lines.next(max(0.0, due_s - time.monotonic()))) is not None:
        if line:
            number, repeats = int(line["number"]), REPEATS
            sender.change({int(channel): int(level) for channel, level in line["levels"].items()})
        sender.send()
        repeats = max(0, repeats - 1)
        due_s = time.monotonic() + (REPEAT_S if repeats else KEEP_S)
        if not repeats:
            said = {"sent": number, "sequence": sender.sequence, "trouble": sender.trouble}
            os.write(sink, (json.dumps(said) + "\n").encode())
    if number:
        sender.end()


class _Lines:
    """Lines of JSON from a file descriptor."""

    def __init__(self, source: int) -> None:
        self._source = source
        self._data = b""

    def next(self, within_s: float | None) -> dict[str, Any] | None:
        """The next one; {} if none comes in time (None: wait for it); None at the end."""
        while b"\n" not in self._data:
            patience_s = None if within_s is None or within_s == float("inf") else within_s
            if not select.select([self._source], [], [], patience_s)[0]:
                return {}
            got = os.read(self._source, _LARGEST)
            if not got:
                return None
            self._data += got
        line, _, self._data = self._data.partition(b"\n")
        read: dict[str, Any] = json.loads(line)
        return read


def main() -> int:
    # A terminal and systemd send these to every process; this one ends after its controller has had its last word.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    with contextlib.suppress(BrokenPipeError):
        run(sys.stdin.fileno(), sys.stdout.fileno())
    return 0


if __name__ == "__main__":
    sys.exit(main())
