"""Events in systemd's journal, as its own daemon and `journalctl` see them."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from controller.kiosk.serving import journal_of
from controller.kiosk.state import EventRow
from controller.kiosk.store.event_log import EventLog
from hal.notices import Level, Notice

DAEMON = Path("/lib/systemd/systemd-journald")
TEXT = "The projector »left« is missing.\nPRIORITY=7"
STARTED = {"JOURNAL_STREAM": "8:1"}
SCRIPT = """
set -e
mount -t tmpfs tmpfs /run
mkdir -p /run/log/journal
"$1" & daemon=$!
for _ in $(seq 300); do test -S /run/systemd/journal/socket && break; sleep 0.02; done
JOURNAL_STREAM=8:1 "$2" -c 'from tests.controller.kiosk.store.test_journal import tell; tell()' "$3"
journalctl -D /run/log/journal --sync >/dev/null 2>&1 || true
for _ in $(seq 100); do
  journalctl -D /run/log/journal -o json --no-pager SYSLOG_IDENTIFIER=velatura > "$3/told"
  test "$(wc -l < "$3/told")" = 3 && break; sleep 0.05
done
kill $daemon
"""
"""In a /run of its own: the daemon of this computer, if there is one, hears nothing."""


def tell() -> None:
    log = EventLog(Path(sys.argv[1]) / "events.sqlite", also=journal_of("Head of a boy", os.environ))
    log.add(Notice("opened", "The stage opens."))
    log.add(Notice("sensor-dark", "The sensor sees nothing.", "Uncover it.", Level.WARNING))
    log.add_failure(Notice("projector-missing", TEXT, level=Level.ERROR))
    log.close()


@pytest.mark.skipif(
    not (DAEMON.exists() and shutil.which("unshare")) or os.geteuid() != 0, reason="needs systemd-journald and root"
)
def test_the_journal_has_each_event_with_its_code_stage_and_number(tmp_path: Path) -> None:
    command = ["unshare", "--mount", "bash", "-c", SCRIPT, "bash", str(DAEMON), sys.executable, str(tmp_path)]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=60, cwd=Path(__file__).parents[4], check=False
    )
    assert done.returncode == 0, done.stderr
    told = [json.loads(line) for line in (tmp_path / "told").read_text().splitlines()]
    keys = ("VELATURA_EVENT", "VELATURA_CODE", "PRIORITY", "MESSAGE", "VELATURA_STAGE")
    assert [tuple(row[key] for key in keys) for row in told] == [
        ("1", "opened", "6", "The stage opens.", "Head of a boy"),
        ("2", "sensor-dark", "4", "The sensor sees nothing. Uncover it.", "Head of a boy"),
        ("3", "projector-missing", "3", TEXT, "Head of a boy"),
    ]


def test_where_systemd_did_not_start_it_nothing_is_sent() -> None:
    assert journal_of("hall", {}) is None


def test_a_journal_that_is_gone_or_full_stops_nothing(tmp_path: Path) -> None:
    row = EventRow(1, 0.0, "info", "The stage opens.", "opened")
    gone = journal_of("hall", STARTED, str(tmp_path / "gone"))
    assert gone is not None
    gone(row)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as full:
        full.bind(str(tmp_path / "full"))
        send = journal_of("hall", STARTED, str(tmp_path / "full"))
        assert send is not None
        for _ in range(2000):
            send(row)
        assert b"The stage opens." in full.recv(4096)
