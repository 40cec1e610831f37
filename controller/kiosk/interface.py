"""What the panel knows of a kiosk: one Protocol, and the values it gives.

``controller.kiosk.api.kiosk`` implements it. The panel holds nothing of its own but accounts and sessions: every page
and every answer of the API is made from these values.

Every method may be called from any thread. ``snapshot``, ``events``, ``lamps`` and the other questions answer from
memory in milliseconds and never wait for a device; where a method may take longer, its text says so. Every text may
hold what a device or a file said: it is hostile, and whoever shows it escapes it. Refusals are ``VelaturaError`` with
code, what and remedy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from controller.kiosk.values import (
    Achieved,
    Aiming,
    Appearance,
    BundleIdentity,
    Comparison,
    DeviceRow,
    EventLevel,
    EventRow,
    Finding,
    Fit,
    FoundDevice,
    Grade,
    Job,
    JobStep,
    KioskState,
    Lamp,
    LampDay,
    LiveValue,
    NextEvent,
    ProjectorAim,
    RecalibrationKind,
    Results,
    Schedule,
    ScheduleRow,
    TriedDevice,
    Unsubscribe,
)


class Kiosk(Protocol):
    """A running stage, as the panel sees it. Commands return when they were accepted; progress is in
    ``snapshot().job``.
    """

    def snapshot(self) -> KioskState: ...

    def events(self, after: int = 0) -> Sequence[EventRow]:
        """Events with a number above ``after``, oldest first, at most the newest 2,000."""

    def subscribe(self, callback: Callable[[], None]) -> Unsubscribe:
        """Call ``callback`` (quick, from any thread) after every change of the snapshot or the event log."""

    def recalibrate(self, kind: RecalibrationKind, projector: str | None = None) -> Job:
        """Begin a calibration; of one projector where it is named. Raises WorkError while another job is running."""

    def job(self, number: int) -> Job | None:
        """A job that was asked for; None while it waits. Raises WorkError("job-given-up") where it never will begin."""

    def cancel(self) -> None:
        """Ask the running job to end at its next safe point. Raises WorkError when none is running."""

    def play(self, name: str) -> None: ...

    def stop(self) -> None:
        """Close: stop playing and cool the lamps down."""

    def start(self) -> None:
        """Open: lamps on, warm up, and play."""

    def fitted(self, target: Path, fit: Fit = "fit") -> bytes:
        """The picture ``target`` (PNG) as one of the camera's view; as it is where that is not known yet.

        ``fit``: as ``store.targets.fitted`` says. Raises UsageError("target-unreadable").
        """

    def compute(self, name: str, target: Path, fit: Fit = "fit") -> Job:
        """Begin to solve for the picture ``target`` (PNG, sRGB) as the appearance ``name``; fitted as by ``fitted``.

        The kiosk takes its own copy before it returns. A name that exists is replaced when the solve succeeds.
        """

    def feasibility(self, target: Path) -> Path:
        """A PNG that shows where the target can't be reached, brighter is worse. Seconds; raises WorkError
        uncalibrated.
        """

    def appearances(self) -> Sequence[Appearance]: ...

    def compare(self, name: str | None = None) -> Job:
        """Begin to photograph the installed appearances, or that one, and to compare them with their targets.

        Raises WorkError with the reason why it can't be done now, and UsageError("appearance-unknown").
        """

    def comparisons(self) -> Sequence[Comparison]:
        """What the installed appearances achieved, in the bundle's order; without those that nobody photographed."""

    def remove_appearance(self, name: str) -> None:
        """Raises UsageError for the one that is playing, or that the schedule names."""

    def lamp_history(self) -> Sequence[LampDay]:
        """Each lamp's last days, at most 400, oldest first; a day without light is left out."""

    def schedule(self) -> Schedule: ...

    def set_schedule(self, schedule: Schedule) -> None:
        """Replace it whole. Raises UsageError with the row's number for a wrong day, time, zone or appearance."""

    def identify(self, on: bool) -> None:
        """Show each projector's name and a frame on it, or end that."""

    def seen(self, number: int | None = None) -> None:
        """Somebody has seen the failures up to this number of the event log, or all; they leave the state."""

    def doctor(self) -> Sequence[Finding]:
        """Look for what is wrong with machine, stage and devices. Seconds."""

    def backup(self) -> Path:
        """A new file with settings, calibration, appearances; without secrets. Seconds."""

    def restore(self, backup: Path) -> None:
        """Replace settings, calibration and appearances. Raises UsageError for a file that is not a backup of ours."""

    def diagnostics(self) -> Path:
        """A new file for whoever helps from afar: events, journals, states; without secrets and pictures. Seconds."""

    def settings(self) -> str:
        """The text of stage.toml, empty when there is none."""

    def validate_settings(self, text: str) -> None:
        """Raises UsageError naming line, key and what is allowed."""

    def save_settings(self, text: str) -> None:
        """Validate, keep the old text beside it, write, and take it into use (devices are opened anew). Raises as
        above.
        """

    def camera_picture(self) -> bytes | None:
        """The camera's last live picture as JPEG, made by the kiosk itself; None when there is none."""

    def runs(self) -> Sequence[str]:
        """Names of the runs that have results, newest first."""

    def results(self, run: str) -> Results:
        """Raises UsageError("run-unknown")."""

    def report(self, run: str) -> Path:
        """A run's report, one HTML file; made if it is not there yet, which takes seconds. Raises as ``results``."""

    def aiming(self) -> Aiming:
        """The newest measurement: of the last test shots, or of the calibration if that is newer. Seconds."""

    def test_shots(self) -> Job:
        """Begin to photograph some patterns that tell how projectors and camera are aimed. Raises WorkError."""

    def find_devices(self) -> Sequence[FoundDevice]:
        """Search ports, network and USB. Seconds."""

    def try_device(self, key: str) -> TriedDevice:
        """Open the device and ask it who it is. Seconds; changes nothing."""


__all__ = [
    "Achieved",
    "Aiming",
    "Appearance",
    "BundleIdentity",
    "Comparison",
    "DeviceRow",
    "EventLevel",
    "EventRow",
    "Finding",
    "Fit",
    "FoundDevice",
    "Grade",
    "Job",
    "JobStep",
    "Kiosk",
    "KioskState",
    "Lamp",
    "LampDay",
    "LiveValue",
    "NextEvent",
    "ProjectorAim",
    "RecalibrationKind",
    "Results",
    "Schedule",
    "ScheduleRow",
    "TriedDevice",
    "Unsubscribe",
]
