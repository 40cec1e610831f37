from __future__ import annotations

import random
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.campaigns.kills import Nursery, begin, copy, killed, uninterrupted

KILLS = 3
PHOTOGRAPHS = 40
"""Of 58, which both lives have in common; all of them: ``python -m tests.campaigns.kills``."""


@pytest.mark.long
@pytest.mark.timeout(900)
def test_a_calibration_that_is_killed_three_times_ends_in_the_same_bundle_to_the_byte(tmp_path: Path) -> None:
    with Nursery(tmp_path) as nursery, ThreadPoolExecutor(2) as both:
        begun = begin(tmp_path, nursery, photographs=PHOTOGRAPHS)
        first = both.submit(uninterrupted, copy(begun, tmp_path / "whole"), nursery)
        second = both.submit(killed, copy(begun, tmp_path / "killed"), nursery, random.Random(5), KILLS, 4.0)
        whole, lived = first.result(), second.result()
    assert lived.kills == KILLS
    assert lived.differences(whole) == []


def test_a_copied_stage_has_other_ports_and_all_other_numbers(tmp_path: Path) -> None:
    begun = tmp_path / "begun"
    begun.mkdir()
    (begun / "bench.toml").write_text("command_port = 27008\nevent_port = 22354\ngain = 0.8205827008802562\n")
    (begun / "stage.toml").write_text('address = "ptpip:127.0.0.1:27008:22354"\nshare = 0.22354\n')
    to = copy(begun, tmp_path / "copied")
    command, event, gain = (line.split(" = ")[1] for line in (to / "bench.toml").read_text().splitlines())
    assert {command, event}.isdisjoint({"27008", "22354"})
    assert gain == "0.8205827008802562"
    assert (to / "stage.toml").read_text() == f'address = "ptpip:127.0.0.1:{command}:{event}"\nshare = 0.22354\n'
