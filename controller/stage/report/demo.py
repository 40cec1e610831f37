"""What a demo measured, gathered from its run folder into report.html and report.json."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from controller.core.arrays import FloatImage, Mask
from controller.core.errors import UsageError
from controller.optics.calibrate.values import Calibration
from controller.optics.solve.result.metrics import Comparison, compare
from controller.run.journal import Journal
from controller.run.step_id import StepId
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.geometry import read_geometry_figures, read_shape
from controller.stage.artefacts.grade import read_grade_figures, read_troubles, trouble_row
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.projectors import PixelFigures, read_radiometry_figures
from controller.stage.artefacts.published import BundleFigures, has_photograph, read_photograph_of, read_playback
from controller.stage.artefacts.solved import Solved, is_solved, read_base_figures, read_solved
from controller.stage.report.calibration import shape_goal
from controller.stage.report.galleries import causes_gallery, light_gallery, whites
from controller.stage.report.one_projector import OneProjector, as_figures, as_rows, one_projector
from controller.stage.report.one_projector import goals as one_projector_goals
from controller.stage.report.page import (
    Goal,
    Page,
    PictureRow,
    ReportPicture,
    judged_rows,
    nearness,
    refined_row,
    write_report,
)
from controller.stage.report.pictures import Crop, crop_around, error_picture, fitted, to_screen
from controller.stage.report.words import spent
from controller.stage.sessions.check import Checked, check_stage
from controller.stage.steps.appearance.compare import judged
from hal.runtime.compute import usable_cpus

GOAL_DELTA_E = 4.0
GOAL_SWAPS_PER_S = 60.0
CAPTURE_STEPS = {StepKind.EXPOSURE, StepKind.BLACK, StepKind.LIGHT, StepKind.CODES}


@dataclass(frozen=True, slots=True)
class AppearanceComparison:
    """One appearance beside its target, by us and the traditional way."""

    name: str
    title: str
    solved: Solved
    photograph: FloatImage
    ours: Comparison
    alone: OneProjector
    judged: Mapping[str, Any]


def write_demo_report(out: Path, run: Path, checked: Checked) -> tuple[Path, Path]:
    """Write ``report.html`` and ``report.json`` of a finished demo run into ``out``."""
    calibrated = Calibrated(run, checked.names)
    calibration, reflectance = calibrated.calibration, calibrated.reflectance
    names = [table.name for table in checked.stage.tables.appearances]
    found = [_judge(run, name, calibration, reflectance, checked.names) for name in names]
    with Journal(run) as journal:
        steps, shots = journal.steps(), journal.shot_count()
    figures = _figures(run, checked.names, found, steps, shots)
    return write_report(out, _page(run, checked, calibration, found, figures, steps), figures)


def report_again(run: Path, out: Path) -> Mapping[str, str]:
    """Write the report of the finished demo run in the folder ``run``, STAGE/runs/NAME, into ``out``.

    Raises UsageError("run-not-a-demo" or "run-not-finished"), and as ``check_stage`` for the stage that it lies in.
    """
    if not (run / Journal.FILE).exists():
        raise UsageError(
            "run-not-a-demo",
            what=f"{run} is not the folder of a run.",
            remedy="Give a folder of STAGE/runs whose name ends in -demo.",
        )
    checked = check_stage(run.resolve().parent.parent)
    with Journal(run) as journal:
        done = ("demo", "done") in journal.outcomes()
    kinds = (StepKind.PHOTOGRAPH, StepKind.TRADITIONAL)
    names = [table.name for table in checked.stage.tables.appearances]
    whole = all(is_solved(run, name) and all(has_photograph(run, kind, name) for kind in kinds) for name in names)
    if not done or not whole:
        raise UsageError(
            "run-not-finished",
            what=f"{run} is not a demo that has photographed every appearance of stage.toml.",
            remedy="Run `velatura demo` with the same --out again: it continues and writes the report.",
        )
    html, figures = write_demo_report(out, run, checked)
    return {"report": str(html), "figures": str(figures)}


def _judge(
    run: Path, name: str, calibration: Calibration, reflectance: FloatImage, projectors: Sequence[str]
) -> AppearanceComparison:
    solved = read_solved(run, name, projectors)
    photograph = read_photograph_of(run, StepKind.PHOTOGRAPH, name)
    mask: Mask = solved.requested.reachable & calibration.object_mask
    ours = compare(photograph, solved.requested.target, calibration.camera_to_xyz, solved.exposure, mask)
    alone = one_projector(run, name, calibration, solved, photograph, mask)
    more = judged(calibration, reflectance, solved, photograph)
    return AppearanceComparison(name, str(solved.figures["title"]), solved, photograph, ours, alone, more)


def _figures(
    run: Path,
    projectors: Sequence[str],
    judged: Sequence[AppearanceComparison],
    steps: Mapping[StepId, float],
    shots: int,
) -> dict[str, Any]:
    geometry, base = read_geometry_figures(run), read_base_figures(run)
    pixels = [one for name in projectors if (one := PixelFigures.read(run, name)) is not None]
    captured = sum(seconds for step, seconds in steps.items() if step.kind in CAPTURE_STEPS)
    fitting = sum(seconds for step, seconds in steps.items() if step.kind == StepKind.PIXELS)
    bundle = BundleFigures.read(run)
    return {
        "captures": {"count": shots, "seconds": captured},
        "geometry": {key: geometry.get(key) for key in ("reprojection_rms_px", "shape_rel_sigma", "inlier_share")},
        "shape": asdict(read_shape(run)),
        "radiometry": {name: read_radiometry_figures(run, name) for name in projectors},
        "metapixels": {
            "fitted": sum(one.fitted for one in pixels),
            "failed": sum(one.pixels - one.fitted for one in pixels),
            "seconds": fitting,
        },
        "verification": read_grade_figures(run),
        "troubles": [trouble_row(trouble) for trouble in read_troubles(run)],
        "solve": {key: base[key] for key in ("seconds", "iterations", "objective", "kkt")},
        "appearances": [_appearance_figures(appearance) for appearance in judged],
        "bundle": {"bytes": bundle.bytes, "ratio": bundle.ratio},
        "playback": read_playback(run),
        "machine": {"cores": usable_cpus(), "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")},
        "seconds": sum(steps.values()),
    }


def _appearance_figures(appearance: AppearanceComparison) -> dict[str, Any]:
    return {
        "name": appearance.name,
        "seconds": appearance.solved.figures["seconds"],
        "delta_e00_median": appearance.ours.delta_e00_median,
        "delta_e00_p95": appearance.ours.delta_e00_p95,
        "rmse": appearance.ours.rmse,
        "sharpness_lambda": appearance.ours.sharpness_lambda,
        "reachable_share": appearance.solved.figures["reachable_share"],
        **as_figures(appearance.alone, appearance.ours),
        "refined": appearance.solved.figures.get("refined"),
        **appearance.judged,
    }


def _page(
    run: Path,
    checked: Checked,
    calibration: Calibration,
    judged: Sequence[AppearanceComparison],
    figures: Mapping[str, Any],
    steps: Mapping[StepId, float],
) -> Page:
    crop = crop_around(calibration.object_mask)
    lit = np.asarray(sum(whites(calibration), start=calibration.black), np.float32)
    white = float(np.percentile(lit[calibration.object_mask], 99))
    before = _cropped(to_screen(lit, calibration.camera_to_xyz, white=white), crop)
    rows = tuple(_row(appearance, before, calibration, crop) for appearance in judged)
    count, machine = figures["captures"]["count"], figures["machine"]
    return Page(
        title=f"{checked.stage.tables.stage.name}: {len(judged)} appearances",
        summary=f"{count} photographs, {figures['seconds']:.0f} s of work from cold lamps to this page"
        f" on {machine['cores']} cores.",
        goals=_goals(judged, figures),
        rows=rows,
        galleries=(
            *causes_gallery(run, figures["verification"], calibration.object_mask.shape),
            *light_gallery(calibration, crop),
            _frames_gallery(judged, checked),
        ),
        troubles=tuple(trouble["sentence"] for trouble in figures["troubles"]),
        steps=spent(steps),
        facts=_facts(checked, calibration, figures),
    )


def _cropped(image: Any, crop: Crop) -> Any:
    return np.ascontiguousarray(image[crop.rows, crop.columns])


def _row(appearance: AppearanceComparison, before: Any, calibration: Calibration, crop: Crop) -> PictureRow:
    mask = appearance.solved.requested.reachable & calibration.object_mask

    def screen(image: FloatImage) -> Any:
        return _cropped(to_screen(image, calibration.camera_to_xyz, white=appearance.solved.exposure), crop)

    def error(comparison: Comparison) -> Any:
        return _cropped(error_picture(comparison.error_map, mask), crop)

    outside = ~calibration.object_mask[..., None]
    requested = appearance.solved.requested.target
    target = np.where(outside, calibration.black, requested).astype(np.float32)
    return PictureRow(
        title=appearance.title,
        near=nearness(appearance.ours.delta_e00_median, float(str(appearance.solved.figures["reachable_share"]))),
        figures=(
            *judged_rows(appearance.judged),
            *as_rows(appearance.alone, appearance.ours),
            ("solved", f"{float(str(appearance.solved.figures['seconds'])):.2f} s"),
            *refined_row(appearance.solved.figures.get("refined")),
        ),
        pictures=(
            ReportPicture("Before", before, "in white light"),
            ReportPicture("Target", screen(target)),
            ReportPicture("Achieved", screen(appearance.photograph), "photograph"),
            ReportPicture("Error", error(appearance.ours)),
            ReportPicture("Traditional", screen(appearance.alone.photograph), "one projector, photograph"),
            ReportPicture("Its error", error(appearance.alone.figures)),
        ),
    )


def _goals(judged: Sequence[AppearanceComparison], figures: Mapping[str, Any]) -> tuple[Goal, ...]:
    worst = max(appearance.ours.delta_e00_median for appearance in judged)
    compared = {appearance.title: (appearance.alone, appearance.ours) for appearance in judged}
    swaps, bundle = figures["playback"]["swaps_per_s"], figures["bundle"]
    grades = "grade " + max(row["grade"] for row in figures["verification"].values())
    predicted = max(row["relative_rms"] for row in figures["verification"].values())
    return (
        Goal("Worst median colour difference", f"{worst:.2f}", f"at most {GOAL_DELTA_E:g}", worst <= GOAL_DELTA_E),
        *one_projector_goals(compared),
        # A swap that comes one tick late in some seconds of playing is no missed goal.
        Goal("Swaps", f"{swaps:.1f} a second", f"{GOAL_SWAPS_PER_S:g}", swaps >= 0.995 * GOAL_SWAPS_PER_S),
        Goal("Calibration", grades, note=f"random patterns predicted to {100 * predicted:.1f} %"),
        shape_goal(figures),
        Goal("Bundle", f"{bundle['bytes'] / 1e6:.2f} MB", note=f"{bundle['ratio']:.1f} x smaller, signed"),
    )  # fmt: skip


def _frames_gallery(
    judged: Sequence[AppearanceComparison], checked: Checked
) -> tuple[str, str, tuple[ReportPicture, ...]]:
    first = judged[0]
    pictures = tuple(
        ReportPicture(name, fitted(first.solved.frames[name], longest_px=480), f"for {first.title}")
        for name in checked.names
    )
    return "Compensation images", "The projectors' frames as 8-bit values.", pictures


def _facts(checked: Checked, calibration: Calibration, figures: Mapping[str, Any]) -> dict[str, str]:
    rows, columns = calibration.object_mask.shape
    sizes = {f"{p.metapixels.valid.shape[1]}x{p.metapixels.valid.shape[0]}" for p in calibration.projectors}
    return {
        "Projectors": f"{len(calibration.projectors)} of {', '.join(sorted(sizes))}",
        "Camera": f"{columns}x{rows}",
        "Metapixels": f"{figures['metapixels']['fitted']}",
        "Photographs": f"{figures['captures']['count']} in {figures['captures']['seconds']:.0f} s",
        "Base solve": f"{figures['solve']['iterations']} iterations, {figures['solve']['seconds']:.1f} s",
        "Player memory": f"{figures['playback']['rss_bytes'] / 1e6:.0f} MB",
        "Machine": f"{figures['machine']['cores']} cores, {figures['machine']['memory_bytes'] / 2**30:.0f} GiB",
    }
