"""What appearances achieve: pictures of one run of photographs, and its report beside those before."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime, tzinfo
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from controller.core.errors import UsageError
from controller.core.storage import write_atomically
from controller.run.journal import Journal
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.comparison import Compared, all_compared, compared_in, picture_path, read_images
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.solved import Registered, read_solved
from controller.stage.report import plots
from controller.stage.report.page import (
    Goal,
    Page,
    PageTable,
    PictureRow,
    ReportPicture,
    judged_rows,
    nearness,
    refined_row,
    write_report,
)
from controller.stage.report.pictures import (
    ERROR_SCALE_DELTA_E,
    crop_around,
    encoded,
    error_picture,
    fitted,
    read_picture,
    sharpness_picture,
    to_screen,
)
from controller.stage.report.words import When, moment, spent
from controller.stage.steps.appearance.compare import compared_mask

COMPARED: Final = 3
SHOWN_RUNS: Final = 12
LONGEST_PX: Final = 960
GOAL_DELTA_E: Final = 4.0
MOST_RESIDUAL_PX: Final = 3.0
MOMENT: Final = "%d %B %Y, %H:%M"
_SHOWN: Final = (
    ("before", "Before", "in white light"),
    ("target", "Target", ""),
    ("achieved", "Achieved", "photograph"),
    ("error", "Error", "CIEDE2000"),
    ("registration", "Registration", "how far structure lies beside its place; black: none, bright: 3 camera pixels"),
    ("resolution", "Resolution", "violet: none of the target's edges are present; yellow: all; grey: too few edges"),
)
_FIGURES: Final[tuple[tuple[str, Callable[[Compared], float], str], ...]] = (
    ("median CIEDE2000", lambda one: one.delta_e00_median, "{:.2f}"),
    ("95th percentile", lambda one: one.delta_e00_p95, "{:.2f}"),
    ("rms error", lambda one: 100 * one.rmse, "{:.2f} % of white"),
    ("sharpness", lambda one: one.sharpness_lambda, "{:.2f}"),
)


def picture_steps(calibrated: Calibrated, names: Sequence[str]) -> list[Step]:
    """After ``steps.appearance.compare.compare_steps``: the pictures of each appearance, for report and panel."""
    return [
        Step(
            StepId(StepKind.PICTURES, item=name),
            partial(_draw, calibrated, name),
            after=(StepId(StepKind.COMPARE, item=name),),
            title=f"Drawing the maps of {name}",
            weight=0.3,
        )
        for name in names
    ]


def _draw(calibrated: Calibrated, name: str, context: Context) -> Sequence[Path]:
    calibration = calibrated.calibration
    solved = read_solved(calibrated.folder, name, calibrated.projectors)
    images = read_images(context.folder, name)
    (one,) = (one for one in compared_in(context.folder) if one.name == name)
    on_object, mask = calibration.object_mask, compared_mask(calibrated, solved)
    crop = crop_around(on_object)
    lit = sum((part.white for part in calibration.projectors), start=calibration.black)
    white = float(np.nanpercentile(lit[on_object], 99)) if on_object.any() else 1.0
    target = np.where(on_object[..., None], solved.requested.target, calibration.black).astype(np.float32)
    to_xyz = calibration.camera_to_xyz
    drawn = {
        "before": to_screen(lit, to_xyz, white=white),
        "target": to_screen(target, to_xyz, white=solved.exposure),
        "achieved": to_screen(images.photograph, to_xyz, white=solved.exposure),
        "error": error_picture(images.error.astype(np.float32), mask),
        "resolution": sharpness_picture(images.resolution, one.window_px, on_object.shape, mask),
    }
    if (registered := Registered.read(calibrated.folder, name)) is not None:
        residual_px = registered.residual_px.astype(np.float32)
        scaled = residual_px * (ERROR_SCALE_DELTA_E / MOST_RESIDUAL_PX)
        drawn["registration"] = error_picture(scaled, np.isfinite(residual_px))
    paths = []
    for kind, whole in drawn.items():
        path = picture_path(context.folder, name, kind)
        cut = np.ascontiguousarray(whole[crop.rows, crop.columns])
        write_atomically(path, encoded(fitted(cut, longest_px=LONGEST_PX)))
        paths.append(path)
    return paths


def write_comparison_report(run: Path, stage_name: str, out: Path | None = None, zone: tzinfo | None = None) -> Path:
    """Write report.html and report.json of a finished run into ``out`` (else its folder); the page's path.

    ``zone`` of the times in it; None: the computer's.

    Raises UsageError("run-not-compared").
    """
    found = compared_in(run)
    if not found:
        raise UsageError("run-not-compared", what=f"{run.name} has photographed no appearance.",
                         remedy="Give the folder of a run of `velatura photograph`.")  # fmt: skip
    earlier = [one for one in all_compared(run.parent.parent) if one.name < run.name][-SHOWN_RUNS + 1 :]
    before = [{one.name: one for one in compared_in(folder)} for folder in earlier]
    with Journal(run) as journal:
        steps, shots = journal.steps(), journal.shot_count()
    figures = _figures(run, found, steps, shots)
    when = partial(moment, zone=zone)
    page = Page(
        title=f"{stage_name}: what {len(found)} appearance{'s' * (len(found) > 1)} achieve{'s' * (len(found) == 1)}",
        summary=f"{figures['photographs']} photographs of {when(run.name)}, compared with the targets that were"
        f" solved on the calibration of {when(found[0].calibration)}.",
        goals=_goals(found, before),
        rows=tuple(_row(run, one, zone) for one in found),
        tables=(_beside(run.name, found, earlier[-COMPARED:], before[-COMPARED:], when),),
        galleries=_course(run.name, found, earlier, before, when),
        steps=spent(steps),
    )
    html, _ = write_report(out or run, page, figures)
    return html


def _figures(run: Path, found: Sequence[Compared], steps: Mapping[StepId, float], shots: int) -> dict[str, Any]:
    return {"run": run.name, "photographs": shots, "seconds": sum(steps.values()),
            "appearances": [asdict(one) for one in found],
            "steps": {str(step): seconds for step, seconds in steps.items()}}  # fmt: skip


def _goals(found: Sequence[Compared], before: Sequence[dict[str, Compared]]) -> tuple[Goal, ...]:
    worst = max(found, key=lambda one: one.delta_e00_median)
    blurred = min(found, key=lambda one: one.sharpness_lambda)
    return (
        Goal("Worst median colour difference", f"{worst.delta_e00_median:.2f}", f"at most {GOAL_DELTA_E:g}",
             worst.delta_e00_median <= GOAL_DELTA_E, worst.title),
        Goal("Change since the last run", *_change(found, before)),
        Goal("Least sharpness", f"{blurred.sharpness_lambda:.2f}", note=f"share of edges in common, {blurred.title}"),
    )  # fmt: skip


def _change(found: Sequence[Compared], before: Sequence[dict[str, Compared]]) -> tuple[str, str, None, str]:
    """The appearance whose median changed most since it was photographed the last time."""
    changes = []
    for one in found:
        last = next((each[one.name] for each in reversed(before) if one.name in each), None)
        if last is not None:
            changes.append((one.delta_e00_median - last.delta_e00_median, one.title))
    if not changes:
        return "nothing to compare", "", None, "first run"
    change, title = max(changes, key=lambda each: abs(each[0]))
    return f"{change:+.2f}", "", None, f"median colour difference, {title}"


def _row(run: Path, one: Compared, zone: tzinfo | None) -> PictureRow:
    known = [(label, form.format(value(one))) for label, value, form in _FIGURES]
    if one.reachable_share is not None:
        known.append(("within reach", f"{100 * one.reachable_share:.1f} % of the object"))
    known.extend(judged_rows(asdict(one)))
    known.extend(refined_row(one.refined))
    known.append(
        ("photographed", datetime.fromtimestamp(one.photographed_unix_s, UTC).astimezone(zone).strftime(MOMENT))
    )
    pictures = []
    for kind, caption, note in _SHOWN:
        image = read_picture(picture_path(run, one.name, kind))
        if image is not None:
            pictures.append(ReportPicture(caption, image, note))
    return PictureRow(one.title, nearness(one.delta_e00_median, one.reachable_share), tuple(known), tuple(pictures))


def _beside(
    name: str, found: Sequence[Compared], earlier: Sequence[Path], before: Sequence[dict[str, Compared]], when: When
) -> PageTable:
    """This run beside the last ones, newest first."""
    runs = [*reversed(before)]
    rows = [
        (one.title, *(_short(each[one.name]) if one.name in each else "" for each in ({one.name: one}, *runs)))
        for one in found
    ]
    header = ("", f"{when(name)} (this one)", *(when(folder.name) for folder in reversed(earlier)))
    comparison = "compared with earlier runs" if earlier else "first run"
    return PageTable(f"Colour difference, median and 95 %, and sharpness: {comparison}", header, tuple(rows))


def _short(one: Compared) -> str:
    return f"{one.delta_e00_median:.2f}, {one.delta_e00_p95:.2f}; {one.sharpness_lambda:.2f}"


def _course(
    name: str, found: Sequence[Compared], earlier: Sequence[Path], before: Sequence[dict[str, Compared]], when: When
) -> tuple[tuple[str, str, tuple[ReportPicture, ...]], ...]:
    if not earlier:
        return ()
    held = [*before, {one.name: one for one in found}]
    medians = {one.title: [each[one.name].delta_e00_median if one.name in each else float("nan") for each in held]
               for one in found}  # fmt: skip
    runs = [*(when(folder.name) for folder in earlier), when(name)]
    label = "median colour difference, CIEDE2000"
    drawn = plots.history(medians, runs, GOAL_DELTA_E, label=label, unit="")
    return (("How it went", "", (ReportPicture("History", drawn, large=True),)),)
