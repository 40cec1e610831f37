"""The figures of a plan on a wall, where the optics say what they have to be."""

from __future__ import annotations

from typing import Any

from controller.optics.plan.figures import figures_of
from controller.optics.plan.optics import lit_by
from controller.optics.plan.search import Candidate, PlacementPlan
from controller.optics.plan.values import PlanGoal
from tests.controller.optics.plan.test_optics import FACING, Nothing, wall

GOAL = PlanGoal(lux=100.0, detail_mm=1.0, overlap=1, steepest_degrees=75.0, fill=0.9, body_m=0.0, apart_m=0.0)
SIDE_MM = 1e3 * 2.0 / 800.0
"""Of a pixel of ``FACING`` on the wall."""


def on_a_wall(count: int) -> dict[str, Any]:
    surface = wall(steps=21, half_m=0.2)
    lit = lit_by(FACING, surface, Nothing())
    candidates = (Candidate(FACING, lit, lit.useful(GOAL.steepest_degrees)),) * count
    return figures_of(PlacementPlan(candidates, 1.0, lit.lux, 1), surface, GOAL)


def test_one_projector_makes_waves_of_little_more_than_two_pixels_and_three_make_finer_ones() -> None:
    one, three = on_a_wall(1), on_a_wall(3)
    # All of the wall gets the same light, so none is left for sharpening: it takes a little more than two pixels.
    assert 2 * SIDE_MM < one["wave_mm_one"] < 2.5 * SIDE_MM
    assert one["wave_mm_all"] == three["wave_mm_one"] == one["wave_mm_one"]
    assert 1.2 < three["wave_mm_one"] / three["wave_mm_all"] < 1.6
