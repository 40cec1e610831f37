"""The driver made in docs/tutorials/first-driver.md works as it stands there."""

from __future__ import annotations

import re
import socketserver
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hal.conformance import ProjectorConformance
from hal.deadline import in_seconds
from hal.interfaces import Projector
from hal.registry import OpenContext, open_device
from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase, LampTiming

PAGE = Path(__file__).parents[2] / "docs" / "tutorials" / "first-driver.md"
TIMING = LampTiming(warm_up_s=0.1, cool_down_s=0.2)
POWER = {LampPhase.STANDBY: b"0", LampPhase.LIT: b"1", LampPhase.COOLING: b"2", LampPhase.WARMING: b"3"}


def code_of_the_page() -> str:
    return "\n".join(re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL))


class Acme(socketserver.StreamRequestHandler):
    """The projector of the page."""

    lamp: EmulatedLamp

    def handle(self) -> None:
        question = self.request.recv(64).removesuffix(b"\r")
        if question == b"OFF":
            self.lamp.extinguish()
        answers = {
            b"MODEL": b"A1",
            b"PWR": POWER[self.lamp.phase],
            b"ON": b"OK" if question == b"ON" and self.lamp.strike() else b"NO",
            b"OFF": b"OK",
        }
        self.wfile.write(question + b"=" + answers.get(question, b"?") + b"\r")


class TestTheDriverOfThePage(ProjectorConformance):
    poll_s = 0.05

    @pytest.fixture
    def projector(self) -> Iterator[Projector]:
        names: dict[str, Any] = {}
        exec(compile(code_of_the_page(), str(PAGE), "exec"), names)
        handler = type("Handler", (Acme,), {"lamp": EmulatedLamp(TIMING)})
        with socketserver.ThreadingTCPServer(("127.0.0.1", 0), handler) as server:
            threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()
            table = {"address": f"127.0.0.1:{server.server_address[1]}", "cool_down_s": 0.2}
            opened: Projector = open_device(names["DRIVER"], table, OpenContext(Path()), in_seconds(20))
            yield opened
            opened.close()
            server.shutdown()
