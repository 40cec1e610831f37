"""The kiosk's service as a process, on the emulated devices."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from benchmarks.serve import NAME, install_grey, wait_for
from controller.kiosk.api.control import ask
from controller.stage.bench import BenchProcess
from tests.end_to_end.program import Command, lamps, processes_on

pytestmark = pytest.mark.timeout(300)


def test_boots_to_playing_survives_its_own_death_and_ends_with_cool_lamps(prepared: Path) -> None:
    install_grey(prepared)
    with BenchProcess(prepared, cancel=threading.Event()):
        with Command("serve", prepared, "--no-panel") as first:
            assert wait_for(prepared, "playing")["playing"] == NAME
            first.kill()
        assert all(lamps(prepared).values())
        with Command("serve", prepared, "--no-panel") as second:
            state = wait_for(prepared, "playing")
            assert [lamp["strikes"] for lamp in state["lamps"]] == [1, 1, 1]
            ask(prepared, "stop")
            wait_for(prepared, "off")
            assert not any(lamps(prepared).values())
            assert second.interrupt().code == 0
    assert processes_on(prepared) == []
