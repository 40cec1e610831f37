"""Cameras are placed where together they see most of what is lit, and in no one's way."""

from __future__ import annotations

import numpy as np
import pytest

from controller.core.errors import UsageError
from controller.optics.plan.figures import DIM, camera_figures, layout
from controller.optics.plan.search import PlanScene, candidates_of, choose_cameras, choose_placements
from controller.optics.plan.target_object import TargetObject, sampled
from controller.optics.plan.values import MountingPoint, PlanGoal, ProjectorModel, Surface

EYES = np.array([[0.0, 0.0, -3.0], [0.0, 0.0, 3.0], [3.0, 0.0, 0.0], [-3.0, 0.0, 0.0]])
GOAL = PlanGoal(lux=500.0, detail_mm=1.0, overlap=1, body_m=0.1, apart_m=0.3, points=1000)
CAMERA = ProjectorModel("camera", (1200, 900), 1.0, (2.0, 2.0), (0.0, 0.0), 0.0, 0.0)


def ring(count: int, above: float, distance_m: float = 1.2) -> list[MountingPoint]:
    return [
        MountingPoint.around_object(f"{360 * n / count:.0f} at {above:.0f}", 360 * n / count, above, distance_m)
        for n in range(count)
    ]


@pytest.fixture(scope="module")
def surface(target_object: TargetObject) -> Surface:
    return sampled(target_object, GOAL.points, EYES, 1)


def test_four_cameras_see_nearly_all_that_six_projectors_light_all_around(
    target_object: TargetObject, surface: Surface, model: ProjectorModel
) -> None:
    scene = PlanScene(surface, target_object, EYES)
    best = choose_placements(candidates_of([model] * 6, ring(6, 40.0), scene, GOAL), surface, GOAL)
    places = [*ring(16, 10.0), *ring(6, 40.0)]
    seen = []
    for count in (1, 2, 4):
        chosen = choose_cameras([CAMERA] * count, places, scene, GOAL, best.candidates)
        figures = camera_figures(chosen, best, surface)
        seen.append(figures["share_seen"])
        assert len({one["place"] for one in figures["cameras"]}) == count
        apart = [np.linalg.norm(a.placement.position_m - b.placement.position_m)
                 for a in chosen for b in (*best.candidates, *chosen) if a is not b]  # fmt: skip
        assert min(apart) >= GOAL.apart_m
    assert seen[0] < seen[1] < seen[2]
    assert seen[2] >= 0.95
    assert seen[0] < 0.6, "one camera sees half of a ball at most"
    lights, cameras = ([one.placement for one in devices] for devices in (best.candidates, chosen))
    grey = [
        np.count_nonzero((layout(lights, those, surface, EYES) == [int(DIM[n : n + 2], 16) for n in (1, 3, 5)]).all(2))
        for those in ((), cameras)
    ]
    assert grey[1] > grey[0] + 2 * 4 * 100, "each camera is drawn from above and from the side"


def test_cameras_that_have_no_room_are_refused(
    target_object: TargetObject, surface: Surface, model: ProjectorModel
) -> None:
    scene = PlanScene(surface, target_object, EYES)
    by_model = candidates_of([model], ring(6, 40.0), scene, GOAL)
    projectors = choose_placements(by_model, surface, GOAL).candidates
    taken = [one.placement.mounting_point for one in projectors]
    with pytest.raises(UsageError) as refused:
        choose_cameras([CAMERA], taken, scene, GOAL, projectors)
    assert refused.value.code == "plan-too-crowded"
