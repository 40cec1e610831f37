from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from controller.stage.artefacts.projectors import Indirect, IndirectFigures, read_indirect, read_white_gain

NAMES = ("left", "right")


def write(run: Path, projector: str, median: float, p95: float) -> None:
    Indirect(np.full((2, 3, 3), median, np.float32), np.full((3, 256), 0.5), np.eye(3)).write(run, projector)
    IndirectFigures(median, p95, (0.01, 0.0, -0.01), 0.008).write(run, projector)


def test_what_was_measured_is_read_back(tmp_path: Path) -> None:
    for number, name in enumerate(NAMES):
        write(tmp_path, name, 0.25 * (1 + number), 0.75)
    found = read_indirect(tmp_path, NAMES)
    assert found is not None
    assert [float(one.share[0, 0, 0]) for one in found] == [0.25, 0.5]
    np.testing.assert_array_equal(found[0].radiometry.response, 0.5)
    assert IndirectFigures.read(tmp_path, "left") == IndirectFigures(0.25, 0.75, (0.01, 0.0, -0.01), 0.008)


@pytest.mark.parametrize(
    ("figures", "counts"),
    [
        (((0.004, 0.019), (0.004, 0.019)), False),
        (((0.004, 0.019), (0.006, 0.019)), True),
        (((0.0, 0.03), (0.0, 0.0)), True),
    ],
)
def test_a_stage_with_next_to_none_is_taken_as_one_without(
    tmp_path: Path, figures: tuple[tuple[float, float], ...], counts: bool
) -> None:
    for name, (median, p95) in zip(NAMES, figures, strict=True):
        write(tmp_path, name, median, p95)
    assert (read_indirect(tmp_path, NAMES) is not None) is counts


def test_runs_from_before_it_was_measured(tmp_path: Path) -> None:
    write(tmp_path, "left", 0.2, 0.4)
    assert read_indirect(tmp_path, NAMES) is None
    (file,) = tmp_path.glob("indirect-left.json")
    row = json.loads(file.read_text())
    del row["flicker"]
    file.write_text(json.dumps(row))
    assert IndirectFigures.read(tmp_path, "left") == IndirectFigures(0.2, 0.4, (0.01, 0.0, -0.01), 0.0)


def test_what_stripes_tell_is_kept(tmp_path: Path) -> None:
    stripes = np.random.default_rng(1).random((6, 12, 3)).astype(np.float32)
    share, response = np.zeros((2, 3, 3), np.float32), np.full((3, 256), 0.5)
    Indirect(share, response, np.eye(3), stripes=stripes).write(tmp_path, "left")
    found = Indirect.read(tmp_path, "left")
    np.testing.assert_array_equal(found.stripes, stripes)
    assert found.segment is None


def test_a_white_image_with_less_noise_is_kept(tmp_path: Path) -> None:
    gain = (1 + 0.02 * np.random.default_rng(2).standard_normal((2, 3, 3))).astype(np.float32)
    share, response = np.zeros((2, 3, 3), np.float32), np.full((3, 256), 0.5)
    Indirect(share, response, np.eye(3), white_gain=gain).write(tmp_path, "left")
    write(tmp_path, "right", 0.2, 0.4)
    kept = read_white_gain(tmp_path, "left")
    assert kept is not None
    np.testing.assert_allclose(kept, gain, atol=5e-4)
    assert read_white_gain(tmp_path, "right") is None
    assert read_white_gain(tmp_path, "above") is None
