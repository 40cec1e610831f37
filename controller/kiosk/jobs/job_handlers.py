"""The kinds of work of a kiosk: each calls the service that the command line calls, on the stage that is held open."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Final

from controller.kiosk.decide.interfaces import Finished, Request
from controller.kiosk.jobs.job_runner import JobReporter, Kind, run_name
from controller.kiosk.store import settings
from controller.kiosk.store.bundle_store import BundleStock
from controller.kiosk.store.event_log import Decision
from controller.rig.rig import Rig
from controller.run.progress import Phase, Progress
from controller.stage.calibrations import stage_trust
from controller.stage.check import check_stage
from controller.stage.session import BorrowedSession
from hal.deadline import in_seconds

AIM_S: Final = 300.0
QUICK: Final = Request("quick", light=True)
PUBLISH: Final = Request("publish")
REPORT: Final = Request("report")
COMPARE: Final = Request("compare", light=True)
VARIANTS: Final = Request("variants")

LendRig = Callable[[], AbstractContextManager[Rig]]
"""Gives the opened devices for a piece of work; raises DeviceError for one that is missing."""


class Kinds:
    """``missing_device`` says which device is away that photographs need; ``calibrated``: whether anything is, and
    ``open_now``: whether the stage is open by its hours. All from memory.
    """

    def __init__(
        self,
        stage: Path,
        lend: LendRig,
        *,
        missing_device: Callable[[], Decision | None],
        calibrated: Callable[[], bool],
        open_now: Callable[[], bool] = lambda: False,
    ) -> None:
        self._stage, self._lend = stage, lend
        self._missing_device, self._calibrated, self._open_now = missing_device, calibrated, open_now

    def table(self) -> dict[str, Kind]:
        """Every kind by its name."""
        lit, known = self._needs_camera, self._needs_calibration
        return {
            "aim": Kind(self._aim, lambda request: self._missing_device()),
            "drift": Kind(self._drift, lit),
            "quick": Kind(self._quick, lit),
            "projector": Kind(self._projector, lit),
            "full": Kind(self._full, lambda request: self._missing_device()),
            "compare": Kind(self._compare, lit),
            "publish": Kind(self._publish, known),
            "compute": Kind(self._publish, known),
            "report": Kind(self._report),
            "takeover": Kind(self._takeover, known),
            "variants": Kind(self._variants, known),
        }

    def _needs_calibration(self, request: Request) -> Decision | None:
        if self._calibrated():
            return None
        return Decision("not-calibrated", "This stage has no finished calibration.", "Calibrate it first.", "error")

    def _needs_camera(self, request: Request) -> Decision | None:
        return self._missing_device() or self._needs_calibration(request)

    # -- with light

    @contextlib.contextmanager
    def _borrowed(self) -> Iterator[BorrowedSession]:
        with self._lend() as rig:
            yield BorrowedSession(self._stage, rig)

    def _drift(self, request: Request, reporter: JobReporter, cancel: threading.Event) -> Finished:
        from controller.services.recalibrate import check_drift

        with self._lend() as rig:
            found = check_drift(
                session=BorrowedSession(self._stage, rig), details=True, reporter=reporter, cancel=cancel
            )
        reporter.job = replace(reporter.job, run=run_name(found))
        advice = str(found["advice"])
        if advice == "nothing":
            return Finished(request, Decision("drift-none", "Nothing has moved or dimmed since the calibration."))
        if advice == "look":
            return Finished(request, Decision("drift-look", "The drift check could not tell what has changed.",
                                              "Look at the stage; then calibrate anew.", "warning"))  # fmt: skip
        told = Decision("drift-found", "The stage has changed since its calibration.", "It is recalibrated.", "warning")
        return Finished(request, told, then=(replace(QUICK, key=request.key),))

    def _aim(self, request: Request, reporter: JobReporter, cancel: threading.Event) -> Finished:
        from controller.steps.capture.aiming import take_test_shots

        began_s = time.monotonic()

        def advance(share: float, note: str) -> None:
            left_s = None if share <= 0 else (time.monotonic() - began_s) * (1 - share) / share
            running = Progress(
                "Test shots", 0, 1, Phase.RUNNING, share, share, time.monotonic() - began_s, left_s, note
            )
            reporter.progress(running)

        capture = check_stage(self._stage).stage.tables.capture
        with self._lend() as rig:
            take_test_shots(rig, longest_exposure_s=capture.longest_exposure_s,
                            deadline=in_seconds(AIM_S, cancel), advance=advance)  # fmt: skip
        return Finished(request, Decision("aimed", "The test shots are taken; see the aiming page."))

    def _quick(self, request: Request, reporter: JobReporter, cancel: threading.Event) -> Finished:
        from controller.services.recalibrate import recalibrate

        with self._borrowed() as session:
            found = recalibrate(session=session, reporter=reporter, cancel=cancel)
        return self._calibrated_anew(request, reporter, found)

    def _projector(self, request: Request, reporter: JobReporter, cancel: threading.Event) -> Finished:
        from controller.services.recalibrate import recalibrate

        (name,) = request.arguments
        with self._lend() as rig:
            found = recalibrate(
                session=BorrowedSession(self._stage, rig), projector=name, reporter=reporter, cancel=cancel
            )
        return self._calibrated_anew(request, reporter, found)

    def _full(self, request: Request, reporter: JobReporter, cancel: threading.Event) -> Finished:
        from controller.services.calibrate import calibrate

        with self._borrowed() as session:
            found = calibrate(session=session, reporter=reporter, cancel=cancel)
        return self._calibrated_anew(request, reporter, found)

    def _calibrated_anew(self, request: Request, reporter: JobReporter, found: object) -> Finished:
        assert isinstance(found, dict)
        reporter.job = replace(reporter.job, run=run_name(found))
        told = Decision("calibrated", "The stage is calibrated anew.")
        report = replace(REPORT, arguments=(reporter.job.run,))
        if not (tables := check_stage(self._stage).stage.tables).appearances:
            return Finished(request, told, then=(report,))
        # The last, so that a lamp which does not light again costs nothing else.
        last = (replace(COMPARE, key=f"photographs after {request.key}"),)
        wanted = request.key and tables.calibration.photograph_at_night
        return Finished(request, told, then=(replace(PUBLISH, key=request.key), report, *(last if wanted else ())))

    def _compare(self, request: Request, reporter: JobReporter, cancel: threading.Event) -> Finished:
        from controller.services.compare import photograph

        if request.key and self._open_now():
            return Finished(request, Decision("photographs-left-out", "The appearances were not photographed: the stage"
                                              " has opened meanwhile.", "", "warning"))  # fmt: skip
        with self._lend() as rig:
            found = photograph(
                session=BorrowedSession(self._stage, rig), names=request.arguments, reporter=reporter, cancel=cancel
            )
        reporter.job = replace(reporter.job, run=run_name(found))
        worst = max(found["appearances"], key=lambda row: float(row["delta_e00_median"]))
        names = ", ".join(row["name"] for row in found["appearances"])
        told = (f"Photographed: {names}. The largest median colour difference is {worst['delta_e00_median']:.2f},"
                f" of {worst['name']}.")  # fmt: skip
        return Finished(request, Decision("photographed", told, "See the results."))

    # -- without

    def _publish(self, request: Request, reporter: JobReporter, cancel: threading.Event) -> Finished:
        from controller.kiosk.jobs.publishing import publish_appearances

        made = publish_appearances(BorrowedSession(self._stage), reporter=reporter, cancel=cancel)
        installed = f"A new bundle is installed: {', '.join(made.names)}." if made.names else "No bundle is installed."
        then = (VARIANTS,) if made.names and self._several() else ()
        if not made.failed:
            return Finished(request, Decision("published", installed), then=then)
        told = f"{made.failures} {self._taken_back(request, made.failed)}{installed}"
        failed = not made.names or any(name in made.failed for name in request.arguments)
        return Finished(request, Decision("appearance-failed", told, "", "error"), failed=failed, then=then)

    def _taken_back(self, request: Request, failed: Mapping[str, str]) -> str:
        """A new appearance that can't be made leaves stage.toml again; no page could remove it."""
        taken = [name for name in request.arguments if name in failed and name not in self._installed()]
        for name in taken:
            settings.remove_picture(self._stage, name)
        return f"{', '.join(taken)} is taken out of stage.toml again. " if taken else ""

    def _installed(self) -> Sequence[str]:
        return BundleStock(self._stage, stage_trust(check_stage(self._stage).stage)).names()

    def _report(self, request: Request, reporter: JobReporter, cancel: threading.Event) -> Finished:
        from controller.services.report import calibration_report

        (run,) = request.arguments
        calibration_report(self._stage / "runs" / run, check_stage(self._stage))
        return Finished(request, Decision("reported", f"The report of {run} is written; see the results."))

    def _several(self) -> bool:
        return len(check_stage(self._stage).names) > 1

    def _variants(self, request: Request, reporter: JobReporter, cancel: threading.Event) -> Finished:
        names = check_stage(self._stage).names
        self._solve([(name,) for name in names], reporter, cancel)
        return Finished(request, Decision("variants-solved", "Frames for the loss of any one projector are ready."))

    def _takeover(self, request: Request, reporter: JobReporter, cancel: threading.Event) -> Finished:
        self._solve([request.arguments], reporter, cancel)
        names = ", ".join(request.arguments)
        return Finished(request, Decision("takeover-solved", f"Frames without {names} are ready."))

    def _solve(self, sets: Sequence[tuple[str, ...]], reporter: JobReporter, cancel: threading.Event) -> None:
        from controller.kiosk.jobs.failover import solve_without

        for missing in sets:
            solve_without(BorrowedSession(self._stage), missing, reporter=reporter, cancel=cancel)
