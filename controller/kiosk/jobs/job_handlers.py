"""One handler per kind of job: it calls the same service as the command line, with the kiosk's opened devices."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from controller.core.errors import VelaturaError
from controller.kiosk.decide.interfaces import Finished, Request
from controller.kiosk.jobs.job_runner import JobHandler, JobReporter, run_name
from controller.kiosk.store import settings
from controller.kiosk.store.bundle_store import BundleStore
from controller.run.progress import Phase, Progress, Reporter
from controller.stage.rig.rig import Rig
from controller.stage.sessions.calibrations import stage_trust
from controller.stage.sessions.check import check_stage
from controller.stage.sessions.session import BorrowedSession, StageSession
from hal.deadline import in_seconds
from hal.notices import Level, Notice


@dataclass(frozen=True, slots=True)
class Published:
    """``names`` are in the new bundle (empty: there is none); ``failed``: the reason for each other one."""

    names: tuple[str, ...]
    failed: Mapping[str, str]

    @property
    def failures(self) -> str:
        """One sentence for each."""
        return " ".join(f"{name} was not solved: {why}" for name, why in self.failed.items())


def publish_appearances(session: StageSession, *, reporter: Reporter, cancel: threading.Event) -> Published:
    """Solve the appearances of stage.toml on the newest calibration.

    Raises what ``services.calibrate.make_appearances`` raises if no appearance can be solved, and Cancelled.
    """
    from controller.stage.services.calibrate import AppearanceOrder, make_appearances

    names, failed = _checked(session.stage)
    if failed and not names:
        return Published((), failed)

    def make(subset: Sequence[str]) -> None:
        make_appearances(AppearanceOrder(names=subset), session=session, reporter=reporter, cancel=cancel)

    try:
        make(names)
    except VelaturaError as error:
        if len(names) < 2:
            raise
        first_error = error
    else:
        return Published(names, failed)
    # Find out which ones fail; finished solutions are reused.
    made = []
    for name in names:
        try:
            make((name,))
            made.append(name)
        except VelaturaError as error:
            failed[name] = f"{error.what} {error.remedy}"
    if not made:
        raise first_error
    return Published(tuple(made), failed)


def _checked(stage: Path) -> tuple[tuple[str, ...], dict[str, str]]:
    """The appearances of stage.toml that can be solved, and why the others can't."""
    from controller.stage.artefacts.calibrated import all_views
    from controller.stage.sessions.calibrations import finished_calibration
    from controller.stage.steps.appearance.requests import requests_of

    checked = check_stage(stage)
    calibrated = all_views(finished_calibration(checked.stage.folder), checked.names)
    names, failed = [], {}
    for table in checked.stage.tables.appearances:
        try:
            requests_of(checked.stage, calibrated, (table.name,))
            names.append(table.name)
        except VelaturaError as error:
            failed[table.name] = f"{error.what} {error.remedy}"
    return tuple(names), failed


AIM_S: Final = 300.0
QUICK: Final = Request("quick", light=True)
PUBLISH: Final = Request("publish")
REPORT: Final = Request("report")
COMPARE: Final = Request("compare", light=True)
VARIANTS: Final = Request("variants")

LendRig = Callable[[], AbstractContextManager[Rig]]
"""Lends the opened devices to a job; raises DeviceError if one is missing."""


