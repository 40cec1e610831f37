"""The camera driver: what a photograph costs beyond its exposure, and how fast files come over PTP/IP."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

from benchmarks import Row, at_least, at_most, peak_bytes, timed
from benchmarks._synthetic import CAMERA
from hal import ptp_ip
from hal.deadline import in_seconds
from hal.registry import OpenContext
from hal.values import ExposureSettings
from plugins.ptp_camera import open_camera

FLAVOURS = ("generic", "eos-new", "eos-old")
SMALL_FILE = 4096
EXPOSURE_S = 1 / 30
PACKETS = 2000
BLOCK = 1 << 16


def measure(size: str) -> list[Row]:
    """Captures of a RAW file of the paper's camera and of a tiny one, the same bytes over a bare socket, the codec."""
    rows, columns = CAMERA["paper"]
    whole = rows * columns * 2 + 4096
    found = []
    with tempfile.TemporaryDirectory() as folder:
        bare = _bare(Path(folder), whole)
        for flavour in FLAVOURS:
            small = _capture(Path(folder), SMALL_FILE, flavour)
            large = _capture(Path(folder), whole, flavour)
            transfer_s = max(large[1] - small[1], 1e-6)
            found += [
                at_most(f"{flavour}, overhead of a capture", 1000 * small[1], None, unit="ms",
                        how=f"a file of {SMALL_FILE} bytes, no exposure, fsynced; {small[0]}"),
                at_least(f"{flavour}, download", whole / transfer_s / 1e6, None, unit="MB/s",
                         how=f"{whole / 1e6:.1f} MB, the overhead taken off; {large[0]}"),
                at_most(f"{flavour}, download by a bare socket and file", transfer_s / bare, None, unit="x",
                        how=f"the same bytes through one loopback connection, fsynced: {bare:.3f} s"),
            ]  # fmt: skip
    found += _codec()
    return [*found, at_most("peak memory of the process", peak_bytes() / 1e6, None, unit="MB",
                            how="pictures are streamed to disk; the bare transfer streams too")]  # fmt: skip


@contextmanager
def _serving(size: int, flavour: str) -> Iterator[str]:
    command = [sys.executable, "-m", "benchmarks._camera", str(size), flavour]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield process.stdout.readline().strip()
        finally:
            process.terminate()


def _capture(folder: Path, size: int, flavour: str) -> tuple[str, float]:
    """Timings in words, and the median of seconds a capture."""
    with _serving(size, flavour) as address:
        camera = open_camera({"address": address}, OpenContext(folder), in_seconds(10))
        try:
            camera.configure(ExposureSettings(EXPOSURE_S, 100), deadline=in_seconds(10))
            number = count()

            def capture() -> None:
                for file in camera.capture(folder / f"{flavour}-{next(number)}", deadline=in_seconds(60)):
                    if file.size != size:
                        raise AssertionError(f"the camera sent {file.size} bytes instead of {size}")
                    file.path.unlink()

            timing = timed(capture, repeats=7)
        finally:
            camera.close()
    return str(timing), timing.median


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


def _codec() -> list[Row]:
    """Packing and parsing packets as they go over the wire, without a wire."""
    request, data = ptp_ip.Request(1, 0x1009, 7, (1, 2, 3)), ptp_ip.Data(7, bytes(BLOCK))

    def exchange(packet: ptp_ip.Packet) -> None:
        for _ in range(PACKETS):
            packed = ptp_ip.pack(packet)
            length, kind = ptp_ip.parse_header(packed[:8])
            ptp_ip.parse(kind, packed[8 : 8 + length])

    control, bulk = timed(lambda: exchange(request)), timed(lambda: exchange(data), repeats=3)
    return [
        at_most("codec, a request", 1e6 * control.median / PACKETS, None, unit="us", how="packed and parsed"),
        at_least("codec, data", PACKETS * BLOCK / bulk.median / 1e6, None, unit="MB/s",
                 how=f"packed and parsed in packets of {BLOCK} bytes"),
    ]  # fmt: skip
