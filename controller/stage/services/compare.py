"""Photograph the installed appearances and compare them with their targets."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from controller.bundle.install import current
from controller.bundle.reader import Bundle
from controller.core.errors import UsageError
from controller.run.progress import Reporter
from controller.run.runner import Step
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.comparison import COMPARE, compared_in
from controller.stage.artefacts.solved import is_solved
from controller.stage.report.comparison import picture_steps, write_comparison_report
from controller.stage.rig.ambient_light import dark_after
from controller.stage.rig.rig import Rig
from controller.stage.sessions.calibrations import finished_calibrations, stage_trust
from controller.stage.sessions.check import Checked, check_stage, time_zone
from controller.stage.sessions.session import StageSession, StageWork
from controller.stage.steps.appearance.compare import compare_steps
from hal.notices import Level


@dataclass(frozen=True, slots=True)
class Installed:
    """The appearances of the installed bundle that can be compared, and the run with their targets."""

    bundle: str
    run: Path
    names: tuple[str, ...]


def photograph(
    *, session: StageSession, names: Sequence[str], reporter: Reporter, cancel: threading.Event
) -> Mapping[str, Any]:
    """Switch the projectors on, show each appearance of the installed bundle (or ``names``), photograph and compare it.

    Continues an unfinished run of the same day. Raises as ``installed``, and what the devices raise.
    """
    checked = check_stage(session.stage)
    found = installed(checked, names, reporter)
    calibrated = Calibrated(found.run, checked.names)

    def steps(rig: Rig, _: Path) -> Sequence[Step]:
        longest_s = checked.stage.tables.capture.longest_exposure_s
        taken = compare_steps(rig, calibrated, found.names, bundle=found.bundle, longest_exposure_s=longest_s)
        drawn = picture_steps(calibrated, found.names)
        # Each with its pictures at once, so that a stopped run has a report of its photographs.
        both = [step for pair in zip(taken, drawn, strict=True) for step in pair]
        return [*both, *dark_after(rig.ambient_limit, rig.display)]

    run = session.run(checked, StageWork(COMPARE, steps, dark=True), reporter=reporter, cancel=cancel)
    html = comparison_report(run, checked)
    rows = [
        {"name": comparison.name, "headline": comparison.headline[0], "delta_e00_median": comparison.delta_e00_median,
         "delta_e00_p95": comparison.delta_e00_p95, "rmse": comparison.rmse,
         "sharpness_lambda": comparison.sharpness_lambda}
        for comparison in compared_in(run) if comparison.name in found.names
    ]  # fmt: skip
    return {"run": str(run), "report": str(html), "appearances": rows}


def installed(checked: Checked, names: Sequence[str], reporter: Reporter) -> Installed:
    """The appearances to photograph: ``names`` in their order, or all that have a target here.

    Raises UsageError("nothing-installed", "appearance-unknown", "targets-missing"), and BundleError for a bundle that
    the stage does not trust.
    """
    folder = checked.stage.folder
    file = current(folder / "bundles")
    if file is None:
        raise UsageError("nothing-installed", what="No bundle is installed on this stage.",
                         remedy="Run `velatura appearance` on it first.")  # fmt: skip
    with Bundle.open_trusted(file, stage_trust(checked.stage)) as bundle:
        index = bundle.index
    held = [appearance.name for appearance in index.appearances]
    for name in names:
        if name not in held:
            raise UsageError("appearance-unknown", what=f"The installed bundle has no appearance {name[:64]!r}.",
                             remedy=f"Available: {', '.join(held) or 'none'}.")  # fmt: skip
    wanted = tuple(dict.fromkeys(names)) or tuple(held)
    # A bundle may come from another computer, so look for its appearances in the runs of this stage.
    run = next((finished for finished in finished_calibrations(folder) if finished.name == index.calibration), None)
    known = () if run is None else tuple(name for name in wanted if is_solved(run, name))
    missing = [name for name in wanted if name not in known]
    if run is None or not known or (names and missing):
        raise UsageError("targets-missing", what=f"This stage has no target for {', '.join(missing) or 'any'}.",
                         remedy="Run `velatura appearance` on it to solve and install them again.")  # fmt: skip
    if missing:
        reporter.say(f"Not photographed, because the target is missing: {', '.join(missing)}.", Level.WARNING)
    return Installed(file.stem, run, known)


def comparison_report(run: Path, checked: Checked, out: Path | None = None) -> Path:
    """As ``write_comparison_report``, for a run of this stage."""
    return write_comparison_report(run, checked.stage.tables.stage.name, out, time_zone(checked))
