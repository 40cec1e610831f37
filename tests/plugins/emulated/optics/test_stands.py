"""Stages whose projectors stand where they are asked to, or are more or fewer than three."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from hal.deadline import in_seconds
from hal.errors import DeviceError, PluginError
from hal.registry import OpenContext
from plugins.emulated.bench import DRIVER
from plugins.emulated.core.truth import BenchTruth, read_truth

TABLE = """\
[[stands]]
name = "{name}"
position_m = [0.3, -0.4, -1.2]
rotation_vector = [0.1, -0.2, 0.0]
throw_ratio = 2.0
centre_share = [0.5, 1.05]
focus_m = 1.25
lumens = {lumens}
pupil_m = 0.03
"""


def prepared(tmp_path: Path, stage_name: str = "stage", size: str = "small", **settings: Any) -> BenchTruth:
    stage = tmp_path / stage_name
    stage.mkdir()
    bench = DRIVER.open(settings, OpenContext(stage=stage), in_seconds(5))
    bench.prepare(stage, size=size, object_file=None, seed=3)
    return read_truth(stage)


def test_six_projectors_stand_in_six_places_and_the_first_three_are_those_of_three(tmp_path: Path) -> None:
    three, six = prepared(tmp_path, "three"), prepared(tmp_path, "six", projectors=6)
    assert six.projectors[:3] == three.projectors
    assert len({projector.pose.position_m for projector in six.projectors}) == 6
    assert [projector.output for projector in six.projectors] == ["P1", "P2", "P3", "P4", "P5", "P6"]
    assert len({projector.port for projector in six.projectors}) == 6


def test_projectors_stand_at_places_that_are_named_in_that_order(tmp_path: Path) -> None:
    truth = prepared(tmp_path, projectors=["far-left", "left", "right"])
    assert [one.name for one in truth.projectors] == ["far-left", "left", "right"]
    across = [one.pose.position_m[0] for one in truth.projectors]
    assert across[0] < across[1] < 0 < across[2]


@pytest.mark.parametrize("names", [[], ["left", "left"], ["left", "behind"]])
def test_places_that_are_unknown_or_named_twice_are_refused(tmp_path: Path, names: list[str]) -> None:
    with pytest.raises(PluginError) as caught:
        prepared(tmp_path, projectors=names)
    assert caught.value.code == "setting-wrong"


def test_a_stage_of_modern_size_has_four_projectors_unless_told_otherwise(tmp_path: Path) -> None:
    four, two = prepared(tmp_path, "four", "uhd"), prepared(tmp_path, "two", "uhd", projectors=2)
    assert [projector.lens.size_px for projector in four.projectors] == [(3840, 2160)] * 4
    assert four.camera.lens.size_px == (8192, 5464)
    assert two.projectors == four.projectors[:2]


def test_a_projector_stands_and_shines_as_it_is_told(tmp_path: Path) -> None:
    file = tmp_path / "stands.toml"
    second = TABLE.format(name="two", lumens=4000.0) + "sharpest_px = 0.2\n"
    file.write_text(TABLE.format(name="one", lumens=2000.0) + second)
    one, two = prepared(tmp_path, stands=str(file)).projectors
    assert (one.name, one.pose.position_m, one.pose.rotation_vector) == ("one", (0.3, -0.4, -1.2), (0.1, -0.2, 0.0))
    assert (one.lens.focal_px, one.lens.centre_px) == (560.0, (139.5, 220.0))
    assert one.focus.distance_m == 1.25
    assert one.focus.sharpest_px == pytest.approx(0.32, abs=0.04)
    assert two.focus.sharpest_px == 0.2
    assert two.light.brightness == pytest.approx(2 * one.light.brightness)
    # 2000 lumens on a picture 0.625 m wide and three quarters as high
    assert one.light.brightness == pytest.approx(2000 / (0.625 * 0.46875) / 9000)


@pytest.mark.parametrize("settings", [{"projectors": 0}, {"projectors": 7}, {"projectors": True}, {"stands": "none"}])
def test_wrong_settings_are_refused_before_anything_is_written(tmp_path: Path, settings: dict[str, Any]) -> None:
    with pytest.raises(PluginError) as refused:
        prepared(tmp_path, **settings)
    assert refused.value.code == "setting-wrong"
    assert list((tmp_path / "stage").iterdir()) == []


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (TABLE.format(name="one", lumens=-1.0), "lumens"),
        (TABLE.format(name="one", lumens=1000.0).replace("pupil_m", "pupil"), "pupil"),
        (TABLE.format(name="one", lumens=1000.0) * 2, "one"),
    ],
)
def test_a_wrong_stand_is_named(tmp_path: Path, text: str, told: str) -> None:
    (tmp_path / "stands.toml").write_text(text)
    with pytest.raises(DeviceError, match=told):
        prepared(tmp_path, stands=str(tmp_path / "stands.toml"))


def test_light_between_surfaces_is_worked_out_by_the_engine_that_is_named(tmp_path: Path) -> None:
    usual, traced = (
        prepared(tmp_path, "usual", room="room"),
        prepared(tmp_path, "traced", room="room", engine="mitsuba"),
    )
    assert (usual.engine, traced.engine) == ("radiosity", "mitsuba")
    assert traced.surfaces == usual.surfaces
    with pytest.raises(PluginError) as refused:
        prepared(tmp_path, "wrong", engine="candle")
    assert refused.value.code == "setting-wrong"
    assert "mitsuba" in refused.value.remedy


def test_no_wall_hides_the_object_from_cameras_all_around_it(tmp_path: Path) -> None:
    before, around = (
        prepared(tmp_path, "two", room="room", cameras=2),
        prepared(tmp_path, "four", room="room", cameras=4),
    )
    assert [surface.name for surface in before.surfaces] == ["table", "wall"]
    assert [surface.name for surface in around.surfaces] == ["table"]
