"""``velatura plan``: from plan.toml to places for the projectors, a page and a file with the figures."""

from __future__ import annotations

import json
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from controller.core.arrays import ByteImage, Float64
from controller.core.errors import UsageError
from controller.core.storage import write_atomically
from controller.optics.plan.figures import camera_figures, combined_light, figures_of, layout, value_map
from controller.optics.plan.optics import lit_by
from controller.optics.plan.plan_file import EXAMPLE, PlanTables, read_plan
from controller.optics.plan.search import PlacementPlan, PlanScene, candidates_of, choose_cameras, choose_placements
from controller.optics.plan.target_object import AudienceView, TargetObject, read_target_object, sampled, seen_from
from controller.optics.plan.values import Placement, PlanGoal
from controller.run.progress import Reporter, Tracker
from controller.stage.report.page import Goal, Page, ReportPicture, render
from controller.stage.report.words import SUPERPOSITION

HTML, MACHINE = "plan.html", "plan.json"
SEED: Final = 1
VIEW_ROWS: Final = 420
WEIGHTS: Final = (1.0, 8.0, 3.0, 2.0)
STEPS: Final = ("Reading the object", "Evaluating every place", "Choosing the set of places", "Drawing the page")


def write_example(path: Path) -> Mapping[str, Any]:
    """Write an example plan.toml. Raises UsageError("plan-exists"), WorkError("no-space", "cannot-write")."""
    if path.exists():
        raise UsageError(
            "plan-exists", what=f"{path} exists already.", remedy="Give another name, or remove the file first."
        )
    write_atomically(path, EXAMPLE.encode())
    return {"written": str(path)}


