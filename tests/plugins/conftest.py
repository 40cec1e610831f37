"""Emulated projectors with their drivers, on real ptys and sockets."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from hal.deadline import in_seconds
from hal.registry import OpenContext
from hal.tape import Tape
from hal.values import Power
from lab.emulated.projectors.boards import BOARDS, login_of
from lab.emulated.projectors.network import GATES, EmulatedNetworkProjector
from lab.emulated.projectors.pjlink import EmulatedPjLinkProjector
from lab.emulated.tape import Entry, read_tape
from plugins.emulated.projectors.lamp import EmulatedLamp, LampTiming, quick_profile
from plugins.emulated.projectors.serial import EmulatedSerialProjector
from plugins.projectors.network.driver import open_network_projector
from plugins.projectors.pjlink import PjLinkProjector, open_pjlink_projector
from plugins.projectors.profile_files import load_profile
from plugins.projectors.serial import SerialProjector, open_serial_projector
from tests.plugins.projectors.pjlink_advance import NOTICE, pjlink_advance_python
from tests.waiting import wait_for

SERIAL_CLIENTS = (
    "benqprojector and epson-projector are not installed: the emulated serial projectors were not driven by them "
    "(pip install benqprojector epson-projector)."
)
NOTICES = {
    "projectors/test_pjlink_advance_peer.py": "" if pjlink_advance_python() else NOTICE,
    "emulated/projectors/test_serial_clients.py": (
        "" if find_spec("benqprojector") and find_spec("epson_projector") else SERIAL_CLIENTS
    ),
}
collect_ignore = [file for file, notice in NOTICES.items() if notice]


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    for file in collect_ignore:
        terminalreporter.write_line(NOTICES[file])


LAMP = LampTiming(warm_up_s=0.25, cool_down_s=0.4)


@dataclass(frozen=True)
class SerialPair:
    """A driver and the emulated projector at the other end of its line."""

    driver: SerialProjector
    emulator: EmulatedSerialProjector
    stage: Path

    def said(self) -> list[Entry]:
        """All that driver and projector have said to each other."""
        return [entry for path in self.stage.glob("*.tape") for track in read_tape(path) for entry in track.entries]


@dataclass(frozen=True)
class NetworkPair:
    """A driver and the emulated projector at the other end of its network."""

    driver: SerialProjector
    emulator: EmulatedNetworkProjector
    stage: Path


@dataclass(frozen=True)
class PjLinkPair:
    driver: PjLinkProjector
    emulator: EmulatedPjLinkProjector
    stage: Path


def hasty(text: str) -> str:
    """The profile of a projector that loses patience sooner, for tests in which answers do not come."""
    times = {"answer_s": (2.0, 0.4), "late_s": (3.0, 0.8), "command_s": (3.0, 0.8), "confirm_s": (15.0, 5.0)}
    for key, (slow_s, quick_s) in times.items():
        text = text.replace(f"{key} = {slow_s}", f"{key} = {quick_s}")
    return text


def wait_for_power(driver: SerialProjector, power: Power) -> None:
    wait_for(lambda: driver.status(deadline=in_seconds(30)).power is power)


def each(names: Iterable[str], work: Callable[[str], object]) -> None:
    """Do ``work`` for each of them side by side, because most of it is waiting."""
    with ThreadPoolExecutor(16) as pool:
        for name, outcome in [(name, pool.submit(work, name)) for name in names]:
            try:
                outcome.result()
            except BaseException as error:
                error.add_note(f"for {name}")
                raise


OpenSerial = Callable[..., SerialPair]
OpenNetwork = Callable[..., "NetworkPair"]
OpenPjLink = Callable[..., PjLinkPair]


@pytest.fixture
def taped(tmp_path: Path) -> Iterator[Callable[[str], OpenContext]]:
    """Makes contexts in which drivers are recorded, each on a tape of this name."""
    with contextlib.ExitStack() as tapes:

        def context(name: str) -> OpenContext:
            return OpenContext(tmp_path, tape=tapes.enter_context(contextlib.closing(Tape(tmp_path / f"{name}.tape"))))

        yield context


@pytest.fixture
def open_serial(tmp_path: Path, taped: Callable[[str], OpenContext]) -> Iterator[OpenSerial]:
    """Start an emulated projector on a pty and open its driver; keyword arguments go to the emulator.

    ``profile`` is a shipped one, ``edit`` changes its text, ``timing`` is its lamp's; ``board`` makes another board
    than the profile's; ``name`` distinguishes several.
    """
    opened: list[SerialPair] = []

    def make(*, settings: dict[str, Any] | None = None, **kwargs: Any) -> SerialPair:
        timing = kwargs.pop("timing", LAMP)
        lamp = kwargs.pop("lamp", None) or EmulatedLamp(timing)
        profile = kwargs.pop("profile", "optoma-later")
        edit = kwargs.pop("edit", lambda text: text)
        name = kwargs.pop("name", "left")
        board = kwargs.pop("board", None) or BOARDS.get(profile)
        if board is None:
            raise LookupError(f"no emulated board for {profile}: add it to lab/emulated/projectors/boards.py")
        (tmp_path / f"{name}.toml").write_text(edit(quick_profile(timing, base=profile)))
        table_read = load_profile(f"{name}.toml", tmp_path).serial
        assert table_read is not None
        emulator = EmulatedSerialProjector(
            tmp_path / "run" / f"tty-{name}", lamp, board(lamp), baud=table_read.baud, **kwargs
        )
        emulator.start()
        table = {"profile": f"{name}.toml", "port": f"run/tty-{name}", **(settings or {})}
        context = taped(f"{name}-{len(opened)}")
        pair = SerialPair(open_serial_projector(table, context, in_seconds(20)), emulator, tmp_path)
        opened.append(pair)
        return pair

    yield make
    for pair in opened:
        pair.driver.close()
        pair.emulator.stop()


@pytest.fixture
def open_network(tmp_path: Path, taped: Callable[[str], OpenContext]) -> Iterator[OpenNetwork]:
    """Start an emulated projector on its own LAN port and open its driver; other keyword arguments go to the emulator.

    ``profile``, ``edit``, ``timing``, ``board`` and ``name`` as in ``open_serial``; ``gate``: another login than the
    profile's.
    """
    opened: list[NetworkPair] = []

    def make(*, settings: dict[str, Any] | None = None, **kwargs: Any) -> NetworkPair:
        timing = kwargs.pop("timing", LAMP)
        lamp = kwargs.pop("lamp", None) or EmulatedLamp(timing)
        profile = kwargs.pop("profile", "panasonic-dz")
        edit = kwargs.pop("edit", lambda text: text)
        name = kwargs.pop("name", "left")
        board = (kwargs.pop("board", None) or BOARDS[profile])(lamp)
        gate = kwargs.pop("gate", None) or GATES[login_of(profile)]
        (tmp_path / f"{name}.toml").write_text(edit(quick_profile(timing, base=profile)))
        emulator = EmulatedNetworkProjector(lamp, board, gate=gate, **kwargs)
        emulator.start()
        table = {"profile": f"{name}.toml", "address": emulator.address, **(settings or {})}
        context = taped(f"{name}-{len(opened)}")
        try:
            driver = open_network_projector(table, context, in_seconds(20))
        except BaseException:
            emulator.stop()
            raise
        opened.append(NetworkPair(driver, emulator, tmp_path))
        return opened[-1]

    yield make
    for pair in opened:
        pair.driver.close()
        pair.emulator.stop()


@pytest.fixture
def open_pjlink(tmp_path: Path) -> Iterator[OpenPjLink]:
    """Start an emulated projector on TCP and open its driver; keyword arguments go to the emulator."""
    opened: list[PjLinkPair] = []

    def make(*, settings: dict[str, Any] | None = None, **kwargs: Any) -> PjLinkPair:
        edit = kwargs.pop("edit", lambda text: text)
        emulator = EmulatedPjLinkProjector(kwargs.pop("lamp", None) or EmulatedLamp(LAMP), **kwargs)
        emulator.start()
        (tmp_path / "quick.toml").write_text(edit(quick_profile(LAMP, base="pjlink")))
        table = {"address": emulator.address, "profile": "quick.toml", **(settings or {})}
        try:
            driver = open_pjlink_projector(table, OpenContext(tmp_path), in_seconds(20))
        except BaseException:
            emulator.stop()
            raise
        opened.append(PjLinkPair(driver, emulator, tmp_path))
        return opened[-1]

    yield make
    for pair in opened:
        pair.driver.close()
        pair.emulator.stop()
