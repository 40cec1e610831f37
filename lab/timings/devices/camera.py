"""The camera driver: what a photograph costs beyond its exposure, how fast files come, the codec."""

from __future__ import annotations

import json
import os
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hal.codecs.ptp import ip as ptp_ip
from hal.codecs.ptp import usb as ptp_usb
from hal.codecs.ptp.values import parse_handles
from lab.emulated.usb.bus import environment
from lab.timings import Row, at_least, at_most, timed
from lab.timings.tools.synthetic import CAMERA

FLAVOURS = ("generic", "eos-new", "eos-old")
SMALL_FILE = 4096
PACKETS = 2000
BLOCK = 1 << 16


OVERHEAD_MS = 30.0
NETWORK_MB_S, USB_MB_S = 200.0, 50.0
HEADER_US, HANDLES_MS = 1.0, 0.1
MEMORY_MB = 16.0
"""A driver may need that much more for a large picture than for a small one."""


def measure(size: str) -> list[Row]:
    """Captures of a RAW file of the paper's camera and of a tiny one, the same bytes over a bare socket, the codec."""
    rows, columns = CAMERA["paper"]
    whole = rows * columns * 2 + 4096
    found = []
    with tempfile.TemporaryDirectory(dir="/tmp") as name:
        folder = Path(name)
        bare = _bare(folder, whole)
        for bus, goal in (("ptpip", NETWORK_MB_S), ("usb", USB_MB_S)):
            for flavour in FLAVOURS:
                small, large = _measured(bus, flavour, SMALL_FILE), _measured(bus, flavour, whole)
                transfer_s = max(large["median"] - small["median"], 1e-6)
                over = f"{bus}, {flavour}"
                found += [
                    at_most(f"{over}: overhead of a capture", 1000 * small["median"], OVERHEAD_MS, unit="ms",
                            how=f"a file of {SMALL_FILE} bytes, no exposure, fsynced; {small['words']}"),
                    at_least(f"{over}: download", whole / transfer_s / 1e6, goal, unit="MB/s",
                             how=f"{whole / 1e6:.1f} MB, the overhead taken off; {large['words']}"),
                    at_most(f"{over}: overhead, driver's processor time", 1000 * small["cpu"], OVERHEAD_MS, unit="ms",
                            how="all threads of its process, whatever else runs; median"),
                    at_least(f"{over}: download a second of the driver's processor",
                             whole / max(large["cpu"] - small["cpu"], 1e-6) / 1e6, goal, unit="MB/s",
                             how=f"{1000 * large['cpu']:.1f} ms for {whole / 1e6:.1f} MB, hashed and written"),
                    at_most(f"{over}: download by a bare socket and file", transfer_s / bare, None, unit="x",
                            how=f"the same bytes through one loopback connection, fsynced: {bare:.3f} s"),
                    at_most(f"{over}: memory for a picture", (large["peak"] - small["peak"]) / 1e6, MEMORY_MB,
                            unit="MB", how=f"peak of the driver's process: {large['peak'] / 1e6:.0f} MB"),
                ]  # fmt: skip
    return [*found, *_codec()]


def _measured(bus: str, flavour: str, size: int) -> dict[str, Any]:
    """Captures in a process of their own, so that memory is theirs and USB the emulated one."""
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        seen = environment(Path(folder)) if bus == "usb" else {}
        command = [sys.executable, "-m", "lab.timings.tools.camera_driver", bus, flavour, str(size), folder]
        done = subprocess.run(command, env={**os.environ, **seen}, stdout=subprocess.PIPE, check=True)
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def _bare(folder: Path, size: int) -> float:
    """Median seconds in which ``size`` bytes go through a loopback connection into a synced file."""
    data = memoryview(os.urandom(size))

    def transfer() -> None:
        with socket.create_server(("127.0.0.1", 0)) as server:
            sender = threading.Thread(target=_send, args=(server.getsockname(), data))
            sender.start()
            channel, _ = server.accept()
            with channel, (folder / "bare").open("wb") as file:
                while block := channel.recv(BLOCK):
                    file.write(block)
                file.flush()
                os.fsync(file.fileno())
            sender.join()

    return timed(transfer, repeats=7).median


def _send(address: tuple[str, int], data: memoryview) -> None:
    with socket.create_connection(address) as channel:
        channel.sendall(data)


def least_s(work: Callable[[], None]) -> float:
    """Processor time of this thread for ``work``, the least of five."""
    spent_s = []
    for _ in range(5):
        began_s = time.thread_time()
        work()
        spent_s.append(time.thread_time() - began_s)
    return min(spent_s)


def _codec() -> list[Row]:
    """Packing and parsing packets as they go over the wire, without a wire."""
    request, data = ptp_ip.Request(1, 0x1009, 7, (1, 2, 3)), ptp_ip.Data(7, bytes(BLOCK))
    header, container = ptp_ip.HEADER.pack(4096, 9), struct.pack("<IHHI", 1 << 20, 2, 0x1009, 7)
    handles = struct.pack("<I5000I", 5000, *range(5000))

    def exchange(packet: ptp_ip.Packet) -> None:
        for _ in range(PACKETS):
            packed = ptp_ip.pack(packet)
            length, kind = ptp_ip.parse_header(packed[:8])
            ptp_ip.parse(kind, packed[8 : 8 + length])

    def often(work: Callable[[bytes], object], data: bytes) -> Callable[[], None]:
        def repeated() -> None:
            for _ in range(PACKETS):
                work(data)

        return repeated

    network, usb, listing = (
        least_s(often(ptp_ip.parse_header, header)),
        least_s(often(ptp_usb.parse_header, container)),
        least_s(often(parse_handles, handles)),
    )
    control, bulk = timed(lambda: exchange(request)), timed(lambda: exchange(data), repeats=3)
    return [
        at_most("codec, a header of PTP/IP", 1e6 * network / PACKETS, HEADER_US, unit="us",
                how="processor time of its thread, best of 5"),
        at_most("codec, a header of PTP on USB", 1e6 * usb / PACKETS, HEADER_US, unit="us", how="the same"),
        at_most("codec, 5000 object handles", 1e3 * listing / PACKETS, HANDLES_MS, unit="ms", how="the same"),
        at_most("codec, a request", 1e6 * control.median / PACKETS, None, unit="us", how="packed and parsed"),
        at_least("codec, data", PACKETS * BLOCK / bulk.median / 1e6, None, unit="MB/s",
                 how=f"packed and parsed in packets of {BLOCK} bytes"),
    ]  # fmt: skip
