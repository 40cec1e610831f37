"""Computers with a network between them that delays, loses and cuts, all on this one: for root, on Linux.

Each has a network namespace with a TUN device, and a thread here carries their packets. So TCP sees real loss. The
kernel's own netem would do the same, where it is built in.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import heapq
import os
import random
import select
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

_TUNSETIFF: Final = 0x400454CA
_IFF_TUN, _IFF_NO_PI = 0x0001, 0x1000
_CLONE_NEWNET: Final = 0x40000000
_MTU: Final = 1400


class Network:
    """Computers "a", "b", ... at 10.77.0.1, .2, ...; ``delay_s`` plus or minus ``jitter_s``, ``loss`` 0..1.

    ``cut``: names that nothing reaches.
    """

    def __init__(self, count: int, tag: str) -> None:
        self.delay_s = self.jitter_s = self.loss = 0.0
        self.cut: set[str] = set()
        self.names = [chr(ord("a") + number) for number in range(count)]
        self._spaces = {name: f"{tag}{name}" for name in self.names}
        self._random = random.Random(7)
        self._devices: dict[str, int] = {}
        self._stop = threading.Event()

    def address(self, name: str) -> str:
        return f"10.77.0.{self.names.index(name) + 1}"

    def prefix(self, name: str) -> list[str]:
        """What a program on that computer is started with."""
        return ["ip", "netns", "exec", self._spaces[name]]

    def _open(self, name: str) -> int:
        """A TUN device in the namespace; this thread goes there and comes back."""
        libc = ctypes.CDLL(None, use_errno=True)
        spaces = Path("/proc/thread-self/ns/net"), Path("/run/netns", self._spaces[name])
        with spaces[0].open() as home, spaces[1].open() as there:
            if libc.setns(there.fileno(), _CLONE_NEWNET):
                raise OSError(ctypes.get_errno(), "setns")
            try:
                device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
                fcntl.ioctl(device, _TUNSETIFF, struct.pack("16sH22x", b"tun0", _IFF_TUN | _IFF_NO_PI))
            finally:
                libc.setns(home.fileno(), _CLONE_NEWNET)
        return device

    def _carry(self) -> None:
        owners = {device: name for name, device in self._devices.items()}
        places = {int(self.address(name).rsplit(".", 1)[1]): name for name in self.names}
        waiting: list[tuple[float, int, int, bytes]] = []
        number = 0
        while not self._stop.is_set():
            left_s = max(0.0, waiting[0][0] - time.monotonic()) if waiting else 0.1
            for device in select.select(list(owners), [], [], left_s)[0]:
                with contextlib.suppress(BlockingIOError):
                    packet = os.read(device, 2048)
                    goal = places.get(packet[19]) if packet[0] >> 4 == 4 else None
                    lost = self._random.random() < self.loss or {goal, owners[device]} & self.cut
                    if goal is not None and not lost:
                        number += 1
                        jitter_s = self._random.uniform(-self.jitter_s, self.jitter_s)
                        due_s = time.monotonic() + self.delay_s + jitter_s
                        heapq.heappush(waiting, (due_s, number, self._devices[goal], packet))
            while waiting and waiting[0][0] <= time.monotonic():
                _, _, device, packet = heapq.heappop(waiting)
                with contextlib.suppress(OSError):
                    os.write(device, packet)


@contextlib.contextmanager
def network(count: int, tag: str = "velatura") -> Iterator[Network]:
    """Make it, and take it away again. Raises OSError or subprocess.CalledProcessError where this is not allowed."""
    made = Network(count, tag)
    try:
        for name in made.names:
            subprocess.run(["ip", "netns", "add", made._spaces[name]], check=True)
            made._devices[name] = made._open(name)
            for words in (
                ["addr", "add", f"{made.address(name)}/24", "dev", "tun0"],
                ["link", "set", "tun0", "mtu", str(_MTU), "up"],
                ["link", "set", "lo", "up"],
            ):
                subprocess.run([*made.prefix(name), "ip", *words], check=True)
        carrier = threading.Thread(target=made._carry, daemon=True)
        carrier.start()
        try:
            yield made
        finally:
            # Before the devices are closed: their numbers are soon those of other files, which it would read.
            made._stop.set()
            carrier.join()
    finally:
        for device in made._devices.values():
            os.close(device)
        for space in made._spaces.values():
            subprocess.run(["ip", "netns", "del", space], check=False, stderr=subprocess.DEVNULL)
