"""The dashboard, judged by Grafana's own schema: the types of ``@grafana/schema``, checked by TypeScript.

Grafana itself is in no registry that the tests install from, so no server loads the file here.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.npm import PACKAGES, needs_npm, run_node

pytestmark = needs_npm
DASHBOARD = Path(__file__).parents[4] / "docs" / "examples" / "monitoring" / "dashboard.json"
PANELS = PACKAGES / "@grafana" / "schema" / "dist" / "types" / "raw" / "composable"
WRONG: dict[str, Callable[[dict[str, Any]], object]] = {
    "word": lambda dashboard: dashboard.update(refreshes="10s"),
    "type": lambda dashboard: dashboard.update(version="1"),
    "missing": lambda dashboard: dashboard["panels"][2].pop("type"),
    "place": lambda dashboard: dashboard["panels"][0]["gridPos"].pop("w"),
    "field": lambda dashboard: dashboard["panels"][3]["fieldConfig"]["defaults"].update(decimals="two"),
    "variable": lambda dashboard: dashboard["templating"]["list"][1].update(multi=1),
    "values": lambda dashboard: dashboard["templating"]["list"][1].update(refresh="often"),
}


def dashboard() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(DASHBOARD.read_text())
    return found


@pytest.fixture(scope="module")
def refused(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """The names of the files that TypeScript refuses; one run for all, since starting takes the time."""
    folder = tmp_path_factory.mktemp("dashboards")
    (folder / "node_modules").symlink_to(PACKAGES)
    models = {"ours": dashboard()}
    for name, spoil in WRONG.items():
        models[name] = dashboard()
        spoil(models[name])
    for name, model in models.items():
        text = (
            f'import type {{ Dashboard }} from "@grafana/schema";\nexport const one: Dashboard = {json.dumps(model)};\n'
        )
        (folder / f"{name}.ts").write_text(text)
    told = run_node(
        PACKAGES / "typescript" / "bin" / "tsc", "--noEmit", "--strict", "--skipLibCheck", "--pretty", "false",
        "--module", "esnext", "--moduleResolution", "bundler", *(f"{name}.ts" for name in models),
        folder=folder, check=False,
    )  # fmt: skip
    return set(re.findall(r"^(\w+)\.ts\(\d+,\d+\): error TS", told, re.MULTILINE))


def test_the_dashboard_is_one_by_grafanas_own_types(refused: set[str]) -> None:
    assert "ours" not in refused


@pytest.mark.parametrize("name", WRONG)
def test_a_dashboard_with_a_fault_is_refused(refused: set[str], name: str) -> None:
    assert name in refused


def test_every_panel_is_of_a_kind_that_grafana_brings_and_none_covers_another() -> None:
    known = {folder.name for folder in PANELS.iterdir()}
    taken: set[tuple[int, int]] = set()
    for panel in dashboard()["panels"]:
        assert panel["type"].replace("-", "") in known, panel["title"]
        place = panel["gridPos"]
        assert place["x"] + place["w"] <= 24, "the grid has 24 columns"
        cells = {(place["x"] + x, place["y"] + y) for x in range(place["w"]) for y in range(place["h"])}
        assert not cells & taken, panel["title"]
        taken |= cells
