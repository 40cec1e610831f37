"""``velatura appearance --scheduler``: real workers, one of which dies, and the same bundle as without them."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from controller.bundle.reader import Bundle
from tests.controller.stage.cluster.machines import machines
from tests.end_to_end.conftest import FinishedDemo
from tests.end_to_end.kiosk import copied
from tests.end_to_end.program import Command, velatura

pytestmark = [pytest.mark.long, pytest.mark.timeout(900)]
TINTS = {"warm": [0.9, 0.6, 0.4], "cold": [0.4, 0.6, 0.9]}


def with_tints(finished_demo: FinishedDemo, to: Path) -> Path:
    stage = copied(finished_demo.stage, to)
    toml = stage / "stage.toml"
    tables = (f'[[appearances]]\nname = "{name}"\nkind = "recolour"\ntint = {tint}\n' for name, tint in TINTS.items())
    toml.write_text("\n".join((toml.read_text(), *tables)))
    return stage


def frames(stage: Path) -> dict[str, np.ndarray[tuple[int, ...], np.dtype[np.uint8]]]:
    keys = tomllib.loads((stage / "stage.toml").read_text())["bundle"]["trusted_keys"]
    with Bundle.open(stage / "bundles" / "current", trusted=[bytes.fromhex(key) for key in keys]) as bundle:
        return {f"{name} {output}": bundle.decode(name, output) for name in TINTS for output in ("P1", "P2", "P3")}


def test_a_worker_dies_and_the_bundle_is_the_same_as_from_this_machine_alone(
    finished_demo: FinishedDemo, tmp_path: Path
) -> None:
    alone, spread = (with_tints(finished_demo, tmp_path / name) for name in ("alone", "spread"))
    here = velatura("appearance", alone, *TINTS)
    assert here.code == 0
    with (
        machines(tmp_path, 2) as cluster,
        Command("appearance", spread, *TINTS, "--scheduler", cluster.address) as command,
    ):
        command.wait_for("Solving")
        cluster.workers[0].kill()
        there = command.outcome()
    assert (there.code, there.stderr) == (0, "")
    ours, theirs = frames(alone), frames(spread)
    for name, frame in ours.items():
        np.testing.assert_array_equal(theirs[name], frame)
    assert np.ptp(ours["warm P1"]) > 50


def test_a_scheduler_that_is_not_there_is_told_before_anything_is_solved(
    finished_demo: FinishedDemo, tmp_path: Path
) -> None:
    stage = with_tints(finished_demo, tmp_path / "stage")
    outcome = velatura("appearance", stage, "warm", "--scheduler", "tcp://127.0.0.1:9")
    assert outcome.code == 1
    assert outcome.error["code"] == "scheduler-unreachable"
