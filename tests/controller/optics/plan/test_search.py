"""Choosing places: against every set there is, and within the rules of the room."""

from __future__ import annotations

import itertools
import threading
from typing import Any

import numpy as np
import pytest

from controller.core.errors import UsageError, WorkError
from controller.optics.plan.search import Candidate, Measure, PlanScene, candidates_of, choose_placements, in_the_way
from controller.optics.plan.target_object import TargetObject, sampled
from controller.optics.plan.values import MountingPoint, PlanGoal, ProjectorModel, Surface
from tests.controller.optics.plan.conftest import EYE

GOAL = PlanGoal(lux=4000.0, detail_mm=0.8, overlap=2, steepest_degrees=75.0, fill=0.9, body_m=0.1, apart_m=0.3)


def goal_with(**changes: Any) -> PlanGoal:
    return GOAL.model_copy(update=changes)


def on_ring(count: int, distance_m: float = 1.3) -> list[MountingPoint]:
    angles = np.deg2rad(np.linspace(-85, 85, count))
    return [
        MountingPoint(f"{np.rad2deg(a):.0f}", (float(distance_m * np.sin(a)), -0.5, float(-distance_m * np.cos(a))))
        for a in angles
    ]


@pytest.fixture(scope="module")
def surface(target_object: TargetObject) -> Surface:
    return sampled(target_object, 600, EYE, seed=3)


def tried(
    target_object: TargetObject, surface: Surface, model: ProjectorModel, goal: PlanGoal, *, count: int
) -> list[list[Candidate]]:
    return candidates_of([model] * count, on_ring(9), PlanScene(surface, target_object, EYE), goal)


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("goal", [GOAL, goal_with(lux=12000.0, overlap=3), goal_with(detail_mm=0.3, overlap=1)])
def test_the_best_set_of_all_is_found(
    target_object: TargetObject, surface: Surface, model: ProjectorModel, goal: PlanGoal, count: int
) -> None:
    by_model = tried(target_object, surface, model, goal, count=count)
    best = choose_placements(by_model, surface, goal)
    judge = Measure.of(by_model[0], surface, goal)
    at = [np.asarray(one.placement.position_m) for one in by_model[0]]
    allowed = [
        group
        for group in itertools.combinations(range(len(at)), count)
        if all(np.linalg.norm(at[a] - at[b]) >= goal.apart_m for a, b in itertools.combinations(group, 2))
    ]
    assert best.quality == pytest.approx(max(float(judge.quality(group)[0]) for group in allowed), abs=1e-9)


def test_more_projectors_are_never_worse_and_more_light_wanted_never_better(
    target_object: TargetObject, surface: Surface, model: ProjectorModel
) -> None:
    by_count = [
        choose_placements(tried(target_object, surface, model, GOAL, count=n), surface, GOAL).quality for n in (1, 2, 3)
    ]
    assert by_count == sorted(by_count)
    demanding = goal_with(lux=40000.0)
    assert (
        choose_placements(tried(target_object, surface, model, demanding, count=2), surface, demanding).quality
        < by_count[1]
    )


def test_a_place_in_the_audiences_view_is_none(
    target_object: TargetObject, surface: Surface, model: ProjectorModel
) -> None:
    points = [MountingPoint("in front", (0.0, 0.0, -1.0)), MountingPoint("beside", (0.9, 0.0, -0.9))]
    (found,) = candidates_of([model], points, PlanScene(surface, target_object, EYE), GOAL)
    assert [one.placement.mounting_point.name for one in found] == ["beside"]
    assert in_the_way(np.array([0.0, 0.0, -1.0]), EYE, surface, 0.1)
    with pytest.raises(UsageError) as refused:
        candidates_of([model], points[:1], PlanScene(surface, target_object, EYE), GOAL)
    assert refused.value.code == "plan-no-place"


def test_two_can_not_stand_in_one_place(target_object: TargetObject, surface: Surface, model: ProjectorModel) -> None:
    by_model = candidates_of([model, model], on_ring(9)[:1], PlanScene(surface, target_object, EYE), GOAL)
    with pytest.raises(UsageError) as refused:
        choose_placements(by_model, surface, GOAL)
    assert refused.value.code == "plan-too-crowded"


def test_light_that_is_too_flat_counts_for_nothing(
    target_object: TargetObject, surface: Surface, model: ProjectorModel
) -> None:
    strict = goal_with(steepest_degrees=30.0)
    (wide,), (narrow,) = (
        candidates_of([model], on_ring(1), PlanScene(surface, target_object, EYE), goal) for goal in (GOAL, strict)
    )
    assert 0 < narrow[0].useful.sum() < wide[0].useful.sum()
    assert narrow[0].lit.cosine[narrow[0].useful].min() >= np.cos(np.deg2rad(30.0))


def test_it_stops_on_request(target_object: TargetObject, surface: Surface, model: ProjectorModel) -> None:
    cancel = threading.Event()
    cancel.set()
    with pytest.raises(WorkError) as stopped:
        candidates_of([model], on_ring(3), PlanScene(surface, target_object, EYE), GOAL, cancel=cancel)
    assert stopped.value.code == "cancelled"
