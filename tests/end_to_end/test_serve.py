"""The kiosk's service as a process, on the emulated devices."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from controller.core.storage import runtime_folder
from controller.kiosk.api.control import call_kiosk
from controller.kiosk.panel_address import FIRST_LOGIN
from controller.stage.sessions.bench import BenchProcess
from lab.timings.devices.serve import NAME, install_grey, wait_for
from tests import waiting
from tests.end_to_end.program import REPOSITORY, Command, lamps, processes_on
from tests.ports import free_port

pytestmark = pytest.mark.timeout(300)


def test_boots_to_playing_survives_its_own_death_and_ends_with_cool_lamps(prepared: Path) -> None:
    install_grey(prepared)
    with BenchProcess(prepared, cancel=threading.Event()):
        with Command("kiosk", "serve", prepared, "--no-panel") as first:
            assert wait_for(prepared, "playing")["playing"] == NAME
            first.kill()
        assert all(lamps(prepared).values())
        with Command("kiosk", "serve", prepared, "--no-panel") as second:
            state = wait_for(prepared, "playing")
            assert [lamp["strikes"] for lamp in state["lamps"]] == [1, 1, 1]
            call_kiosk(prepared, "stop")
            wait_for(prepared, "off")
            assert not any(lamps(prepared).values())
            assert second.interrupt().code == 0
    assert processes_on(prepared) == []


@pytest.mark.parametrize("journalled", [True, False])
def test_the_first_password_is_never_printed_where_systemd_keeps_it(tmp_path: Path, journalled: bool) -> None:
    stage, printed = tmp_path / "stage", tmp_path / "printed"
    stage.mkdir()
    address = f"127.0.0.1:{free_port()}"
    command = [sys.executable, "-m", "controller", "kiosk", "serve", str(stage), "--setup", "--panel", address]
    with printed.open("wb") as out:
        told = os.fstat(out.fileno())
        # As systemd tells a service that its output goes to the journal (systemd.exec(5)).
        stream = f"{told.st_dev}:{told.st_ino}" if journalled else "1:1"
        environment = os.environ | {"JOURNAL_STREAM": stream, "COLUMNS": "200"}
        with subprocess.Popen(command, stdout=out, stderr=out, cwd=REPOSITORY, env=environment) as kiosk:
            kept = runtime_folder(stage) / FIRST_LOGIN
            try:
                said = kept.exists if journalled else lambda: "First login" in printed.read_text()
                waiting.wait_for(said, within_s=60)
            finally:
                kiosk.terminate()
    if journalled:
        account, password = kept.read_text().split()
        assert (account, len(password)) == ("technician", 19)
        assert kept.stat().st_mode & 0o777 == 0o600
        assert password not in printed.read_text()
        assert "First login" not in printed.read_text()
    else:
        assert not kept.exists()
