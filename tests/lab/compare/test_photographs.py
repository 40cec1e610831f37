"""Photographs of others as a stage: laid out as public data sets have them, seen by a camera that OpenCV makes here."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
import skimage.metrics
from typer.testing import CliRunner

from controller.__main__ import application
from controller.core.errors import UsageError, WorkError
from controller.run.progress import Silent
from hal.deadline import Cancelled
from lab.compare.entries import LEARNED, LEARNED_GROUP, Entry, entries
from lab.compare.learned import KnownPairs, Pairs, regression
from lab.compare.photographs import RESULTS, answered, compare_on_photographs, pair_folders

PROJECTOR, CAMERA = (96, 72), (128, 96)
TRAIN, TEST = 60, 8
Picture = npt.NDArray[np.uint8]


def scenery(seed: int) -> Picture:
    """Soft shapes over hard ones, in all colours."""
    rng = np.random.default_rng(seed)
    large, small = (rng.uniform(0, 255, (high, wide, 3)).astype(np.float32) for high, wide in ((4, 5), (18, 24)))
    soft = cv2.resize(large, PROJECTOR, interpolation=cv2.INTER_CUBIC)
    hard = cv2.resize(small, PROJECTOR, interpolation=cv2.INTER_NEAREST)
    return np.clip(127.5 + 1.5 * (0.5 * soft + 0.5 * hard - 127.5), 0, 255).astype(np.uint8)


def photographed(shown: Picture, seed: int) -> Picture:
    """On painted cloth, seen from aside, a little blurred, with noise."""
    corners = np.array([[14, 10], [112, 16], [108, 84], [18, 80]], np.float32)
    frame = np.array([[0, 0], [PROJECTOR[0], 0], PROJECTOR, [0, PROJECTOR[1]]], np.float32)
    light = cv2.warpPerspective((shown / np.float32(255)) ** 2.2, cv2.getPerspectiveTransform(frame, corners), CAMERA)
    cloth = cv2.resize(np.random.default_rng(3).uniform(0.35, 0.95, (6, 8, 3)).astype(np.float32), CAMERA)
    seen = cv2.GaussianBlur(cloth * (0.85 * light + 0.02), (0, 0), 0.6)
    seen = seen + np.random.default_rng(1000 + seed).normal(0, 0.003, seen.shape)
    return np.asarray(np.rint(255 * np.clip(seen, 0, 1) ** (1 / 2.2)), np.uint8)


def write(path: Path, picture: Picture) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), picture[..., ::-1])


@pytest.fixture
def setup(tmp_path: Path) -> Path:
    """One set-up of two that share their projected pictures, as CompenNet's data has it."""
    folder = tmp_path / "data" / "light1" / "pos1" / "cloth"
    for part, count, first in (("train", TRAIN, 0), ("test", TEST, 500)):
        for n in range(count):
            name = f"img_{n + 1:04d}.png"
            shown = scenery(first + n)
            write(tmp_path / "data" / part / name, shown)
            write(folder / "cam" / "raw" / part / name, photographed(shown, first + n))
    return folder


def refused(work: Callable[[], object]) -> UsageError:
    with pytest.raises(UsageError) as caught:
        work()
    return caught.value


def compared(folder: Path, out: Path, entered: Sequence[Entry] = LEARNED) -> dict[str, dict[str, object]]:
    compare_on_photographs(entered, folder, out, Silent(), threading.Event())
    content = json.loads((out / RESULTS).read_text())
    return {row["method"]: row for row in content["results"]}


def test_a_regression_learns_where_pixels_lie_and_what_paint_and_response_do(setup: Path, tmp_path: Path) -> None:
    found = compared(setup, tmp_path / "out")
    learned, plain = found["regression"], found["uncorrected"]
    assert float(str(learned["psnr_db"])) >= 20.0
    assert float(str(learned["ssim"])) >= 0.8
    assert float(str(learned["psnr_db"])) >= float(str(plain["psnr_db"])) + 8
    page = (tmp_path / "out" / "photographs.md").read_text()
    assert "| regression |" in page
    assert "(photographs.webp)" in page


