from __future__ import annotations

from collections.abc import Container
from pathlib import Path

import pytest

from tests.campaigns.serve_wires import STEPS, campaign, cases, drawn
from tests.campaigns.usb_faults import tether_faults, usb_faults

SEED = 121
ON_USB = frozenset(fault.name for fault in usb_faults())
TETHERED = frozenset(fault.name for fault in tether_faults())


def short(kind: Container[str], *, step: str = "") -> int:
    """The first case of a kind that needs little waiting; all of them: ``tests.campaigns.serve_wires``."""
    matrix = cases()
    quick = [number for number in drawn(SEED) if not (matrix[number][1].lasts or matrix[number][1].told)]
    there = [number for number in quick if (matrix[number][0] == step if step else matrix[number][0] != "calibrating")]
    return next(number for number in there if matrix[number][1].name in kind)


@pytest.mark.long
@pytest.mark.timeout(900)
def test_faults_on_real_wires_end_explained_and_are_mended(tmp_path: Path) -> None:
    wires = {fault.name for _, fault in cases()} - ON_USB - TETHERED
    while_it_works = short({"tether drop_in_transfer=1"}, step="calibrating")
    rows = campaign([short(wires), short(ON_USB), while_it_works], 2, tmp_path)
    assert [row["wrong"] for row in rows] == ["", "", ""], rows


def test_every_emulated_devices_knobs_are_rows_of_the_matrix_at_every_step() -> None:
    names = {fault.name for _, fault in cases()}
    assert {"wire silent=True", "camera lost_events=1", "unplug of left for good", "player hung"} <= names
    assert {"board stuck=[1]", "light lux=300.0", "keys silent=True", "unplug of keys for good"} <= names
    assert {"tether wire silent=True", "tether stall_in=1", "unplug of tether for good"} <= names
    assert len(cases()) == len(names) * len(STEPS)


def test_a_part_of_a_campaign_is_drawn_in_the_same_order_whatever_else_there_is() -> None:
    matrix, everything = cases(), drawn(SEED)
    assert sorted(everything) == list(range(len(matrix)))
    of_the_board = [number for number in everything if matrix[number][1].name.startswith("board")]
    assert drawn(SEED, "board") == of_the_board
