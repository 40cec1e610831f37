"""A kiosk's own photographs over months."""

from __future__ import annotations

import os
import time
from pathlib import Path

from controller.kiosk.store.disk_space import purge_old_photographs
from controller.kiosk.store.event_log import EventLog
from controller.run.journal import Journal
from controller.stage.artefacts.names import CAPTURES

DAY_S = 86400.0
FIRST_S = 1_800_000_000.0
NIGHT_BYTES = 1000


def night(stage: Path, at_s: float) -> None:
    run = stage / "runs" / time.strftime("%Y%m%d-%H%M%S-drift", time.gmtime(at_s))
    (run / CAPTURES).mkdir(parents=True)
    (run / CAPTURES / "one.dng").write_bytes(bytes(NIGHT_BYTES))
    with Journal(run) as journal, journal.run("drift"):
        pass
    os.utime(run / Journal.FILE, (at_s, at_s))


def photographs(stage: Path) -> list[Path]:
    return sorted(stage.glob(f"runs/*/{CAPTURES}/*"))


def test_nightly_photographs_take_no_more_room_after_a_month_than_after_a_fortnight(tmp_path: Path) -> None:
    log = EventLog(Path(":memory:"), durable=False)
    kept = []
    for day in range(30):
        now_s = FIRST_S + day * DAY_S
        night(tmp_path, now_s)
        purge_old_photographs(tmp_path, log, lambda now_s=now_s: now_s)  # type: ignore[misc]
        kept.append(len(photographs(tmp_path)))
    assert max(kept) == 14 == kept[-1]
    assert len(list((tmp_path / "runs").iterdir())) == 30
    assert {row.code for row in log.after(0)} == {"photographs-removed"}
    assert "0 MB" in log.after(0)[0].text


def test_what_can_not_be_removed_is_told_and_tried_again(tmp_path: Path) -> None:
    log = EventLog(Path(":memory:"), durable=False)
    for day in range(3):
        night(tmp_path, FIRST_S + day * DAY_S)
    run = sorted((tmp_path / "runs").iterdir())[0]
    (run / f"{CAPTURES}.going").write_text("a file that somebody put there")
    later_s = FIRST_S + 100 * DAY_S
    purge_old_photographs(tmp_path, log, lambda: later_s)
    assert log.after(0)[-1].code == "photographs-kept"
    (run / f"{CAPTURES}.going").unlink()
    purge_old_photographs(tmp_path, log, lambda: later_s)
    assert log.after(0)[-1].code == "photographs-removed"
    assert len(photographs(tmp_path)) == 2