def test_figures_are_those_of_other_programs() -> None:
    one, other = scenery(1), photographed(scenery(1), 1)
    small = np.asarray(cv2.resize(other, PROJECTOR), np.uint8)
    metrics: Any = skimage.metrics
    found = answered(small, one)
    assert found.psnr_db == pytest.approx(metrics.peak_signal_noise_ratio(one, small, data_range=255), abs=1e-3)
    same = metrics.structural_similarity(
        one / 255, small / 255, channel_axis=2, gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
        data_range=1.0,
    )  # fmt: skip
    assert found.ssim == pytest.approx(same, abs=0.01)


def test_pictures_of_the_setup_itself_come_before_shared_ones(setup: Path) -> None:
    for part, count in (("train", TRAIN), ("test", TEST)):
        for n in range(count):
            write(setup / "prj" / part / f"img_{n + 1:04d}.jpg", scenery(7))
    learn, judge = pair_folders(setup)
    assert learn.projected == setup / "prj" / "train"
    assert judge.projected == setup / "prj" / "test"


def test_a_method_of_others_is_entered_by_its_file(setup: Path, tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(
        "import numpy as np\n\n\ndef grey(pairs):\n"
        '    """Grey for everything."""\n'
        "    width, height = pairs.projector_px\n"
        "    return lambda wanted: np.full((height, width, 3), 128, np.uint8)\n"
    )
    arguments = ["compare", "--photographs", str(setup), "--method", f"{file}:grey", "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(application(), arguments)
    assert done.exit_code == 0, done.output
    (row,) = json.loads((tmp_path / "out" / RESULTS).read_text())["results"]
    assert row["about"] == "Grey for everything"
    assert row["failed"] is None


@pytest.mark.parametrize(
    ("answer", "code"),
    [
        (lambda wanted: wanted[:4], "benchmark-frames-wrong"),
        (lambda wanted: wanted.astype(np.float32), "benchmark-frames-wrong"),
        (lambda wanted: 1 // 0, "benchmark-method-failed"),
    ],
)
def test_a_method_that_fails_does_not_stop_the_others(
    setup: Path, tmp_path: Path, answer: Callable[[Picture], Picture], code: str
) -> None:
    def broken(pairs: Pairs) -> Callable[[Picture], Picture]:
        return answer

    found = compared(setup, tmp_path / "out", (Entry("broken", broken), *LEARNED[1:]))
    assert dict(found["broken"]["failed"])["code"] == code  # type: ignore[call-overload]
    assert found["uncorrected"]["failed"] is None


def test_what_does_not_belong_together_is_refused_by_name(setup: Path, tmp_path: Path) -> None:
    assert refused(lambda: pair_folders(tmp_path / "nothing")).code == "pairs-missing"
    seen = setup / "cam" / "raw" / "train"
    kept = (seen / "img_0007.png").read_bytes()
    (seen / "img_0007.png").unlink()
    error = refused(lambda: pair_folders(setup))
    assert error.code == "pairs-unequal"
    assert "img_0007" in error.what
    (seen / "img_0007.png").write_bytes(kept[:100])
    broken = refused(lambda: compared(setup, tmp_path / "out"))
    assert broken.code == "pairs-unreadable"
    assert "img_0007.png" in broken.what
    write(seen / "img_0007.png", scenery(1)[:40])
    odd = refused(lambda: compared(setup, tmp_path / "out"))
    assert odd.code == "pairs-unequal"


def test_pictures_that_have_nothing_to_do_with_the_photographs_are_refused() -> None:
    pairs = KnownPairs([(scenery(n), photographed(scenery(900 + n), n)) for n in range(40)])
    with pytest.raises(WorkError) as caught:
        regression(pairs)
    assert caught.value.code == "benchmark-pairs-unlike"


def test_it_can_be_stopped(setup: Path, tmp_path: Path) -> None:
    stop = threading.Event()
    stop.set()
    with pytest.raises(Cancelled):
        compare_on_photographs(LEARNED, setup, tmp_path / "out", Silent(), stop)


def test_names_are_those_of_learned_methods() -> None:
    assert [entry.name for entry in entries((), LEARNED, LEARNED_GROUP)] == ["regression", "uncorrected"]
    assert refused(lambda: entries(("paper",), LEARNED, LEARNED_GROUP)).code == "method-unknown"
