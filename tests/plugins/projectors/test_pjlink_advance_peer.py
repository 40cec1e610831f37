"""Our PJLink driver against the emulator of ``pjlink-advance``, by other authors.

It needs Python 3.13 or later, so it runs in an interpreter of its own: the one that PJLINK_ADVANCE_PYTHON names, or a
python3.13 or later on the PATH, if it has the package (docs/how-to/emulated-devices.md). Where none is available,
``conftest.py`` leaves these tests out, and says so.
"""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from hal.conformance import ProjectorConformance
from hal.deadline import in_seconds
from hal.errors import DeviceError
from hal.interfaces import Projector
from hal.registry import OpenContext
from hal.values import Power
from plugins.emulated.projectors.lamp import LampTiming, quick_profile
from plugins.finding.network import PjLinkListener
from plugins.projectors.pjlink import open_pjlink_projector
from tests.plugins.projectors.pjlink_advance import NOTICE, pjlink_advance_python

SERVER = """
import asyncio, sys
from pjlink_advance.emulator import PJLinkEmulator

async def serve():
    async with PJLinkEmulator(password=sys.argv[1] or None, pj_class=2, transition_delay=1.0) as emulator:
        print(emulator.port, emulator.udp_port, flush=True)
        await asyncio.get_running_loop().run_in_executor(None, sys.stdin.read)

asyncio.run(serve())
"""
LAMP = LampTiming(warm_up_s=1.0, cool_down_s=1.0)


class Served:
    """The emulator in its own process, for as long as the context lasts."""

    def __init__(self, password: str) -> None:
        assert pjlink_advance_python(), NOTICE
        self._process = subprocess.Popen(
            [pjlink_advance_python(), "-c", SERVER, password], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert self._process.stdout is not None
        self.port, self.udp_port = map(int, self._process.stdout.readline().split())

    def end(self) -> None:
        self._process.communicate("")


@pytest.fixture
def served() -> Iterator[Served]:
    server = Served("secret")
    yield server
    server.end()


def opened(served: Served, folder: Path, password: str) -> Projector:
    (folder / "quick.toml").write_text(quick_profile(LAMP, base="pjlink"))
    table = {"address": f"127.0.0.1:{served.port}", "profile": "quick.toml", "password": password}
    return open_pjlink_projector(table, OpenContext(folder), in_seconds(20))


class TestPeer(ProjectorConformance):
    poll_s = 0.05

    @pytest.fixture
    def projector(self, served: Served, tmp_path: Path) -> Iterator[Projector]:
        driver = opened(served, tmp_path, "secret")
        yield driver
        driver.close()


def test_what_it_tells_of_itself_is_read(served: Served, tmp_path: Path) -> None:
    driver = opened(served, tmp_path, "secret")
    identity = driver.identity(deadline=in_seconds(20))
    assert (identity.maker, identity.model, identity.serial) == ("EPSON", "EB-L735U", "X8JK0000001")
    status = driver.status(deadline=in_seconds(20))
    assert (status.power, status.lamp_hours, status.faults) == (Power.OFF, 1200, ())
    driver.close()


def test_a_wrong_password_is_named(served: Served, tmp_path: Path) -> None:
    with pytest.raises(DeviceError) as caught:
        opened(served, tmp_path, "wrong")
    assert "password" in caught.value.what


def test_it_answers_our_search(served: Served) -> None:
    with PjLinkListener("127.0.0.1", 0) as listener:
        found = listener.search(deadline=in_seconds(20), to=("127.0.0.1", served.udp_port), patience_s=0.5)
    assert [(one.host, one.mac) for one in found] == [("127.0.0.1", "00:26:ab:00:00:01")]
