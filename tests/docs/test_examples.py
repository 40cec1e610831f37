"""The scripts and the Python code of the documentation run, and write what they say."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from controller import api
from tests.docs.synthetic_data import write_all

ROOT = Path(__file__).parents[2]
SCRIPTS = sorted((ROOT / "docs" / "examples").glob("*.py"))
WRITTEN = {
    "calibrate_from_folder": ("show/gray-x-0.png", "show/phase-x-0.png", "calibration.npz"),
    "compared_method": (),
    "develop_and_merge": ("scene.exr",),
    "opencv_calibration": ("projector.png",),
    "read_dataset": ("dataset.png",),
    "another_norm": (),
    "own_matrices": ("frames.npz", "left.png"),
    "first-notebook": ("geometry.png", "object.glb", "projectors.png", "appearance.png", "frames/left.png"),
    "own-data": (),
}
"""What each writes into the folder in which it runs."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("examples")
    write_all(made)
    return made


def execute(script: Path, folder: Path) -> str:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg", "MPLCONFIGDIR": str(folder)}
    command = [sys.executable, "-W", "error", str(script)]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def code_of(page: Path) -> str:
    """All Python blocks of a page, one after the other, as a reader runs them."""
    return "\n".join(re.findall(r"^```python\n(.*?)^```", page.read_text("utf-8"), re.MULTILINE | re.DOTALL))


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_a_script_runs_and_writes_its_files(script: Path, folder: Path) -> None:
    for name in WRITTEN[script.stem]:
        (folder / name).unlink(missing_ok=True)
    execute(script, folder)
    assert [name for name in WRITTEN[script.stem] if not (folder / name).stat().st_size] == []


@pytest.mark.parametrize("page", ["tutorials/first-notebook.md", "how-to/own-data.md"])
def test_the_code_of_a_page_runs(page: str, folder: Path) -> None:
    code = code_of(ROOT / "docs" / page)
    assert "from controller import api" in code
    script = folder / f"{Path(page).stem}.py"
    script.write_text(code)
    execute(script, folder)
    assert [name for name in WRITTEN[script.stem] if not (folder / name).stat().st_size] == []


def test_every_script_is_shown_on_a_page() -> None:
    pages = "\n".join(page.read_text("utf-8") for page in (ROOT / "docs" / "how-to").glob("*.md"))
    assert [script.name for script in SCRIPTS if f"../examples/{script.name}" not in pages] == []


def test_the_bracket_is_merged_to_the_light_of_the_scene(folder: Path) -> None:
    execute(ROOT / "docs" / "examples" / "develop_and_merge.py", folder)
    y, x = np.mgrid[0:64, 0:96]
    found = api.develop(folder / "scene.exr").image
    inner = slice(4, -4), slice(4, -4)
    np.testing.assert_allclose(found[inner][..., 0], (0.5 + 4 * x / 96)[inner], rtol=0.02)
    np.testing.assert_allclose(found[inner][..., 1], (1 + 2 * y / 64)[inner], rtol=0.02)


def test_the_run_of_the_tutorial_is_read_whole_and_in_any_order(folder: Path) -> None:
    run = next((folder / "demo" / "first" / "stage" / "runs").iterdir())
    assert api.read_run(run).projectors == ("left", "right")
    assert api.read_run(run).grade == {"left": pytest.approx(1.2), "right": pytest.approx(1.2)}
    assert api.read_run(run).camera is None
    turned = api.read_run(run, ["right", "left"])
    straight = api.read_run(run)
    assert [pose.translation_m[0] for pose in turned.geometry.projectors] == [-0.1, 0.0]
    assert [pose.translation_m[0] for pose in api.read_run(run, ["right"]).geometry.projectors] == [-0.1]
    random = np.random.default_rng(1)
    frames = [random.random((*size, 3), np.float32) for size in straight.transport.sizes]
    np.testing.assert_allclose(
        turned.transport.forward(frames[::-1]), straight.transport.forward(frames), rtol=1e-5, atol=1e-6
    )
    for wrong, code in ((run.parent, "not-calibrated"), (folder / "gone", "not-calibrated")):
        with pytest.raises(api.VelaturaError) as error:
            api.read_run(wrong)
        assert error.value.code == code
    with pytest.raises(api.VelaturaError, match="no projector above"):
        api.read_run(run, ["above"])


def test_colmaps_pixels_lie_half_a_pixel_from_opencvs_as_the_page_says() -> None:
    parameters = [110.0, 108.0, 48.0, 36.0, -0.05, 0.01, 0.001, -0.002]  # fx, fy, cx, cy, k1, k2, p1, p2
    camera = pycolmap.Camera(model="OPENCV", width=96, height=72, params=parameters)
    points = np.random.default_rng(1).uniform((-0.3, -0.2, 0.8), (0.3, 0.2, 1.2), (20, 3))
    by_colmap = camera.img_from_cam(points)
    assert by_colmap is not None
    matrix = np.array([[110.0, 0, 48.0 - 0.5], [0, 108.0, 36.0 - 0.5], [0, 0, 1]])
    by_opencv, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(parameters[4:]))
    np.testing.assert_allclose(by_colmap - 0.5, by_opencv.reshape(-1, 2), atol=1e-6)