def plan(*, file: Path, out: Path, reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
    """Choose places for the projectors of ``file``; write plan.html and plan.json into the folder ``out``.

    Raises UsageError as ``read_plan``, ``read_target_object``, ``sampled``, ``candidates_of``, ``choose_placements``.
    """
    tables = read_plan(file)
    tracker = Tracker(STEPS, WEIGHTS, reporter)
    tracker.begin(0)
    table = tables.object
    target_object = read_target_object(
        file.parent / table.mesh, height_m=table.height_m, up=table.up, front=table.front
    )
    audience = np.asarray(tables.audience.positions_m, np.float64)
    goal = tables.goal
    surface = sampled(target_object, tables.goal.points, audience, SEED)
    tracker.end()
    tracker.begin(1)
    places = tables.mounting_points()
    scene = PlanScene(surface, target_object, audience)
    candidates = candidates_of(tables.models(), places, scene, goal, tell=tracker.advance, cancel=cancel)
    tracker.end()
    tracker.begin(2)
    best = choose_placements(candidates, surface, goal, tell=tracker.advance, cancel=cancel)
    tracker.end()
    tracker.begin(3)
    figures = figures_of(best, surface, goal)
    models = tables.camera_models()
    cameras = choose_cameras(models, places, scene, goal, best.candidates) if models else ()
    if cameras:
        figures |= camera_figures(cameras, best, surface)
    projecting, seeing = ([one.placement for one in devices] for devices in (best.candidates, cameras))
    drawn = layout(projecting, seeing, surface, audience)
    out.mkdir(parents=True, exist_ok=True)
    page = _page(tables, len(places), target_object, best, drawn, audience, figures)
    write_atomically(out / MACHINE, (json.dumps(figures, indent=2, allow_nan=False) + "\n").encode())
    write_atomically(out / HTML, render(page).encode())
    tracker.end()
    return {"plan": str(out / HTML), "figures": str(out / MACHINE), "quality": round(best.quality, 4)}


def _page(
    tables: PlanTables,
    places: int,
    target_object: TargetObject,
    best: PlacementPlan,
    drawn: ByteImage,
    audience: Float64,
    figures: Mapping[str, Any],
) -> Page:
    goal = tables.goal
    placements = [candidate.placement for candidate in best.candidates]
    room = ReportPicture("The room", drawn, "metres from the centre of the object")
    galleries: list[tuple[str, str, tuple[ReportPicture, ...]]] = [("Places", "", (room,))]
    for number, eye in enumerate(audience):
        name = "from the audience" if len(audience) == 1 else f"from the audience's place {number + 1}"
        view = seen_from(target_object, eye, rows=VIEW_ROWS)
        maps = _maps(target_object, view, placements, goal) if view.mask.any() else ()
        note = "" if maps else "From there the object is edge-on: no surface of it is visible."
        galleries.append((f"Light and detail on the object, seen {name}", note, maps))
    return Page(
        title=f"Plan for {Path(tables.object.mesh).stem}",
        summary=f"{len(placements)} projectors in {places} places; {best.tried} sets compared. "
        "Predicted from data sheets: vignetting, lamp age and paint are not included."
        + (f" {SUPERPOSITION}" if len(placements) == 1 else ""),
        goals=tuple(_goals(figures, goal)),
        rows=(),
        galleries=tuple(galleries),
        facts=_stands(figures),
    )


def _goals(figures: Mapping[str, Any], goal: PlanGoal) -> list[Goal]:
    def share(name: str, key: str, asked: str) -> Goal:
        return Goal(name, f"{100 * figures[key]:.0f} % of the visible surface", asked)

    detail = figures["detail_mm_median"]
    return [
        Goal("Quality", f"{figures['quality']:.2f}", "1: every goal is reached everywhere"),
        share("Light", "share_bright_enough", f"{goal.lux:g} lx; the median is {figures['lux_median']:.0f} lx"),
        share("Detail", "share_fine_enough",
              f"{goal.detail_mm:g} mm; the median is {'-' if detail is None else format(detail, '.2f')} mm"),
        share("Overlap", "share_overlapped", f"{goal.overlap} projectors at each point"),
        share("Covered", "share_reached", "by at least one projector"),
        *([Goal("Seen", f"{100 * figures['share_seen']:.0f} % of what is lit", "by at least one camera")]
          if "cameras" in figures else []),
    ]  # fmt: skip


def _stands(figures: Mapping[str, Any]) -> dict[str, str]:
    """For each projector its place, direction and settings, and its figures on its own; then the finest wave."""
    stands = {}
    for number, one in enumerate(figures["projectors"], start=1):
        x, y, z = one["position_m"]
        detail = "-" if one["detail_mm_median"] is None else f"{one['detail_mm_median']:.2f} mm"
        stands[f"{number}: {one['model']}"] = (
            f"{one['place']} (x {x:.2f}, y {y:.2f}, z {z:.2f} m); turn {one['pan_degrees']:+.1f}°, "
            f"tilt {one['tilt_up_degrees']:+.1f}°, throw {one['throw_ratio']:.2f}, focus at {one['focus_m']:.2f} m. "
            f"Reaches {100 * one['share_reached']:.0f} %, {one['lux_median']:.0f} lx, {detail}; "
            f"{100 * (one['grazing_loss_mean'] or 0):.0f} % lost by oblique incidence."
        )
    for number, one in enumerate(figures.get("cameras", ()), start=1):
        x, y, z = one["position_m"]
        stands[f"Camera {number}: {one['model']}"] = (
            f"{one['place']} (x {x:.2f}, y {y:.2f}, z {z:.2f} m); turn {one['pan_degrees']:+.1f}°, "
            f"tilt {one['tilt_up_degrees']:+.1f}°. Sees {100 * one['share_seen']:.0f} % of what is lit."
        )
    one, every = figures["wave_mm_one"], figures["wave_mm_all"]
    if one is not None:
        stands["Finest wave"] = (
            f"{every:.2f} mm from crest to crest by all projectors together, {one:.2f} mm by the sharpest alone. It is "
            "the finest one that keeps half of its contrast."
        )
    return stands


def _maps(
    target_object: TargetObject, view: AudienceView, placements: list[Placement], goal: PlanGoal
) -> tuple[ReportPicture, ...]:
    lit = [lit_by(placement, view.surface, target_object) for placement in placements]
    useful = np.stack([values.useful(goal.steepest_degrees) for values in lit])
    found = combined_light(lit, useful)
    reached = found.count > 0
    finest = np.where(reached, found.detail_mm, np.nan)
    sharp = np.where(reached, np.where(useful, [values.blur_px for values in lit], np.inf).min(axis=0), np.nan)
    steep = np.degrees(np.arccos(np.clip(np.where(useful, [values.cosine for values in lit], 0.0).max(axis=0), 0, 1)))
    maps = (
        ("Light", "lux", found.lux, 0.0, max(1.5 * goal.lux, float(np.quantile(found.lux, 0.95)))),
        ("Finest detail", "mm", finest, 0.0, 2 * goal.detail_mm),
        ("Number of projectors", "number", found.count.astype(np.float64), 0.0, float(len(placements))),
        ("Incidence of the best light", "degrees from the normal", np.where(reached, steep, np.nan), 0.0, 90.0),
        ("Blur of the sharpest projector", "projector pixels", sharp, 0.0, 2.0),
    )
    return tuple(
        ReportPicture(name, value_map(view.map_of(values), name, unit, lowest=low, highest=high), unit)
        for name, unit, values, low, high in maps
    )
