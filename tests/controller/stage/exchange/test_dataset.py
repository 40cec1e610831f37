"""A run as a dataset: complete, checked, and readable without Velatura."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

from controller.core.errors import UsageError
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.photographs import BLACK
from controller.stage.artefacts.published import write_photograph
from controller.stage.services.export import export
from tests.docs.synthetic_data import CAMERA, write_full_run

ROOT = Path(__file__).parents[4]
SCRIPT = ROOT / "docs" / "examples" / "read_dataset.py"


@pytest.fixture(scope="module")
def packed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with ``dataset``, packed from ``run``."""
    folder = tmp_path_factory.mktemp("packed")
    write_full_run(folder / "run")
    write_photograph(folder / "run", StepKind.PHOTOGRAPH, "gold", np.full((*CAMERA, 3), 0.25, np.float32))
    (folder / "run" / "accounts.json").write_text('{"secret": 1}')
    result = export(run=folder / "run", kind="dataset", out=folder / "dataset", step=None)
    assert (result["photographs"], result["appearances"]) == (3, 1)
    return folder


def index_of(packed: Path) -> Any:
    return json.loads((packed / "dataset" / "index.json").read_text())


def plane(packed: Path, name: str, channels: str) -> Any:
    with OpenEXR.File(str(packed / "dataset" / name)) as file:
        return file.channels()[channels].pixels


def test_sha256sum_finds_every_file_and_none_changed(packed: Path) -> None:
    folder = packed / "dataset"
    done = subprocess.run(["sha256sum", "-c", "SHA256SUMS"], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    listed = {line.partition(": ")[0] for line in done.stdout.splitlines()}
    there = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    assert there - listed == {"SHA256SUMS"}


def test_photographs_are_there_as_taken_and_as_light(packed: Path) -> None:
    rows = index_of(packed)["photographs"]
    assert [(row["kind"], row["name"], row["projector"]) for row in rows] == [
        ("black", "black", None), ("light-left", "white-0", "left"), ("light-left", "white-1", "left"),
    ]  # fmt: skip
    originals = {taken.path.read_bytes() for taken in BLACK.read(packed / "run")}
    assert {(packed / "dataset" / rows[0]["original"]).read_bytes()} == originals
    first, second = (plane(packed, row["file"], "RGB").astype(np.float64) for row in rows[1:])
    inner = slice(4, -4), slice(4, -4)
    np.testing.assert_allclose(first[inner] / rows[1]["exposure_s"], second[inner] / rows[2]["exposure_s"], rtol=0.01)


def test_results_are_the_arrays_of_the_run(packed: Path) -> None:
    (row,) = index_of(packed)["appearances"]
    assert row["name"] == "gold"
    assert row["figures"]["exposure"] == 2.0
    np.testing.assert_array_equal(plane(packed, row["photograph"], "RGB"), np.full((*CAMERA, 3), 0.25))
    target = plane(packed, row["target"], "RGBA")
    np.testing.assert_array_equal(target[..., :3], np.full((*CAMERA, 3), 0.5))
    np.testing.assert_array_equal(target[..., 3] == 1, np.arange(CAMERA[0] * CAMERA[1]).reshape(CAMERA) % 3 > 0)
    assert set(row["frames"]) == {"left", "right"}


def test_only_measurements_of_the_stage_are_packed(packed: Path) -> None:
    names = {Path(name).name for name in index_of(packed)["calibration"]}
    assert {"geometry.npz", "geometry.json", "pixels-left.npz", "radiometry-right.npz", "verification.json"} <= names
    assert not [path for path in (packed / "dataset").rglob("*") if "accounts" in path.name]


def test_the_example_reads_it_without_velatura(packed: Path) -> None:
    hidden = "import runpy, sys; sys.modules.update(dict.fromkeys(('controller', 'hal', 'plugins')))"
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment |= {"MPLBACKEND": "Agg", "MPLCONFIGDIR": str(packed)}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", f"{hidden}; runpy.run_path({str(SCRIPT)!r})"],
        cwd=packed, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "3 photographs, 1 appearances" in done.stdout
    assert "67% of the target's pixels can be reached" in done.stdout
    assert (packed / "dataset.png").stat().st_size > 10_000


def test_a_changed_file_is_found_by_the_example(packed: Path, tmp_path: Path) -> None:
    export(run=packed / "run", kind="dataset", out=tmp_path / "dataset", step=None)
    with (tmp_path / "dataset" / "README.md").open("a") as file:
        file.write("x")
    done = subprocess.run([sys.executable, str(SCRIPT)], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "AssertionError: README.md" in done.stderr


def test_nothing_that_exists_is_overwritten(packed: Path) -> None:
    with pytest.raises(UsageError) as refused:
        export(run=packed / "run", kind="dataset", out=packed / "dataset", step=None)
    assert refused.value.code == "dataset-exists"
