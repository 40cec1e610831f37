"""Choosing places: greedy, then exchanges until none helps; in the spirit of Law et al. 2010, on our own measure.

The measure at a surface point is the geometric mean of three shares of what is wanted, each at most 1: detail (of the
sharpest projector there), light (of all together), and the number of projectors that reach it. Its mean over the seen
area is the plan's quality.

At each place a projector is turned, zoomed and focused so that its picture holds the object (``aimed``).
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from controller.core.arrays import Float64, Mask
from controller.core.errors import UsageError, WorkError
from controller.optics.plan.optics import Shadows, best_focus, lit_by
from controller.optics.plan.values import Illumination, MountingPoint, Placement, PlanGoal, ProjectorModel, Surface

ROUNDS: Final = 40
DOWN: Final = (0.0, 1.0, 0.0)
STEEPEST: Final = 0.999
"""Cosine to the vertical from which "upright" means nothing, and the picture's top points away from the audience."""


def aimed(model: ProjectorModel, mounting_point: MountingPoint, surface: Surface, fill: float) -> Placement | None:
    """The projector at ``mounting_point``, upright, with the seen part of ``surface`` in the middle of its picture.

    Direction and zoom depend on each other through the lens shift and are found together. ``fill``: the share of the
    picture, along its tighter side, that the object takes; less where the zoom does not reach so far, more where even
    its shortest throw is too long. None where the object is beside or behind the place.
    """
    size = np.asarray(model.size_px, np.float64)
    middle = 0.5 * (size - 1.0)
    shift = np.asarray(model.lens_shift) * size
    centre = middle + np.array([-shift[0], shift[1]])
    position = np.asarray(mounting_point.position_m, np.float64)
    seen = surface.points_m[surface.area_m2 > 0]
    target, focal = seen.mean(axis=0), model.throw_ratio[0] * size[0]
    local, across = np.empty_like(seen), _level(target - position)
    for _ in range(ROUNDS):
        turned = _facing(target - position, across)
        local = (seen - position) @ turned.T
        if local[:, 2].min() <= 0.05:
            return None
        flat = local[:, :2] / local[:, 2:]
        low, high = flat.min(axis=0), flat.max(axis=0)
        wanted = fill * float(np.min(size / np.maximum(high - low, 1e-12)))  # a sheet is edge-on from some places
        focal = float(np.clip(wanted, model.throw_ratio[0] * size[0], model.throw_ratio[1] * size[0]))
        miss = 0.5 * (low + high) + (centre - middle) / focal
        if np.abs(miss).max() * focal < 0.01:
            break
        target = target + float(local[:, 2].mean()) * (turned.T @ (*miss, 0.0))
    weight = surface.area_m2[surface.area_m2 > 0] / local[:, 2] ** 2
    return Placement(
        model, mounting_point, turned, focal, (float(centre[0]), float(centre[1])), best_focus(local[:, 2], weight)
    )


def _level(forward: Float64) -> Float64:
    """The horizontal direction (3,) to the right of who looks ``forward``; looking straight down, the audience's."""
    ahead = forward / np.linalg.norm(forward)
    right = np.cross(DOWN if abs(ahead[1]) < STEEPEST else (0.0, 0.0, -1.0), ahead)
    return np.asarray(right / np.linalg.norm(right))


def _facing(forward: Float64, across: Float64) -> Float64:
    """(3, 3) world to device: z forward, x as near to ``across`` as that goes.

    From almost above, a lens shift turns the axis past the vertical; what is level must not turn over with it.
    """
    ahead = forward / np.linalg.norm(forward)
    right = across - (across @ ahead) * ahead
    right /= np.linalg.norm(right)
    return np.stack((right, np.cross(ahead, right), ahead))


MOST_EXCHANGES: Final = 50
STARTS: Final = 4
LEAST_GAIN: Final = 1e-6
LINES: Final = 200
"""Lines of sight on which the search tests whether a projector's body blocks the view."""
ProgressCallback = Callable[[float, str], None]


@dataclass(frozen=True, slots=True)
class Candidate:
    """A projector at a place, and what it does. ``useful`` (N,) bool: reached, and not too steep."""

    placement: Placement
    lit: Illumination
    useful: Mask


@dataclass(frozen=True, slots=True)
class PlacementPlan:
    """A plan. ``quality`` 0..1; ``at_points`` (N,) its measure at each point; ``tried``: how many sets were judged."""

    candidates: tuple[Candidate, ...]
    quality: float
    at_points: Float64
    tried: int


