"""How long a projector's answers take: our drivers against emulated projectors on real ttys and sockets."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from hal.codecs.projectors import pjlink
from hal.codecs.projectors.serial_protocol import query_bytes
from hal.deadline import in_seconds
from hal.interfaces import Projector
from hal.registry import OpenContext
from lab.emulated.projectors.pjlink import EmulatedPjLinkProjector
from lab.timings import Row, Timing, at_most, timed
from plugins.emulated.projectors.lamp import EmulatedLamp, LampTiming
from plugins.emulated.projectors.serial import EmulatedSerialProjector
from plugins.projectors.pjlink import open_pjlink_projector
from plugins.projectors.profile_files import load_profile
from plugins.projectors.serial import open_serial_projector

TIMING = LampTiming(warm_up_s=0.2, cool_down_s=0.2)
SERIAL = "optoma-later"
EXCHANGES = 1000


def measure(size: str) -> list[Row]:
    """Status over a serial line and over PJLink, and the codecs alone. Driver and emulator share this process."""
    with tempfile.TemporaryDirectory() as folder:
        return [*_serial(Path(folder)), *_pjlink(Path(folder)), *_codecs()]


def _serial(folder: Path) -> list[Row]:
    port = folder / "tty"
    with EmulatedSerialProjector(port, EmulatedLamp(TIMING)):
        driver = open_serial_projector({"profile": SERIAL, "port": str(port)}, OpenContext(folder), in_seconds(5))
        try:
            return _asked("serial", driver, "the profile's pauses between commands are in it")
        finally:
            driver.close()


def _pjlink(folder: Path) -> list[Row]:
    with EmulatedPjLinkProjector(EmulatedLamp(TIMING), password="secret") as emulator:  # noqa: S106 - its own
        settings = {"address": emulator.address, "password": "secret"}
        driver = open_pjlink_projector(settings, OpenContext(folder), in_seconds(5))
        try:
            return _asked("PJLink", driver, "with a password, on the loopback interface")
        finally:
            driver.close()


def _asked(kind: str, driver: Projector, how: str) -> list[Row]:
    status = timed(lambda: driver.status(deadline=in_seconds(20)), repeats=7)
    identity = timed(lambda: driver.identity(deadline=in_seconds(20)), repeats=5)
    return [_row(f"{kind}, status", status, how), _row(f"{kind}, identity", identity, how)]


def _row(figure: str, timing: Timing, how: str) -> Row:
    return at_most(figure, 1000 * timing.median, None, unit="ms", how=f"{timing}; {how}")


def _codecs() -> list[Row]:
    table = load_profile(SERIAL, Path()).serial
    assert table is not None
    name, query = next(iter(table.queries.items()))
    return [
        _codec(f"serial codec, a question ({name})", lambda: query_bytes(table, query, table.address)),
        _codec("PJLink codec, command and answer", _pjlink_exchange),
    ]


def _pjlink_exchange() -> None:
    pjlink.command("POWR")
    pjlink.parse_power(str(pjlink.parse_answer(b"%1POWR=1\r", "POWR")))


def _codec(figure: str, work: Callable[[], object]) -> Row:
    work()
    began = time.perf_counter()
    for _ in range(EXCHANGES):
        work()
    each = (time.perf_counter() - began) / EXCHANGES
    return at_most(figure, 1e6 * each, None, unit="us", how=f"mean of {EXCHANGES}")
