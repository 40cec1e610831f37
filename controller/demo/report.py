"""What a demo measured, gathered from its run folder into report.html and report.json."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from controller.arrays import FloatImage, Mask, load_arrays
from controller.calibrate.values import Calibration
from controller.checking import Checked, check_stage
from controller.errors import UsageError
from controller.report.page import Goal, Page, Picture, Row, write_report
from controller.report.pictures import Crop, crop_around, error_picture, fitted, to_screen
from controller.session.calibrating import read_calibration
from controller.session.grading import PICTURE
from controller.session.journal import Journal
from controller.session.solving import Solved, read_solved
from controller.solve.metrics import Comparison, compare

GOAL_DELTA_E = 4.0
GOAL_TIMES_BETTER = 3.0
GOAL_SWAPS_PER_S = 60.0
CAPTURE_STEPS = ("exposure", "black", "light-", "codes-")


@dataclass(frozen=True, slots=True)
class Judged:
    """One appearance beside its target, by us and the traditional way."""

    name: str
    title: str
    solved: Solved
    photograph: FloatImage
    traditional: FloatImage
    ours: Comparison
    theirs: Comparison

    @property
    def times_better(self) -> float:
        return self.theirs.delta_e00_median / max(self.ours.delta_e00_median, 1e-9)


def write_demo_report(out: Path, run: Path, checked: Checked) -> tuple[Path, Path]:
    """Write ``report.html`` and ``report.json`` of a finished demo run into ``out``."""
    calibration = read_calibration(run, checked.names)
    names = [table.name for table in checked.stage.tables.appearances]
    judged = [_judge(run, name, calibration, checked.names) for name in names]
    with Journal(run) as journal:
        steps, shots = journal.steps(), journal.shot_count()
    figures = _figures(run, checked.names, judged, steps, shots)
    return write_report(out, _page(run, checked, calibration, judged, figures, steps), figures)


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
    kinds = ("appearance", "photograph", "traditional")
    names = [table.name for table in checked.stage.tables.appearances]
    if not done or not all((run / f"{kind}-{name}.npz").exists() for kind in kinds for name in names):
        raise UsageError(
            "run-not-finished",
            what=f"{run} is no demo that has photographed every appearance of stage.toml.",
            remedy="Run `velatura demo` with the same --out again: it goes on and writes the report.",
        )
    html, figures = write_demo_report(out, run, checked)
    return {"report": str(html), "figures": str(figures)}


def _judge(run: Path, name: str, calibration: Calibration, projectors: Sequence[str]) -> Judged:
    solved = read_solved(run, name, projectors)
    photograph = load_arrays(run / f"photograph-{name}.npz")["photograph"]
    traditional = load_arrays(run / f"traditional-{name}.npz")["photograph"]
    mask: Mask = solved.reachable & calibration.object_mask

    def against(picture: FloatImage) -> Comparison:
        return compare(picture, solved.target, calibration.camera_to_xyz, solved.exposure, mask)

    title = str(solved.figures["title"])
    return Judged(name, title, solved, photograph, traditional, against(photograph), against(traditional))


def _figures(
    run: Path, projectors: Sequence[str], judged: Sequence[Judged], steps: Mapping[str, float], shots: int
) -> dict[str, Any]:
    def read(name: str) -> Any:
        return json.loads((run / name).read_text())

    geometry, base = read("geometry.json"), read("base.json")
    pixels = {name: read(f"pixels-{name}.json") for name in projectors}
    captured = {name: seconds for name, seconds in steps.items() if name.startswith(CAPTURE_STEPS)}
    bundle, playback = read("bundle.json"), read("playback.json")
    return {
        "captures": {"count": shots, "seconds": sum(captured.values())},
        "geometry": {key: geometry[key] for key in ("reprojection_rms_px", "shape_rel_sigma", "inlier_share")},
        "radiometry": {name: read(f"radiometry-{name}.json") for name in projectors},
        "metapixels": {
            "fitted": sum(row["fitted"] for row in pixels.values()),
            "failed": sum(row["pixels"] - row["fitted"] for row in pixels.values()),
            "seconds": sum(steps.get(f"pixels-{name}", 0.0) for name in projectors),
        },
        "verification": read("verification.json"),
        "solve": {key: base[key] for key in ("seconds", "iterations", "objective", "kkt")},
        "appearances": [_appearance_figures(one) for one in judged],
        "bundle": {"bytes": bundle["bytes"], "ratio": bundle["ratio"]},
        "playback": playback,
        "machine": {
            "cores": len(os.sched_getaffinity(0)),
            "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        },
        "seconds": sum(steps.values()),
    }


def _appearance_figures(one: Judged) -> dict[str, Any]:
    return {
        "name": one.name,
        "mode": one.solved.figures["mode"],
        "seconds": one.solved.figures["seconds"],
        "delta_e00_median": one.ours.delta_e00_median,
        "delta_e00_p95": one.ours.delta_e00_p95,
        "rmse": one.ours.rmse,
        "sharpness_lambda": one.ours.sharpness_lambda,
        "reachable_share": one.solved.figures["reachable_share"],
        "traditional": {
            "delta_e00_median": one.theirs.delta_e00_median,
            "delta_e00_p95": one.theirs.delta_e00_p95,
            "rmse": one.theirs.rmse,
            "sharpness_lambda": one.theirs.sharpness_lambda,
        },
        "times_better": one.times_better,
    }


def _page(
    run: Path,
    checked: Checked,
    calibration: Calibration,
    judged: Sequence[Judged],
    figures: Mapping[str, Any],
    steps: Mapping[str, float],
) -> Page:
    crop = crop_around(calibration.object_mask)
    lit = sum((part.white for part in calibration.projectors), start=calibration.black)
    white = float(np.percentile(lit[calibration.object_mask], 99))
    before = _cropped(to_screen(lit, calibration.camera_to_xyz, white=white), crop)
    rows = tuple(_row(one, before, calibration, crop) for one in judged)
    count, machine = figures["captures"]["count"], figures["machine"]
    return Page(
        title=f"{checked.stage.tables.stage.name}: {len(judged)} appearances",
        summary=f"{count} photographs, {figures['seconds']:.0f} s of work from cold lamps to this page"
        f" on {machine['cores']} cores.",
        goals=_goals(judged, figures),
        rows=rows,
        galleries=(*_verification_gallery(run, figures), _frames_gallery(judged, checked)),
        steps=tuple(steps.items()),
        facts=_facts(checked, calibration, figures),
    )


def _cropped(image: Any, crop: Crop) -> Any:
    return np.ascontiguousarray(image[crop.rows, crop.columns])


def _row(one: Judged, before: Any, calibration: Calibration, crop: Crop) -> Row:
    mask = one.solved.reachable & calibration.object_mask

    def screen(image: FloatImage) -> Any:
        return _cropped(to_screen(image, calibration.camera_to_xyz, white=one.solved.exposure), crop)

    def error(comparison: Comparison) -> Any:
        return _cropped(error_picture(comparison.error_map, mask), crop)

    outside = ~calibration.object_mask[..., None]
    target = np.where(outside, calibration.black, one.solved.target).astype(np.float32)
    return Row(
        title=one.title,
        figures=(
            ("median CIEDE2000", f"{one.ours.delta_e00_median:.2f}"),
            ("95th percentile", f"{one.ours.delta_e00_p95:.2f}"),
            ("traditional, median", f"{one.theirs.delta_e00_median:.2f}"),
            ("times better", f"{one.times_better:.1f}"),
            ("within reach", f"{100 * float(np.asarray(one.solved.figures['reachable_share'])):.1f} % of the object"),
            ("solved", f"{one.solved.figures['mode']}, {float(str(one.solved.figures['seconds'])):.2f} s"),
        ),
        pictures=(
            Picture("Before", before, "all projectors at white"),
            Picture("Target", screen(target)),
            Picture("Achieved", screen(one.photograph), "photograph"),
            Picture("Error", error(one.ours)),
            Picture("Traditional", screen(one.traditional), "one projector, photograph"),
            Picture("Its error", error(one.theirs)),
        ),
    )


def _goals(judged: Sequence[Judged], figures: Mapping[str, Any]) -> tuple[Goal, ...]:
    worst = max(one.ours.delta_e00_median for one in judged)
    least = min(one.times_better for one in judged)
    swaps, bundle = figures["playback"]["swaps_per_s"], figures["bundle"]
    grades = "grade " + max(row["grade"] for row in figures["verification"].values())
    predicted = max(row["relative_rms"] for row in figures["verification"].values())
    return (
        Goal("Worst median colour difference", f"{worst:.2f}", f"at most {GOAL_DELTA_E:g}", worst <= GOAL_DELTA_E),
        Goal(
            "Least gain over one projector", f"{least:.1f} times", f"{GOAL_TIMES_BETTER:g} times",
            least >= GOAL_TIMES_BETTER,
        ),
        # A swap that comes one tick late in some seconds of playing is no missed goal.
        Goal("Swaps", f"{swaps:.1f} a second", f"{GOAL_SWAPS_PER_S:g}", swaps >= 0.995 * GOAL_SWAPS_PER_S),
        Goal("Calibration", grades, note=f"random patterns predicted to {100 * predicted:.1f} %"),
        Goal(
            "Geometry", f"{figures['geometry']['reprojection_rms_px']:.3f} px", note="rms of reprojection, projector px"
        ),
        Goal("Bundle", f"{bundle['bytes'] / 1e6:.2f} MB", note=f"{bundle['ratio']:.1f} x smaller, signed"),
    )  # fmt: skip


def _verification_gallery(run: Path, figures: Mapping[str, Any]) -> tuple[tuple[str, str, tuple[Picture, ...]], ...]:
    """Where each projector's prediction errs, and why; nothing for a run from before there was such a map."""
    verification = figures["verification"]
    whole = cv2.imread(str(run / PICTURE))
    if whole is None:
        return ()
    panels = np.split(np.asarray(whole[..., ::-1], np.uint8), len(verification), axis=0)
    pictures = tuple(
        Picture(
            f"{name}: {100 * row['relative_rms']:.2f} % error.",
            np.ascontiguousarray(panel),
            " ".join(reason["sentence"] for reason in row.get("reasons", [])[:3]),
        )
        for (name, row), panel in zip(verification.items(), panels, strict=True)
    )
    text = (
        "A random pattern was predicted and photographed. Colours show where the two differ by more than 5 % of the "
        "light around, and the reason that the data give; grey is fine."
    )
    return (("Where the calibration is not good, and why", text, pictures),)


def _frames_gallery(judged: Sequence[Judged], checked: Checked) -> tuple[str, str, tuple[Picture, ...]]:
    first = judged[0]
    pictures = tuple(
        Picture(name, fitted(first.solved.frames[name], longest_px=480), f"for {first.title}") for name in checked.names
    )
    return "Compensation images", "What the projectors show, as their 8-bit values.", pictures


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
