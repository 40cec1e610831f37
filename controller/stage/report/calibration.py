"""The report of one calibration: report.html and report.json in its run's folder, and pictures for the panel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import tzinfo
from functools import partial
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from controller.bundle.describe import png
from controller.core import channels
from controller.core.arrays import ByteImage, FloatImage
from controller.core.errors import UsageError
from controller.core.storage import write_atomically
from controller.optics.calibrate.values import Calibration
from controller.run.journal import Journal
from controller.run.step_id import StepId
from controller.stage.artefacts.calibration import read_calibration
from controller.stage.artefacts.geometry import known_points_m, read_geometry_figures, read_shape
from controller.stage.artefacts.grade import (
    BEFORE,
    RESOLUTION,
    errors_by_view,
    graded,
    is_graded,
    passes,
    read_error_maps,
    read_grade_figures,
    read_troubles,
    trouble_row,
    worst_letter,
    worst_of,
)
from controller.stage.artefacts.names import REPORT_PAGE
from controller.stage.artefacts.pattern_plans import patterns_figures, photographs_sentence
from controller.stage.artefacts.projectors import PixelFigures, read_radiometry_figures
from controller.stage.artefacts.views import VIEWS, view_folders
from controller.stage.report import plots
from controller.stage.report.galleries import causes_gallery, light_gallery, views_gallery, whites
from controller.stage.report.page import Goal, Page, PageTable, ReportPicture, write_report
from controller.stage.report.pictures import Crop, crop_around, fitted, to_screen
from controller.stage.report.words import SUPERPOSITION, When, moment, spent

COMPARED: Final = 3
SHOWN_RUNS: Final = 12
LONGEST_PX: Final = 960
OUTLINE: Final = (230, 159, 0)
"""Colour of the line around what counts as the object."""


@dataclass(frozen=True, slots=True)
class StageDescription:
    """What stage.toml says: the stage's name, its projectors in order, and the largest error in per cent.

    ``zone`` of the times in the report; None: the computer's.
    """

    stage: str
    projectors: tuple[str, ...]
    worst_grade: float
    zone: tzinfo | None = None


def write_calibration_report(run: Path, asked: StageDescription, out: Path | None = None) -> Path:
    """Write the report of the graded calibration in ``run`` into ``out`` (else the run's folder); the page's path.

    Leaves before.png and resolution.png in the run's folder, for the panel. Raises UsageError("run-not-graded").
    """
    if not is_graded(run):
        raise UsageError("run-not-graded", what=f"{run.name} has no grade, so there is nothing to report.",
                         remedy="Give the folder of a finished calibration.")  # fmt: skip
    calibration = read_calibration(run, asked.projectors)
    crop = crop_around(calibration.object_mask)
    # Beside a view that is not the first there are the other views of its run.
    earlier = [one for one in graded_runs(run.parent) if one.name < run.name and run.parent.name != VIEWS]
    earlier = earlier[-SHOWN_RUNS + 1 :]
    figures = figures_of(run, asked.projectors)
    views = view_folders(run)
    for folder in views.values():
        if folder != run:
            write_calibration_report(folder, asked)
    last = [figures_of(one, asked.projectors) for one in earlier[-COMPARED:]]
    before, resolution = _white(calibration, crop), resolution_px(calibration)
    _keep(run / BEFORE, before)
    fine = plots.field(_cut(resolution, crop), "camera pixels, smaller is finer", least=0)
    _keep(run / RESOLUTION, fine)
    when = partial(moment, zone=asked.zone)
    page = Page(
        title=f"{asked.stage}: calibration of {when(run.name)}",
        summary=f"{figures['photographs']} photographs, {figures['seconds']:.0f} s of work. "
        f"By projector: {photographs_sentence(run, asked.projectors)}.{_apart(figures['colours_px'])}"
        + (f" {SUPERPOSITION}" if len(asked.projectors) == 1 else ""),
        goals=_goals(run, figures, asked.worst_grade),
        rows=(),
        tables=(*_views(run, views), _compared(run, figures, earlier[-COMPARED:], last, when)),
        troubles=tuple(trouble["sentence"] for trouble in figures["troubles"]),
        galleries=(
            ("Maps", "Cropped to the object; dark where nothing is known.",
             (ReportPicture("Before", before, "all projectors at white; a line around what counts as the object"),
              *_maps(run, calibration, crop, fine))),
            *causes_gallery(run, figures["verification"], calibration.object_mask.shape),
            *light_gallery(calibration, crop),
            *views_gallery(run, asked.projectors),
            ("Plots", "", _plots(run, calibration, earlier, asked.worst_grade, figures, when)),
        ),
        steps=spent(_steps(run)),
    )  # fmt: skip
    html, _ = write_report(out or run, page, figures)
    return html


def _views(run: Path, views: Mapping[str, Path]) -> tuple[PageTable, ...]:
    """The error of each projector in each view, and where the view's own report is; () for the only view."""
    if len(views) == 1:
        return ()
    errors = errors_by_view(run)
    names = dict.fromkeys(name for of_view in errors.values() for name in of_view)
    named = [(name, [f"{errors.get(view, {}).get(name, np.nan):.2f} %" for view in views]) for name in names]
    reports = [str((folder / REPORT_PAGE).relative_to(run)) for folder in views.values()]
    rows = (*((f"Error of {name}", *values) for name, values in named), ("Report", *reports))
    return (PageTable("Views", ("", *views), rows),)


def graded_runs(runs: Path) -> list[Path]:
    """Every run with a grade, oldest first."""
    return sorted(run for run in runs.glob("*") if is_graded(run) and (run / Journal.FILE).exists())


def figures_of(run: Path, projectors: Sequence[str]) -> dict[str, Any]:
    """What report.json holds of a calibration; docs/reference/report.md says what each is."""

    with Journal(run) as journal:
        steps, shots = journal.steps(), journal.shot_count()
    geometry = read_geometry_figures(run)
    pixels = {name: PixelFigures.read(run, name) for name in projectors}
    return {
        "run": run.name,
        "photographs": shots,
        "patterns": {name: patterns_figures(run, name) for name in projectors},
        "seconds": sum(steps.values()),
        "geometry": {key: geometry.get(key) for key in ("reprojection_rms_px", "shape_rel_sigma", "inlier_share")},
        "shape": asdict(read_shape(run)),
        "metapixels": {name: None if one is None else one.fitted for name, one in pixels.items()},
        "colours_px": {name: None if one is None else one.colours_px for name, one in pixels.items()},
        "radiometry": {name: read_radiometry_figures(run, name) for name in projectors},
        "verification": read_grade_figures(run),
        "views": {name: read_grade_figures(of) for name, of in view_folders(run).items() if of != run},
        "troubles": [trouble_row(trouble) for trouble in read_troubles(run)],
        "steps": {str(step): seconds for step, seconds in steps.items()},
    }


def _apart(colours_px: Mapping[str, Sequence[tuple[float, float]] | None]) -> str:
    """For people: by how many pixels colours lie beside green, where frames correct it; "" where they nowhere do."""
    parts = [f"{name} red {np.hypot(*apart[0]):.2f}, blue {np.hypot(*apart[2]):.2f}"
             for name, apart in colours_px.items() if apart is not None]  # fmt: skip
    return f" Colours beside green, corrected, in pixels: {'; '.join(parts)}." if parts else ""


def _steps(run: Path) -> Mapping[StepId, float]:
    with Journal(run) as journal:
        return journal.steps()


def resolution_px(calibration: Calibration) -> FloatImage:
    """(rows, columns): the size of the finest metapixel around each camera pixel, NaN off the object."""
    shape = calibration.object_mask.shape
    finest = np.full(shape, np.inf, np.float32)
    for part in calibration.projectors:
        valid = part.metapixels.valid
        at = np.rint(part.metapixels.centre_px[valid]).astype(int)
        inside = (at >= 0).all(axis=1) & (at[:, 0] < shape[1]) & (at[:, 1] < shape[0])
        np.minimum.at(finest, (at[inside, 1], at[inside, 0]), size_px(part.metapixels.covariance_px2[valid])[inside])
    known = np.isfinite(finest)
    spread = np.where(known, finest, 0).astype(np.float32)
    # Between the centres, what is usual around.
    weight = cv2.GaussianBlur(known.astype(np.float32), (0, 0), 4)
    usual = cv2.GaussianBlur(spread, (0, 0), 4) / np.maximum(weight, 1e-6)
    return np.where(calibration.object_mask & (weight > 1e-3), usual, np.nan).astype(np.float32)


def size_px(covariance_px2: FloatImage) -> npt.NDArray[np.floating[Any]]:
    """Standard deviations of Gaussians from their (..., 3) covariances xx, xy, yy: that of a round one as large."""
    xx, xy, yy = np.moveaxis(np.asarray(covariance_px2, np.float64), -1, 0)
    return np.asarray(np.maximum(xx * yy - xy * xy, 0) ** 0.25)


def _white(calibration: Calibration, crop: Crop) -> ByteImage:
    lit = np.asarray(sum(whites(calibration), start=calibration.black), np.float32)
    level = float(np.nanpercentile(lit[calibration.object_mask], 99))
    screen = to_screen(lit, calibration.camera_to_xyz, white=level)
    around, _ = cv2.findContours(
        calibration.object_mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )  # fmt: skip
    cv2.drawContours(screen, around, -1, OUTLINE, max(2, round(max(screen.shape) / LONGEST_PX)))
    return fitted(_cut(screen, crop), longest_px=LONGEST_PX)


def _cut(image: Any, crop: Crop) -> Any:
    return np.ascontiguousarray(image[crop.rows, crop.columns])


def _keep(path: Path, picture: ByteImage) -> None:
    write_atomically(path, png(picture))


def _goals(run: Path, figures: Mapping[str, Any], limit: float) -> tuple[Goal, ...]:
    worst = worst_of(run) or (("", float("nan")))
    fitted_count = figures["metapixels"].values()
    return (
        Goal("Grade", worst_letter(run), note="of the worst projector"),
        Goal("Largest error of a prediction", f"{worst[1]:.2f} %", f"at most {limit:g} %", passes(run, limit)),
        shape_goal(figures),
        Goal("Metapixels", f"{sum(count or 0 for count in fitted_count):,}", note="with position and size"),
    )


def shape_goal(figures: Mapping[str, Any]) -> Goal:
    """The object's shape, how well it fits, and why it is not a surface; ``figures`` as ``figures_of``."""
    shape, rms = figures["shape"], figures["geometry"]["reprojection_rms_px"]
    known = shape["shape"] if rms is None else f"{shape['shape']}, {rms:.3f} px"
    fits = "as stage.toml asks" if rms is None else "rms of reprojection, projector pixels"
    return Goal("Shape", known, note=f"{shape['reason']} {shape['remedy']}" if shape["reason"] else fits)


def _compared(
    run: Path, now: Mapping[str, Any], runs: Sequence[Path], last: Sequence[Mapping[str, Any]], when: When
) -> PageTable:
    """This calibration beside the last ones, newest first."""
    both = [now, *reversed(last)]

    def row(label: str, value: Any, form: str) -> tuple[str, ...]:
        found = [value(one) for one in both]
        return (label, *("" if one is None else form.format(one) for one in found))

    rows = [
        row(f"error of {name}", lambda one, name=name: _percent(one["verification"].get(name)), "{:.2f} %")
        for name in now["verification"]
    ]
    rows += [
        row(f"metapixels of {name}", lambda one, name=name: one["metapixels"].get(name), "{:,}")
        for name in now["metapixels"]
    ]
    rows.append(row("reprojection", lambda one: one["geometry"]["reprojection_rms_px"], "{:.3f} px"))
    rows.append(row("photographs", lambda one: one["photographs"], "{}"))
    rows.append(row("work", lambda one: one["seconds"], "{:.0f} s"))
    header = ("", f"{when(run.name)} (this one)", *(when(one.name) for one in reversed(runs)))
    title = "Compared with the last calibrations" if runs else "This is the first calibration"
    return PageTable(title, header, tuple(rows))


def _percent(row: Mapping[str, Any] | None) -> float | None:
    return None if row is None else 100 * float(row["relative_rms"])


def _maps(run: Path, calibration: Calibration, crop: Crop, fine: ByteImage) -> tuple[ReportPicture, ...]:
    errors = read_error_maps(run)
    mask = calibration.object_mask
    lit = sum((np.asarray(channels.mean(part.white) > 0.02 * np.nanmax(part.white)) for part in calibration.projectors),
              start=np.zeros(mask.shape, int))  # fmt: skip
    light = sum((channels.mean(part.white) for part in calibration.projectors), start=np.zeros(mask.shape))
    usual = float(np.median(light[mask])) if mask.any() else 1.0
    found = [ReportPicture("Resolution", fine, "the finest metapixel nearby", large=True)]
    found.append(
        ReportPicture("Coverage", _map(lit, mask, crop, "projectors", least=0, most=len(calibration.projectors)))
    )
    relative = 100 * light / max(usual, 1e-12)
    found.append(ReportPicture("Light", _map(relative, mask, crop, "% of the usual", least=0, most=250)))
    if (points_m := known_points_m(run)) is not None:
        found.append(ReportPicture("Depth", _map(points_m[..., 2], mask, crop, "metres from the camera")))
    found += [
        ReportPicture(f"Error of {part.name}",
                _map(100 * errors[part.name].error, mask, crop, "% of the light nearby", least=0, most=15))
        for part in calibration.projectors
    ]  # fmt: skip
    return tuple(found)


def _map(values: Any, mask: Any, crop: Crop, label: str, **limits: float) -> ByteImage:
    return plots.field(_cut(np.where(mask, values, np.nan).astype(np.float32), crop), label, **limits)


def _plots(
    run: Path, calibration: Calibration, earlier: Sequence[Path], limit: float, figures: Mapping[str, Any], when: When
) -> tuple[ReportPicture, ...]:
    runs = [*earlier, run]
    grades = [graded(one) or {} for one in runs]
    names = [part.name for part in calibration.projectors]
    errors = {name: [grade.get(name, float("nan")) for grade in grades] for name in names}
    widths = {p.name: size_px(p.metapixels.covariance_px2[p.metapixels.valid]) for p in calibration.projectors}
    why = {
        name: {one["reason"]: one["error_share"] for one in row.get("reasons", [])}
        for name, row in figures["verification"].items()
    }
    return (
        ReportPicture(
            "Error over the calibrations", plots.history(errors, [when(one.name) for one in runs], limit), large=True
        ),
        ReportPicture("Response", plots.responses({p.name: p.radiometry.response for p in calibration.projectors})),
        ReportPicture("Sizes of metapixels", plots.sizes(widths), large=True),
        ReportPicture("Reasons for the remaining error", plots.reasons(why)),
    )


__all__ = ["StageDescription", "figures_of", "graded_runs", "resolution_px", "size_px", "write_calibration_report"]
