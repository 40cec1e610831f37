"""``velatura camera`` and ``velatura export`` through the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import scipy.sparse
import trimesh

from controller.__main__ import run
from controller.core.arrays import save_arrays
from controller.optics.calibrate.geometry.lenses import find_corners
from controller.stage.artefacts.projectors import Light
from controller.stage.exchange.formats import FORMATS, Format
from tests.docs.synthetic_data import write_full_run, write_run


def answer(capsys: pytest.CaptureFixture[str]) -> dict[str, dict[str, object]]:
    found: dict[str, dict[str, object]] = json.loads(capsys.readouterr().out.splitlines()[-1])
    return found


def test_the_board_is_written_and_found_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["camera", "board", "--out", str(tmp_path / "board.png"), "--json"]) == 0
    assert answer(capsys)["result"]["width_px"] == 3300
    printed = cv2.imread(str(tmp_path / "board.png"), cv2.IMREAD_GRAYSCALE)
    assert printed is not None
    view = find_corners(np.asarray(cv2.resize(printed, (1100, 800), interpolation=cv2.INTER_AREA), np.uint8))
    assert view is not None
    assert len(view.board) == 70


def test_photographs_without_a_board_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((60, 80), np.uint8))
    arguments = ["camera", "calibrate", str(tmp_path / "a.png"), "--out", str(tmp_path / "lens.toml"), "--json"]
    assert run(arguments) == 1
    assert answer(capsys)["error"]["code"] == "camera-board-not-found"
    assert not (tmp_path / "lens.toml").exists()


def test_photographs_of_two_sizes_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [str(tmp_path / "wide.png"), str(tmp_path / "high.png")]
    for file, shape in zip(files, ((520, 776), (776, 520)), strict=True):
        cv2.imwrite(file, np.zeros(shape, np.uint8))
    assert run(["camera", "calibrate", *files, "--out", str(tmp_path / "lens.toml"), "--json"]) != 0
    assert answer(capsys)["error"]["code"] == "camera-photographs-differ"


def test_a_missing_photograph_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["camera", "calibrate", str(tmp_path / "no.jpg"), "--json"]) == 1
    assert answer(capsys)["error"]["code"] == "photograph-unreadable"


@pytest.fixture
def calibrated(tmp_path: Path) -> Path:
    """A run folder with the geometry of a wall 1 m away."""
    x, y = np.meshgrid(np.arange(30), np.arange(20))
    points = np.stack([(x - 15) / 100, (y - 10) / 100, np.ones_like(x)], axis=2).astype(np.float32)
    normals = np.broadcast_to(np.array([0, 0, -1], dtype=np.float32), points.shape)
    save_arrays(tmp_path / "geometry.npz", {"points_m": points, "normals": np.ascontiguousarray(normals)})
    pinhole = {
        "matrix": [[100.0, 0, 15], [0, 100.0, 10], [0, 0, 1]],
        "distortion": [0.0, 0.0],
        "rotation": np.eye(3).tolist(),
        "translation_m": [0.0, 0.0, 0.0],
        "size_px": [30, 20],
    }
    poses = {"camera": pinhole, "projectors": {"left": pinhole}, "reprojection_rms_px": 0.1, "scale_known": True}
    (tmp_path / "geometry.json").write_text(json.dumps(poses))
    white = np.full((20, 30, 3), 0.5, np.float32)
    Light(np.zeros((3, 256)), np.eye(3), white, 0 * white, np.eye(3)).write(tmp_path, "left")
    return tmp_path


@pytest.mark.parametrize(
    ("kind", "file"), [("glb", "object.glb"), ("ply", "object.ply"), ("blender", "blender/object.glb")]
)
def test_a_run_is_exported(calibrated: Path, kind: str, file: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["export", str(calibrated), "--format", kind, "--json"]) == 0
    assert answer(capsys)["result"]["triangles"] == 2 * 19 * 29
    read: Any = trimesh.load(calibrated / file, force="mesh")
    assert read.area == pytest.approx(0.29 * 0.19, rel=1e-4)
    assert (calibrated / "blender/scene.py").exists() == (kind == "blender")


@pytest.mark.parametrize("chosen", FORMATS, ids=lambda one: one.name)
def test_every_format_is_written_where_its_declaration_says(
    chosen: Format, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_full_run(tmp_path / "run")
    assert run(["export", str(tmp_path / "run"), "--format", chosen.name, "--json"]) == 0
    result = answer(capsys)["result"]
    assert result["written"] == str(tmp_path / "run" / chosen.place)
    assert len(result) > 1
    assert all(value for value in result.values())


def test_a_transport_is_cropped_by_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_run(tmp_path / "run")
    command = ["export", str(tmp_path / "run"), "--format", "transport", "--out", str(tmp_path / "t"), "--json"]
    assert run([*command, "--crop", "4,6,20,10"]) == 0
    assert scipy.sparse.load_npz(tmp_path / "t" / "left.npz").shape[0] == 3 * 20 * 10
    capsys.readouterr()
    for crop, code in (("4,6,20", "crop-wrong"), ("4,6,2000,10", "crop-outside")):
        assert run([*command, "--crop", crop]) == 2
        assert answer(capsys)["error"]["code"] == code


def test_wrong_formats_and_folders_are_refused(calibrated: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["export", str(calibrated), "--format", "fbx", "--json"]) == 2
    refused = answer(capsys)["error"]
    assert refused["code"] == "wrong-use"
    assert "'glb', 'ply'" in str(refused["what"])
    assert run(["export", str(calibrated / "no"), "--json"]) == 2
    assert answer(capsys)["error"]["code"] == "not-calibrated"
