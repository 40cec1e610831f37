from __future__ import annotations

import random
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.campaigns.kills import Nursery, begin, copy, killed, uninterrupted

KILLS = 3
PHOTOGRAPHS = 40
"""Of 58, which both lives have in common; all of them: ``python -m tests.campaigns.kills``."""


@pytest.mark.timeout(900)
def test_a_calibration_that_is_killed_three_times_ends_in_the_same_bundle_to_the_byte(tmp_path: Path) -> None:
    with Nursery(tmp_path) as nursery, ThreadPoolExecutor(2) as both:
        begun = begin(tmp_path, nursery, photographs=PHOTOGRAPHS)
        first = both.submit(uninterrupted, copy(begun, tmp_path / "whole"), nursery)
        second = both.submit(killed, copy(begun, tmp_path / "killed"), nursery, random.Random(5), KILLS, 4.0)
        whole, lived = first.result(), second.result()
    assert lived.kills == KILLS
    assert lived.differences(whole) == []
