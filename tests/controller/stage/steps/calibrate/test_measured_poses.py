"""Poses from stage.toml, used where the views of a calibration are joined."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from controller.core.arrays import FloatImage
from controller.stage.artefacts.geometry import read_geometry, read_geometry_figures, read_view_pose
from controller.stage.sessions.check import check_stage
from controller.stage.steps.calibrate.full import join_geometry
from hal.notices import Level
from tests.controller.config.test_stage_file import STAGE
from tests.controller.stage.sessions.test_views import Said
from tests.controller.stage.two_views import CAMERA, FOCAL_PX, NAMES, POSES, VIEWS, Points, write_two_views

LONGER = 1.5
"""The room's metres by those of the model."""


def grey(at: Points) -> FloatImage:
    return np.full(at.shape, 0.5, np.float32)


def table(name: str, wrong_m: float = 0.0) -> str:
    at = LONGER * -POSES[name].rotation.T @ POSES[name].shift_m + (wrong_m, 2.0, 0.0)
    return f"pose = {{ position_m = {at.tolist()}, sigma_m = 0.001 }}\n"


def stage_of(folder: Path, wrong_m: float = 0.0) -> Path:
    before, _, after = STAGE.replace("port =", 'profile = "optoma-later"\nport =').partition("[camera]")
    for name in NAMES:
        before = before.replace(
            f'name = "{name}"\n', f'name = "{name}"\n{table(name, wrong_m if name == "left" else 0)}'
        )
    rest = after[: after.index("[display]")].replace("focal_length_px = 5200", f"focal_length_px = {FOCAL_PX[CAMERA]}")
    cameras = "".join(f'[[cameras]]\nname = "{view}"{rest}{table(view)}\n' for view in VIEWS)
    (folder / "stage.toml").write_text(before + cameras + after[after.index("[display]") :])
    return folder


@pytest.mark.parametrize("wrong_m", [0.0, 0.2])
def test_poses_of_the_stage_file_give_all_views_their_size_unless_one_is_wrong(tmp_path: Path, wrong_m: float) -> None:
    checked, run, said = check_stage(stage_of(tmp_path, wrong_m)), tmp_path / "run", Said()
    write_two_views(run, grey)
    assert join_geometry(run, checked.poses, checked.prior, "auto", said)
    known = read_geometry_figures(run)["scale_known"]
    if wrong_m:
        assert not known
        assert "left does not stand as its pose" in said.warnings
        return
    assert known
    assert all(level is Level.INFO for _, level in said.sentences)
    for own, name in zip(read_geometry(run, NAMES).projectors, NAMES, strict=True):
        np.testing.assert_allclose(own.translation_m, LONGER * POSES[name].shift_m, atol=0.01)
    pose = read_view_pose(run / "views" / "side")
    assert pose is not None
    np.testing.assert_allclose(pose.shift_m, LONGER * POSES["side"].shift_m, atol=0.01)