class JobHandlers:
    """``missing_device``: the device that photographs need and that is missing; ``calibrated``: whether the stage has a
    calibration; ``open_now``: whether it is open by its schedule. All answer from memory.
    """

    def __init__(
        self,
        stage: Path,
        lend: LendRig,
        *,
        missing_device: Callable[[], Notice | None],
        calibrated: Callable[[], bool],
        open_now: Callable[[], bool] = lambda: False,
    ) -> None:
        self._stage, self.lend = stage, lend
        self.missing_device, self.calibrated, self._open_now = missing_device, calibrated, open_now

    def table(self) -> dict[str, JobHandler]:
        """Every kind by its name."""
        lit, known = self._needs_camera, self._needs_calibration
        return {
            "aim": JobHandler(self._aim, lambda request: self.missing_device()),
            "drift": JobHandler(self._drift, lit),
            "quick": JobHandler(self._quick, lit),
            "projector": JobHandler(self._projector, lit),
            "full": JobHandler(self._full, lambda request: self.missing_device()),
            "compare": JobHandler(self._compare, lit),
            "publish": JobHandler(self._publish, known),
            "compute": JobHandler(self._publish, known),
            "report": JobHandler(self._report),
            "takeover": JobHandler(self._takeover, known),
            "variants": JobHandler(self._variants, known),
        }

    def _needs_calibration(self, request: Request) -> Notice | None:
        if self.calibrated():
            return None
        return Notice("not-calibrated", "This stage has no finished calibration.", "Calibrate it first.", Level.ERROR)

    def _needs_camera(self, request: Request) -> Notice | None:
        return self.missing_device() or self._needs_calibration(request)

    # -- jobs that need the lamps

    @contextlib.contextmanager
    def _borrowed(self) -> Iterator[BorrowedSession]:
        with self.lend() as rig:
            yield BorrowedSession(self._stage, rig)

    def _drift(self, request: Request, reporter: JobReporter, cancel: threading.Event) -> Finished:
        from controller.stage.services.recalibrate import check_drift

        with self.lend() as rig:
            result = check_drift(
                session=BorrowedSession(self._stage, rig), details=True, reporter=reporter, cancel=cancel, skew=None
            )
        reporter.job = replace(reporter.job, run=run_name(result))
        advice = str(result["advice"])
        if advice == "nothing":
            return Finished(request, Notice("drift-none", "Nothing has moved or dimmed since the calibration."))
        if advice == "look":
            return Finished(request, Notice("drift-look", "The drift check could not determine what has changed.",
                                              "Check the stage, then recalibrate.", Level.WARNING))  # fmt: skip
        changed = Notice.warning("drift-found", "The stage has changed since its calibration.",
                                 "A quick recalibration follows.")  # fmt: skip
        return Finished(request, changed, then=(replace(QUICK, key=request.key),))

    def _aim(self, request: Request, reporter: JobReporter, cancel: threading.Event) -> Finished:
        from controller.stage.steps.capture.aiming import take_test_shots

        began_s = time.monotonic()

        def advance(share: float, note: str) -> None:
            left_s = None if share <= 0 else (time.monotonic() - began_s) * (1 - share) / share
            running = Progress(
                "Test shots", 0, 1, Phase.RUNNING, share, share, time.monotonic() - began_s, left_s, note
            )
            reporter.progress(running)

        capture = check_stage(self._stage).stage.tables.capture
        with self.lend() as rig:
            take_test_shots(rig, longest_exposure_s=capture.longest_exposure_s,
                            deadline=in_seconds(AIM_S, cancel), advance=advance)  # fmt: skip
        return Finished(request, Notice("aimed", "The test shots are done. See the aiming page."))

    def _quick(self, request: Request, reporter: JobReporter, cancel: threading.Event) -> Finished:
        from controller.stage.services.recalibrate import recalibrate

        with self._borrowed() as session:
            result = recalibrate(session=session, reporter=reporter, cancel=cancel)
        return self._after_calibration(request, reporter, result)

    def _projector(self, request: Request, reporter: JobReporter, cancel: threading.Event) -> Finished:
        from controller.stage.services.recalibrate import recalibrate

        (name,) = request.arguments
        with self.lend() as rig:
            result = recalibrate(
                session=BorrowedSession(self._stage, rig), projector=name, reporter=reporter, cancel=cancel
            )
        return self._after_calibration(request, reporter, result)

    def _full(self, request: Request, reporter: JobReporter, cancel: threading.Event) -> Finished:
        from controller.stage.services.calibrate import calibrate

        with self._borrowed() as session:
            result = calibrate(session=session, reporter=reporter, cancel=cancel)
        return self._after_calibration(request, reporter, result)

    def _after_calibration(self, request: Request, reporter: JobReporter, result: object) -> Finished:
        assert isinstance(result, dict)
        reporter.job = replace(reporter.job, run=run_name(result))
        done = Notice("calibrated", "The stage is recalibrated.")
        report = replace(REPORT, arguments=(reporter.job.run,))
        if not (tables := check_stage(self._stage).stage.tables).appearances:
            return Finished(request, done, then=(report,))
        # Last, so that a lamp that does not light again affects no other job.
        last = (replace(COMPARE, key=f"photographs after {request.key}"),)
        wanted = request.key and tables.calibration.photograph_at_night
        return Finished(request, done, then=(replace(PUBLISH, key=request.key), report, *(last if wanted else ())))

    def _compare(self, request: Request, reporter: JobReporter, cancel: threading.Event) -> Finished:
        from controller.stage.services.compare import photograph

        if request.key and self._open_now():
            return Finished(request, Notice("photographs-left-out", "The appearances were not photographed, because"
                                              " the stage opened in the meantime.", "", Level.WARNING))  # fmt: skip
        with self.lend() as rig:
            result = photograph(
                session=BorrowedSession(self._stage, rig), names=request.arguments, reporter=reporter, cancel=cancel
            )
        reporter.job = replace(reporter.job, run=run_name(result))
        worst = max(result["appearances"], key=lambda row: float(row["headline"]))
        names = ", ".join(row["name"] for row in result["appearances"])
        text = (f"Photographed: {names}. The largest median colour difference of a whole object is"
                f" {worst['headline']:.2f}, of {worst['name']}.")  # fmt: skip
        return Finished(request, Notice("photographed", text, "See the results."))

    # -- jobs that do not

    def _publish(self, request: Request, reporter: JobReporter, cancel: threading.Event) -> Finished:

        made = publish_appearances(BorrowedSession(self._stage), reporter=reporter, cancel=cancel)
        installed = (
            f"A new bundle is installed: {', '.join(made.names)}." if made.names else "No new bundle was installed."
        )
        then = (VARIANTS,) if made.names and self._several() else ()
        if not made.failed:
            return Finished(request, Notice("published", installed), then=then)
        text = f"{made.failures} {self._remove_failed(request, made.failed)}{installed}"
        failed = not made.names or any(name in made.failed for name in request.arguments)
        return Finished(request, Notice("appearance-failed", text, "", Level.ERROR), failed=failed, then=then)

    def _remove_failed(self, request: Request, failed: Mapping[str, str]) -> str:
        """Remove a new appearance that can't be solved from stage.toml: no page of the panel could remove it."""
        removed = [name for name in request.arguments if name in failed and name not in self._installed()]
        for name in removed:
            settings.remove_picture(self._stage, name)
        return f"Removed from stage.toml again: {', '.join(removed)}. " if removed else ""

    def _installed(self) -> Sequence[str]:
        return BundleStore(self._stage, stage_trust(check_stage(self._stage).stage)).names()

    def _report(self, request: Request, reporter: JobReporter, cancel: threading.Event) -> Finished:
        from controller.stage.services.report import calibration_report

        (run,) = request.arguments
        calibration_report(self._stage / "runs" / run, check_stage(self._stage))
        return Finished(request, Notice("reported", f"The report of {run} is written. See the results."))

    def _several(self) -> bool:
        return len(check_stage(self._stage).names) > 1

    def _variants(self, request: Request, reporter: JobReporter, cancel: threading.Event) -> Finished:
        names = check_stage(self._stage).names
        self._solve([(name,) for name in names], reporter, cancel)
        return Finished(request, Notice("variants-solved", "Frames for the loss of any single projector are ready."))

    def _takeover(self, request: Request, reporter: JobReporter, cancel: threading.Event) -> Finished:
        self._solve([request.arguments], reporter, cancel)
        names = ", ".join(request.arguments)
        return Finished(request, Notice("takeover-solved", f"Frames without {names} are ready."))

    def _solve(self, sets: Sequence[tuple[str, ...]], reporter: JobReporter, cancel: threading.Event) -> None:
        from controller.kiosk.jobs.failover import solve_without

        for missing in sets:
            solve_without(BorrowedSession(self._stage), missing, reporter=reporter, cancel=cancel)
