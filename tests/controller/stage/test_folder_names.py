"""A stage's folder may have a name that is not UTF-8: what is written, shown and named after it."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from controller.core.storage import runtime_path
from controller.kiosk.store.event_log import EventLog
from controller.run.journal import Journal
from controller.stage.artefacts.names import safe_name
from controller.stage.report.pictures import read_picture
from hal.notices import Notice


@pytest.fixture(params=[b"st\xe4ge", b'it\'s "q" %s {x}\n$y', b"l" * 255], ids=["latin-1", "quotes", "long"])
def stage(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    folder = tmp_path / os.fsdecode(request.param)
    folder.mkdir()
    return folder


def test_a_picture_of_a_run_is_read_and_a_damaged_one_is_none(stage: Path) -> None:
    picture = np.full((4, 6, 3), (10, 20, 30), np.uint8)
    (stage / "map.png").write_bytes(cv2.imencode(".png", picture[..., ::-1])[1].tobytes())
    found = read_picture(stage / "map.png")
    assert found is not None
    np.testing.assert_array_equal(found, picture)
    (stage / "map.png").write_bytes(b"no picture")
    assert read_picture(stage / "map.png") is None
    assert read_picture(stage / "missing.png") is None


def test_a_stage_has_its_own_folder_for_sockets(stage: Path) -> None:
    assert runtime_path(stage) == runtime_path(stage)
    assert runtime_path(stage) != runtime_path(stage.parent)


def test_events_that_name_the_folder_are_kept(stage: Path) -> None:
    with Journal(stage) as journal, journal.run("calibrate"):
        journal.record("written", f"{stage} was written.")
        assert journal.events()[-1].text.endswith(" was written.")
    log = EventLog(stage / EventLog.FILE, durable=False)
    log.add(Notice.warning("running", f"{stage} runs."))
    log.close()
    assert EventLog(stage / EventLog.FILE, durable=False).after(0)[-1].text.endswith(" runs.")


def test_names_of_files_are_made_of_any_name(stage: Path) -> None:
    name = safe_name(stage.name)
    (stage / f"{name}.json").write_bytes(name.encode())
    assert len(name.encode()) <= 200