@dataclass(frozen=True, slots=True)
class Measure:
    """Arrays (candidates, N) from which any set of candidates is judged by sums and minima."""

    goal: PlanGoal
    weight: Float64
    detail_mm: Float64
    lux: Float64
    count: Float64

    @classmethod
    def of(cls, candidates: Sequence[Candidate], surface: Surface, goal: PlanGoal) -> Measure:
        useful = np.stack([one.useful for one in candidates])
        return cls(
            goal,
            surface.area_m2 / surface.area_m2.sum(),
            np.where(useful, np.stack([one.lit.detail_mm for one in candidates]), np.inf),
            np.where(useful, np.stack([one.lit.lux for one in candidates]), 0.0),
            useful.astype(np.float64),
        )

    def at_points(self, rest: Sequence[int], others: slice = slice(0, 0)) -> Float64:
        """The measure (k, N) of the set ``rest`` with each of ``others`` added, or (1, N) of the set alone."""
        rest = list(rest)
        detail = np.min(self.detail_mm[rest], axis=0, initial=np.inf)
        lux, count = self.lux[rest].sum(axis=0), self.count[rest].sum(axis=0)
        if others.stop > others.start:
            detail = np.minimum(detail, self.detail_mm[others])
            lux, count = lux + self.lux[others], count + self.count[others]
        shares = np.minimum(1.0, self.goal.detail_mm / np.atleast_2d(detail))
        shares = shares * np.minimum(1.0, np.atleast_2d(lux) / self.goal.lux)
        return np.asarray(np.cbrt(shares * np.minimum(1.0, np.atleast_2d(count) / self.goal.overlap)))

    def quality(self, rest: Sequence[int], others: slice = slice(0, 0)) -> Float64:
        return np.asarray(self.at_points(rest, others) @ self.weight)


@dataclass(frozen=True, slots=True, eq=False)
class PlanScene:
    """What is there before any projector: the object's ``surface``, what casts ``shadows``, where the audience stands.

    ``audience_m`` (N, 3): positions of eyes
    """

    surface: Surface
    shadows: Shadows
    audience_m: Float64


def candidates_of(
    models: Sequence[ProjectorModel],
    mounting_points: Sequence[MountingPoint],
    scene: PlanScene,
    goal: PlanGoal,
    *,
    tell: ProgressCallback = lambda share, text: None,
    cancel: threading.Event | None = None,
) -> list[list[Candidate]]:
    """For each model, it at every mounting point where it can stand and reaches the object at all.

    Where its body would stand between audience and object is no place. Raises UsageError("plan-no-place") if a model
    has none, WorkError("cancelled").
    """
    surface = scene.surface
    known: dict[ProjectorModel, list[Candidate]] = {}
    different = list(dict.fromkeys(models))
    for number, (model, mounting_point) in enumerate(itertools.product(different, mounting_points)):
        check(cancel)
        tell(number / (len(different) * len(mounting_points)), f"{model.name} at {mounting_point.name}")
        found = known.setdefault(model, [])
        placement = aimed(model, mounting_point, surface, goal.fill)
        if placement is None or in_the_way(placement.position_m, scene.audience_m, surface, goal.body_m):
            continue
        lit = lit_by(placement, surface, scene.shadows)
        useful = lit.useful(goal.steepest_degrees)
        if np.any(useful & (surface.area_m2 > 0)):
            found.append(Candidate(placement, lit, useful))
    for model, found in known.items():
        if not found:
            raise UsageError(
                "plan-no-place",
                what=f"No position is possible for {model.name}: from each, it reaches nothing or hides the object.",
                remedy="Add positions farther to the side of the audience, or use a smaller [goal] body_m.",
            )
    return [known[model] for model in models]


def choose_placements(
    by_model: Sequence[Sequence[Candidate]],
    surface: Surface,
    goal: PlanGoal,
    *,
    tell: ProgressCallback = lambda share, text: None,
    cancel: threading.Event | None = None,
) -> PlacementPlan:
    """One place for every model, best together. The same arguments give the same plan.

    Raises UsageError("plan-too-crowded") where no set keeps its distances, WorkError("cancelled").
    """
    flat = [one for group in by_model for one in group]
    ends = np.cumsum([len(group) for group in by_model])
    groups = [slice(int(end) - len(group), int(end)) for end, group in zip(ends, by_model, strict=True)]
    measure, fits = Measure.of(flat, surface, goal), _Fits(flat, surface, goal)
    alone = measure.quality([], groups[0])
    firsts = groups[0].start + np.argsort(-alone, kind="stable")[:STARTS]
    best: tuple[float, list[int]] | None = None
    tried = 0
    for number, first in enumerate(firsts):
        check(cancel)
        tell(number / len(firsts), f"start {number + 1} of {len(firsts)}")
        picked, judged = _greedy(int(first), groups, measure, fits)
        tried += judged
        if picked is None:
            continue
        picked, judged = _exchanged(picked, groups, measure, fits, cancel)
        tried += judged
        quality = float(measure.quality(picked)[0])
        if best is None or quality > best[0] + LEAST_GAIN:
            best = quality, picked
    if best is None:
        raise UsageError(
            "plan-too-crowded",
            what="There is no room for all projectors: they stand too near each other or in each other's light.",
            remedy="Add positions, or use a smaller [goal] apart_m or body_m.",
        )
    at_points = measure.at_points(best[1])[0]
    return PlacementPlan(tuple(flat[index] for index in best[1]), best[0], at_points, tried)


