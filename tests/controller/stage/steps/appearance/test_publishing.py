"""Publishing: the same run gives the same bytes, and what was solved before on the calibration stays."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest

from controller.bundle.install import current
from controller.bundle.reader import Bundle
from controller.bundle.signing import ANY_SIGNER
from controller.core.errors import UsageError
from controller.run.journal import Journal
from controller.run.progress import Reporter, Silent
from controller.run.runner import Runner
from controller.stage.artefacts.solved import Solved
from controller.stage.steps.appearance.publishing import (
    LONGEST_PX,
    BundleTarget,
    created_unix_s,
    hints_ms,
    kept_names,
    publish_solved,
    publish_step,
    thumbnail,
)
from hal.deadline import in_seconds
from hal.notices import Level

OUTPUTS = {"left": ("P1", (10, 8)), "right": ("P2", (12, 9))}
NAMES = ("20260101-120000-calibrate", "20260102-120000-calibrate")


@pytest.fixture(autouse=True)
def _no_epoch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SOURCE_DATE_EPOCH", raising=False)


def solve(run: Path, name: str, value: int, seconds: float = 1.0) -> None:
    run.mkdir(parents=True, exist_ok=True)
    frames = {p: np.full((rows, columns, 3), value, np.uint8) for p, (_, (columns, rows)) in OUTPUTS.items()}
    figures: dict[str, object] = {"name": name, "exposure": 2.0, "title": name, "seconds": seconds}
    target, reachable = np.zeros((2, 2, 3), np.float32), np.ones((2, 2), np.bool_)
    linear = {projector: (frame / 255).astype(np.float32) for projector, frame in frames.items()}
    Solved(frames, linear, target, reachable, figures).write(run, name)


class Heard(Silent):
    """What was said, in a list."""

    def __init__(self) -> None:
        self.sentences: list[str] = []

    def say(self, text: str, level: Level = Level.INFO) -> None:
        self.sentences.append(text)


def publish(stage: Path, run: Path, *names: str, reporter: Reporter | None = None) -> Path:
    step = publish_step(BundleTarget(stage, "s", run.name, OUTPUTS, None), names)
    with Journal(run) as journal:
        Runner([step], journal, reporter=reporter or Silent()).run("appearance", deadline=in_seconds(60))
    found = current(stage / "bundles")
    assert found is not None
    return found


def held(file: Path) -> Mapping[str, int]:
    with Bundle.open_trusted(file, ANY_SIGNER) as bundle:
        bundle.verify()
        return {one.name: int(bundle.decode(one.name, "P1")[0, 0, 0]) for one in bundle.index.appearances}


def test_a_second_appearance_joins_the_first_and_a_new_solving_takes_its_place(tmp_path: Path) -> None:
    run = tmp_path / "runs" / NAMES[0]
    solve(run, "gold", 1)
    assert held(publish(tmp_path, run, "gold")) == {"gold": 1}
    solve(run, "marble", 2)
    assert held(publish(tmp_path, run, "marble")) == {"gold": 1, "marble": 2}
    solve(run, "gold", 3)
    assert held(publish(tmp_path, run, "gold")) == {"gold": 3, "marble": 2}
    solve(run, "tried", 4)
    assert kept_names(tmp_path, run, ["gold"]) == ("gold", "marble"), "what nobody names stays out"


def test_what_another_calibration_was_solved_on_is_not_kept(tmp_path: Path) -> None:
    first, second = (tmp_path / "runs" / name for name in NAMES)
    solve(first, "gold", 1)
    publish(tmp_path, first, "gold")
    solve(second, "marble", 2)
    heard = Heard()
    assert held(publish(tmp_path, second, "marble", reporter=heard)) == {"marble": 2}
    assert [sentence for sentence in heard.sentences if "no longer holds gold" in sentence]
    heard = Heard()
    publish(tmp_path, second, "marble", reporter=heard)
    assert not [sentence for sentence in heard.sentences if "no longer" in sentence]


def test_publishing_again_changes_nothing_and_a_change_raises_the_revision(tmp_path: Path) -> None:
    run = tmp_path / "runs" / NAMES[0]
    solve(run, "gold", 1)
    once = publish(tmp_path, run, "gold")
    data = once.read_bytes()
    solve(run, "gold", 1, seconds=99.0)
    again = publish(tmp_path, run, "gold")
    assert again == once
    assert again.read_bytes() == data
    solve(run, "gold", 2)
    with Bundle.open_trusted(publish(tmp_path, run, "gold"), ANY_SIGNER) as bundle:
        assert bundle.index.revision == 1
        assert [(h.appearance, h.fade_ms <= h.duration_ms) for h in bundle.index.schedule] == [("gold", True)]


def test_a_run_that_was_copied_publishes_the_same_bytes_elsewhere(tmp_path: Path) -> None:
    run = tmp_path / "one" / "runs" / NAMES[0]
    solve(run, "gold", 1)
    shutil.copytree(tmp_path / "one", tmp_path / "other")
    files = [publish(tmp_path / stage, tmp_path / stage / "runs" / NAMES[0], "gold") for stage in ("one", "other")]
    assert files[0].name == files[1].name
    assert files[0].read_bytes() == files[1].read_bytes()


def test_the_time_comes_from_the_calibration_or_is_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = (created_unix_s(tmp_path / name) for name in NAMES)
    assert second - first == 86400
    assert created_unix_s(tmp_path / "a-folder-that-was-renamed") == 0
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    assert created_unix_s(tmp_path / NAMES[0]) == 1_700_000_000


def test_what_is_not_solved_is_not_published(tmp_path: Path) -> None:
    run = tmp_path / "runs" / NAMES[0]
    solve(run, "gold", 1)
    with pytest.raises(Exception, match="has not been solved"):
        publish_solved(tmp_path / "b.vel", run, BundleTarget(tmp_path, "s", "c", OUTPUTS, None), ["silver"])
    assert not (tmp_path / "b.vel").exists()


def test_a_thumbnail_is_small_and_shows_the_picture(tmp_path: Path) -> None:
    picture = np.zeros((400, 600, 3), np.float32)
    picture[:, 300:] = 2.0
    picture[:200, :300] = [np.nan, 0, 0]
    small = thumbnail(picture, np.eye(3), white=2.0)
    assert small.shape == (107, LONGEST_PX, 3)
    assert (small[:, 85:] == 255).all()
    assert (small[:, :75] == 0).all()
    done, _ = cv2.imencode(".png", small)
    assert done


STAGE = """
[stage]
name = "s"
[[projectors]]
name = "left"
output = "P1"
driver = "serial"
[camera]
driver = "ptp"
iso = 100
[display]
driver = "player"
[[appearances]]
name = "gold"
kind = "gloss"
shown_s = 40
fade_s = 2.5
[[appearances]]
name = "brief"
kind = "gloss"
shown_s = 0.5
"""


def test_the_playlist_in_a_bundle_is_what_stage_toml_says(tmp_path: Path) -> None:
    (tmp_path / "stage.toml").write_text(STAGE)
    run = tmp_path / "runs" / NAMES[0]
    for value, name in enumerate(("gold", "brief", "else")):
        solve(run, name, value)
    with Bundle.open_trusted(publish(tmp_path, run, "gold", "brief", "else"), ANY_SIGNER) as bundle:
        suggested = [(hint.appearance, hint.duration_ms, hint.fade_ms) for hint in bundle.index.schedule]
    assert suggested == [("gold", 40_000, 2_500), ("brief", 500, 500), ("else", 15_000, 1_000)]


def test_a_fade_that_is_longer_than_its_picture_is_told_with_its_line(tmp_path: Path) -> None:
    (tmp_path / "stage.toml").write_text(STAGE.replace("shown_s = 40", "shown_s = 2"))
    with pytest.raises(UsageError, match=r"line 17.*'fade_s' = 2\.5 is longer than 'shown_s'") as caught:
        hints_ms(tmp_path)
    assert caught.value.code == "stage-key-value"
