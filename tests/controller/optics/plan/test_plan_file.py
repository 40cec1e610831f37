"""plan.toml: what is read from it, and how mistakes are reported."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from controller.core.errors import UsageError
from controller.optics.plan.plan_file import EXAMPLE, read_plan


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "plan.toml"
    path.write_text(text)
    return path


def test_the_example_is_a_plan_of_three_projectors_in_places_named_and_all_round(tmp_path: Path) -> None:
    tables = read_plan(written(tmp_path, EXAMPLE))
    assert [model.size_px for model in tables.models()] == [(1400, 1050)] * 3
    points = tables.mounting_points()
    assert points[0].name == "shelf"
    assert len({point.name for point in points}) == len(points) == 1 + 3 * 5 * 13
    away = np.linalg.norm([point.position_m for point in points[1:]], axis=1)
    np.testing.assert_allclose(np.unique(away.round(9)), (1.0, 1.25, 1.5))
    assert tables.goal.overlap == 2


@pytest.mark.parametrize(
    ("old", "new", "code", "told"),
    [
        ("lumens = 3000.0", "lumen = 3000.0", "plan-key-unknown", ("did you mean 'lumens'", "line 14")),
        ("lumens = 3000.0", "", "plan-key-missing", ("lumens",)),
        ("lumens = 3000.0", "lumens = -1.0", "plan-key-value", ("line 14", "lumens")),
        ("lumens = 3000.0", 'lumens = "bright"', "plan-key-type", ("line 14", "lumens")),
        ("throw_ratio = [1.6, 2.0]", "throw_ratio = [2.0, 1.6]", "plan-key-value", ("line 15", "throw_ratio")),
        ("above_degrees = [0.0, 40.0]", "above_degrees = [0.0, 95.0]", "plan-key-value", ("above_degrees",)),
        ("step_degrees = 10.0", "step_degrees = 0.5", "plan-key-value", ("too many positions",)),
        ("[goal]", "[goal", "plan-syntax", ("line",)),
        ("positions_m = [[0.0, -0.2, -1.5], [0.5, -0.2, -1.4], [-0.5, -0.2, -1.4]]", "positions_m = []",
         "plan-key-value", ("positions_m",)),
    ],
)  # fmt: skip
def test_a_mistake_is_told_with_its_line(tmp_path: Path, old: str, new: str, code: str, told: tuple[str, ...]) -> None:
    assert old in EXAMPLE
    with pytest.raises(UsageError) as refused:
        read_plan(written(tmp_path, EXAMPLE.replace(old, new)))
    assert refused.value.code == code
    assert all(word in str(refused.value) for word in told)


def test_a_plan_without_any_place_is_refused(tmp_path: Path) -> None:
    start = EXAMPLE.index("# Places that there are")
    with pytest.raises(UsageError) as refused:
        read_plan(written(tmp_path, EXAMPLE[:start]))
    assert refused.value.code == "plan-key-missing"
    assert "shell" in refused.value.remedy


def test_a_missing_plan_says_how_to_begin(tmp_path: Path) -> None:
    with pytest.raises(UsageError) as refused:
        read_plan(tmp_path / "none.toml")
    assert refused.value.code == "plan-missing"
    assert "--example" in refused.value.remedy