def _greedy(first: int, groups: Sequence[slice], measure: Measure, fits: _Fits) -> tuple[list[int] | None, int]:
    picked, tried = [first], 0
    for group in groups[1:]:
        quality = measure.quality(picked, group)
        tried += len(quality)
        following = next((group.start + int(k) for k in np.argsort(-quality, kind="stable")
                          if fits.together(group.start + int(k), picked)), None)  # fmt: skip
        if following is None:
            return None, tried
        picked.append(following)
    return picked, tried


def _exchanged(
    picked: list[int], groups: Sequence[slice], measure: Measure, fits: _Fits, cancel: threading.Event | None
) -> tuple[list[int], int]:
    """Each projector in turn to its best place with the others where they are, until nothing changes."""
    tried = 0
    for _ in range(MOST_EXCHANGES):
        before = list(picked)
        for turn, group in enumerate(groups):
            check(cancel)
            rest = picked[:turn] + picked[turn + 1 :]
            quality = measure.quality(rest, group)
            tried += len(quality)
            now = quality[picked[turn] - group.start]
            for k in np.argsort(-quality, kind="stable"):
                if quality[k] <= now + LEAST_GAIN:
                    break
                if fits.together(group.start + int(k), rest):
                    picked[turn] = group.start + int(k)
                    break
        if picked == before:
            break
    return picked, tried


CAMERA_BODY_M: Final = 0.1
"""A camera's radius."""


def choose_cameras(
    models: Sequence[ProjectorModel], mounting_points: Sequence[MountingPoint], scene: PlanScene, goal: PlanGoal,
    projectors: Sequence[Candidate],
) -> tuple[Candidate, ...]:  # fmt: skip
    """Places of cameras, one for each model, that see most of what ``projectors`` light, and see it from in front.

    They stand in no light. Raises UsageError("plan-no-place", "plan-too-crowded").
    """
    surface, narrow = scene.surface, goal.model_copy(update={"body_m": CAMERA_BODY_M})
    lit = surface.area_m2 * np.any([one.useful for one in projectors], axis=0)
    lenses = np.stack([one.placement.position_m for one in projectors])
    picked: list[Candidate] = []
    best = np.zeros(len(lit))
    for group in candidates_of(models, mounting_points, scene, narrow):
        seen = np.stack([np.where(one.useful, one.lit.cosine, 0.0) for one in group])
        for k in np.argsort(-np.maximum(seen, best) @ lit, kind="stable"):
            at = group[k].placement.position_m
            apart_m = [np.linalg.norm(at - one.placement.position_m) for one in (*projectors, *picked)]
            if min(apart_m) >= goal.apart_m and not in_the_way(at, lenses, surface, CAMERA_BODY_M):
                picked.append(group[k])
                best = np.maximum(best, seen[k])
                break
        else:
            raise UsageError(
                "plan-too-crowded",
                what="There is no room for all cameras: they stand too near the projectors or in their light.",
                remedy="Add positions, or use a smaller [goal] apart_m.",
            )
    return tuple(picked)


class _Fits:
    """Whether candidates can stand beside each other; what was found is kept."""

    def __init__(self, candidates: Sequence[Candidate], surface: Surface, goal: PlanGoal) -> None:
        self._candidates, self._surface, self._goal = candidates, surface, goal
        self._known: dict[tuple[int, int], bool] = {}

    def together(self, one: int, others: Sequence[int]) -> bool:
        return all(self._pair(min(one, other), max(one, other)) for other in others)

    def _pair(self, one: int, other: int) -> bool:
        if (one, other) not in self._known:
            a, b = (self._candidates[k].placement.position_m for k in (one, other))
            apart = float(np.linalg.norm(a - b)) >= max(self._goal.apart_m, 1e-9)
            self._known[one, other] = apart and not (
                in_the_way(a, b[None], self._surface, self._goal.body_m)
                or in_the_way(b, a[None], self._surface, self._goal.body_m)
            )
        return self._known[one, other]


def in_the_way(body_m: Float64, from_m: Float64, surface: Surface, radius_m: float) -> bool:
    """Whether a ball at ``body_m`` (3,) stands between any of ``from_m`` (M, 3) and the seen surface."""
    seen = surface.points_m[surface.area_m2 > 0]
    points = seen[:: max(1, len(seen) // LINES)]
    for eye in from_m:
        line = points - eye
        along = np.clip((line @ (body_m - eye)) / np.sum(line**2, axis=1), 0.0, 1.0)
        if np.min(np.linalg.norm(eye + along[:, None] * line - body_m, axis=1)) < radius_m:
            return True
    return False


def check(cancel: threading.Event | None) -> None:
    """Raises WorkError("cancelled") once ``cancel`` is set."""
    if cancel is not None and cancel.is_set():
        raise WorkError("cancelled", what="The planning was stopped.", remedy="Run the same command to start again.")
