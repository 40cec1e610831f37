"""A plan in numbers: stands and lenses in words of a technician, and what the seen surface gets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64, Mask
from controller.optics.plan.resolution import FAINT, MEAN, LineProjector, finest_wave
from controller.optics.plan.search import PlacementPlan
from controller.optics.plan.values import Illumination, Placement, PlanGoal, Surface


@dataclass(frozen=True, slots=True)
class CombinedLight:
    """What projectors light together at each of N points, each where it is of use.

    ``lux`` (N,): the sum of them; ``detail_mm`` (N,): of the finest, infinite where there is none; ``count`` (N,)
    """

    lux: Float64
    detail_mm: Float64
    count: npt.NDArray[np.int64]


def combined_light(lit: Sequence[Illumination], useful: Mask) -> CombinedLight:
    """``useful`` (projectors, N) bool: where each of ``lit`` is of use."""
    return CombinedLight(
        np.where(useful, [one.lux for one in lit], 0.0).sum(axis=0),
        np.where(useful, [one.detail_mm for one in lit], np.inf).min(axis=0),
        useful.sum(axis=0),
    )


WAVE_POINTS: Final = 7
CAMERA_BLUR_PX: Final = 0.25
"""Of a projector pixel: what a camera adds whose pixels are a third of that, blurred by 0.7 of its own."""


def figures_of(best: PlacementPlan, surface: Surface, goal: PlanGoal) -> dict[str, Any]:
    """Placements in words of a stand and a lens, and what the seen surface gets of each and of all."""
    weight = surface.area_m2 / surface.area_m2.sum()
    found = combined_light([one.lit for one in best.candidates], np.stack([one.useful for one in best.candidates]))
    lux, detail, count = found.lux, found.detail_mm, found.count
    return {
        "quality": best.quality,
        "tried": best.tried,
        "seen_area_m2": float(surface.area_m2.sum()),
        "share_reached": float(weight @ (count > 0)),
        "share_overlapped": float(weight @ (count >= goal.overlap)),
        "share_bright_enough": float(weight @ (lux >= goal.lux)),
        "share_fine_enough": float(weight @ (detail <= goal.detail_mm)),
        "lux_median": _weighted(lux, weight, 0.5),
        "lux_p5": _weighted(lux, weight, 0.05),
        "detail_mm_median": _finite(_weighted(detail, weight, 0.5)),
        "detail_mm_p95": _finite(_weighted(detail, weight, 0.95)),
        **_finest_waves([one.lit for one in best.candidates], [one.useful for one in best.candidates], weight),
        "projectors": [_placed(one.placement) | _alone(one.useful, one.lit, weight) for one in best.candidates],
    }


def _finest_waves(lit: Sequence[Illumination], useful: Sequence[Mask], weight: Float64) -> dict[str, float | None]:
    """Length of the finest wave by the sharpest projector and by all, median over points of the seen surface.

    Along the longer sides of pixels, as bright as the sharpest projector alone can reach in 95 % of its light.
    """
    reached = np.where(np.any(useful, axis=0), weight, 0.0)
    if not reached.any():
        return {"wave_mm_one": None, "wave_mm_all": None}
    share = np.cumsum(reached) / reached.sum()
    one, every = [], []
    for point in np.searchsorted(share, (np.arange(WAVE_POINTS) + 0.5) / WAVE_POINTS):
        there = sorted((n for n in range(len(lit)) if useful[n][point]), key=lambda n: lit[n].detail_mm[point])
        side_mm = lit[there[0]].pixel_mm[point, 0]
        white = _weighted(lit[there[0]].lux, np.where(useful[there[0]], weight, 0.0), 0.05) / (MEAN + FAINT)
        line = [
            LineProjector(
                lit[n].pixel_mm[point, 0] / side_mm,
                float(np.hypot(lit[n].blur_px[point], CAMERA_BLUR_PX)),
                lit[n].lux[point] / white,
            )
            for n in there
        ]
        one.append(side_mm / finest_wave(line[:1]))
        every.append(side_mm / finest_wave(line))
    return {"wave_mm_one": float(np.median(one)), "wave_mm_all": float(np.median(every))}


def _placed(placement: Placement) -> dict[str, Any]:
    ahead = placement.rotation[2]
    return {
        "model": placement.model.name,
        "place": placement.mounting_point.name,
        "position_m": list(placement.mounting_point.position_m),
        "rotation": placement.rotation.tolist(),
        "pan_degrees": math.degrees(math.atan2(ahead[0], ahead[2])),
        "tilt_up_degrees": math.degrees(math.asin(-ahead[1])),
        "throw_ratio": placement.throw_ratio,
        "focal_px": placement.focal_px,
        "centre_px": list(placement.centre_px),
        "focus_m": placement.focus_m,
    }


def _alone(useful: Mask, lit: Illumination, weight: Float64) -> dict[str, Any]:
    """What one projector does where it is of use."""
    share = float(weight @ useful)
    inside = np.where(useful, weight, 0.0)
    return {
        "share_reached": share,
        "lux_median": _of(lit.lux, useful, inside, 0.5),
        "detail_mm_median": _of(lit.detail_mm, useful, inside, 0.5),
        "blur_px_median": _of(lit.blur_px, useful, inside, 0.5),
        "blur_px_p95": _of(lit.blur_px, useful, inside, 0.95),
        "grazing_loss_mean": float(inside @ (1.0 - lit.cosine)) / share if share else None,
    }


def _of(values: Float64, useful: Mask, inside: Float64, share: float) -> float | None:
    return _finite(_weighted(np.where(useful, values, 0.0), inside, share))


def _weighted(values: Float64, weight: Float64, share: float) -> float:
    """The value below which ``share`` of the weight lies; of no weight, 0."""
    order = np.argsort(values, kind="stable")
    summed = np.cumsum(weight[order])
    if summed[-1] <= 0:
        return 0.0
    return float(values[order[min(int(np.searchsorted(summed, share * summed[-1])), len(order) - 1)]])


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
