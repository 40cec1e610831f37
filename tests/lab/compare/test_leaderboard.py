"""Results of a comparison on disk: its JSON file, its page and pictures; and what the command refuses."""

from __future__ import annotations

import json
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from controller.core.errors import UsageError
from controller.optics.solve.result.metrics import PixelSet
from controller.run.journal import Journal
from controller.run.progress import Silent
from controller.run.step_id import ShotId
from lab.compare.evaluation import Evaluation, Failure, Score
from lab.compare.leaderboard import as_content, save_pictures, strips, update_leaderboard, write_page
from lab.compare.metered_stage import calibration_effort
from lab.compare.service import compare
from lab.study.subject.subject import ReachableTarget
from tests.lab.study.array_stage import array_subject


def score(target: str, median: float) -> Score:
    sets = {"in_reach": PixelSet(median, 4 * median, 0.25), "lit": PixelSet(median + 1, 9.0, 0.1),
            "visible": PixelSet(None, None, 0.0)}  # fmt: skip
    return Score(target, 2.0, sets)


def row(method: str, judged: Evaluation, scene: str = "dark") -> dict[str, Any]:
    return {"scene": scene, "seed": 1, "method": method, "about": f"what {method} is", **as_content(judged)}


GOOD = Evaluation(30.0, 120, [score("grey", 1.0), score("photograph", 2.0)])
PARTLY = Evaluation(
    5.0, 12, [score("grey", 3.0), Score("photograph", 1.0, {}, failed=Failure("a-code", "It | broke."))]
)
BAD = Evaluation(1.0, 3, (), Failure("other-code", "It broke at once."))


def page(tmp_path: Path, rows: Sequence[dict[str, Any]]) -> str:
    content = update_leaderboard(tmp_path, "small", rows)
    about = {one["method"]: one["about"] for one in content["results"]}
    return write_page(tmp_path, content, about, {"dark": "a dark stage"}).read_text()


def test_the_page_shows_every_score_and_every_failure(tmp_path: Path) -> None:
    text = page(tmp_path, [row("good", GOOD), row("partly", PARTLY), row("bad", BAD)])
    assert "| grey | good | 1.00 / 4.0 | 2.00 / 9.0 |  | 25.0% |  | 30 + 2 |" in text
    assert "| photograph | partly | a-code: It \\| broke. |" in text
    assert "| photograph | bad | other-code: It broke at once. |" in text
    assert "| dark | 1 | good | 120 | 1.50 / 6.0 | 2.50 / 9.0 |  |  | 2 |" in text
    assert "| dark | 1 | partly | 12 | 3.00 / 12.0 | 4.00 / 9.0 |  |  | 1 |" in text
    assert "| dark | 1 | bad | 3 |  |  |  |  | none: other-code |" in text
    assert "- **partly**: what partly is." in text


def test_later_results_replace_earlier_ones_of_the_same_method_and_scene_alone(tmp_path: Path) -> None:
    page(tmp_path, [row("good", GOOD), row("good", GOOD, "room")])
    text = page(tmp_path, [row("good", BAD), row("more", GOOD)])
    kept = json.loads((tmp_path / "comparison.json").read_text())["results"]
    assert [(one["scene"], one["method"]) for one in kept] == [("dark", "good"), ("dark", "more"), ("room", "good")]
    assert kept[0]["failed"]["code"] == "other-code"
    assert text.index("## dark, seed 1") < text.index("## room, seed 1")
    assert kept[2]["targets"]["grey"]["pixels"]["in_reach"]["delta_e00_median"] == 1.0
    (tmp_path / "comparison.json").write_text("{}")
    with pytest.raises(UsageError) as caught:
        page(tmp_path, [row("good", GOOD)])
    assert caught.value.code == "benchmark-unreadable"


def test_pictures_of_all_methods_stand_side_by_side(tmp_path: Path) -> None:
    subject = array_subject(projectors=1)
    image = np.full((*subject.mask.shape, 3), 0.3, np.float32)
    targets = {"grey": ReachableTarget(image, subject.mask, 0.6)}
    for name in ("first", "second"):
        save_pictures(tmp_path, name, subject, targets, Evaluation(1.0, 1, [Score("grey", 1.0, {}, image)]))
    save_pictures(tmp_path, "third", subject, targets, BAD)
    results = [row(name, GOOD) for name in ("first", "second", "third")]
    strips(tmp_path / "out", results, lambda scene, seed: tmp_path)
    made = tmp_path / "out" / "pictures" / "dark-1-grey.webp"
    whole = cv2.imread(str(made))
    assert whole is not None
    # The target, the first and the second, one beside the other; the third has none.
    assert len(list(made.parent.iterdir())) == 1
    assert [int(whole[-5, x].mean()) < 250 for x in (200, 600, 1000)] == [True] * 3


def test_photographs_are_counted_by_what_they_were_for(tmp_path: Path) -> None:
    file = tmp_path / "shot"
    file.write_bytes(b"light")
    with Journal(tmp_path) as journal, journal.run("benchmark"):
        shots = [ShotId("flat", "1"), ShotId("study", "x"), ShotId("dots", "1", projector="b")]
        shots += [ShotId("capture", str(n), projector=name) for n, name in enumerate("aab")]
        for shot in shots:
            journal.record_shot(shot, {}, file)
        effort = calibration_effort(journal.shot_counts(), ["a", "b"], own=["study"], dots="dots")
    assert (effort.shared, list(effort.projectors), list(effort.dots)) == (1, [2, 1], [0, 1])


@pytest.mark.parametrize(
    ("methods", "scenes", "size", "code"),
    [
        (("nobody",), (), "small", "method-unknown"),
        ((), ("hall",), "small", "scene-unknown"),
        ((), (), "huge", "size-unknown"),
    ],
)
def test_wrong_names_are_refused_before_anything_is_written(
    tmp_path: Path, methods: tuple[str, ...], scenes: tuple[str, ...], size: str, code: str
) -> None:
    with pytest.raises(UsageError) as caught:
        compare(methods=methods, scene_names=scenes, size=size, out=tmp_path / "out", seeds=(1,),
                  reporter=Silent(), cancel=threading.Event())  # fmt: skip
    assert caught.value.code == code
    assert not (tmp_path / "out").exists()
