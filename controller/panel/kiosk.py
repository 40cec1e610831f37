"""What the panel knows of a kiosk: one Protocol, and the values it gives.

``controller.serve`` implements it. The panel holds nothing of its own but accounts and sessions: every page and every
answer of the API is made from these values.

Every method may be called from any thread. ``snapshot``, ``events``, ``lamps`` and the other questions answer from
memory in milliseconds and never wait for a device; where a method may take longer, its text says so. Every text may
hold what a device or a file said: it is hostile, and whoever shows it escapes it. Refusals are ``VelaturaError`` with
code, what and remedy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol

RecalibrationKind = Literal["full", "quick"]
EventLevel = Literal["info", "warning", "error"]
Unsubscribe = Callable[[], None]


@dataclass(frozen=True, slots=True)
class LiveValue:
    """One value of a device in words: label "Lamp", text "1,204 h"."""

    label: str
    text: str


@dataclass(frozen=True, slots=True)
class DeviceRow:
    """One device. ``kind`` is "projector", "camera", "display", "relay", "sensor" or "buttons"; ``problem`` a
    sentence or None.

    ``remedy`` says what to do about the problem, or is empty.
    """

    name: str
    kind: str
    driver: str
    values: tuple[LiveValue, ...] = ()
    problem: str | None = None
    remedy: str = ""


@dataclass(frozen=True, slots=True)
class JobStep:
    """``done`` is the share of this step that is done, 0..1."""

    title: str
    done: float


@dataclass(frozen=True, slots=True)
class Job:
    """Work that is going on, or that ended last (``ended`` True).

    ``number`` grows with every job; ``left_s`` None until it can be told; ``run`` the run's folder name where the job
    makes one; ``outcome`` a sentence when it ended, with ``failed`` when it did not do what was asked
    """

    number: int
    name: str
    steps: tuple[JobStep, ...] = ()
    left_s: float | None = None
    cancellable: bool = True
    run: str = ""
    ended: bool = False
    failed: bool = False
    outcome: str = ""


@dataclass(frozen=True, slots=True)
class NextEvent:
    """The next thing that the schedule does: ``what`` "opens", "closes", "drift check", ...; ``at_unix_s`` seconds."""

    what: str
    at_unix_s: float


@dataclass(frozen=True, slots=True)
class BundleIdentity:
    """The bundle that is installed: its version, its digest in hex, and when it was built."""

    version: int
    digest: str
    built_unix_s: float


@dataclass(frozen=True, slots=True)
class Lamp:
    """``hours`` lit and ``strikes`` as counted; ``life_hours`` what the maker promises, or None."""

    projector: str
    hours: float
    strikes: int
    lit: bool
    life_hours: float | None = None


@dataclass(frozen=True, slots=True)
class Grade:
    """The grade of one calibration: ``grade`` as shown ("A", "B", ...), ``kept`` False where the older one stayed.

    ``delta_e`` is the median colour difference against the target (CIEDE2000), None where nothing was played.
    """

    run: str
    unix_s: float
    kind: str
    grade: str
    kept: bool
    delta_e: float | None = None
    note: str = ""


@dataclass(frozen=True, slots=True)
class KioskState:
    """Everything that the panel's first page shows, as of one moment.

    ``state`` is a value of ``controller.session.machine.State``; ``reason`` one sentence; ``since_unix_s`` when it
    began. ``revision`` grows with every change, also over restarts of the service. ``needs_setup`` is True while the
    stage has no valid stage.toml.
    """

    revision: int
    stage: str
    state: str
    reason: str
    since_unix_s: float
    devices: tuple[DeviceRow, ...] = ()
    job: Job | None = None
    playing: str = ""
    next_event: NextEvent | None = None
    bundle: BundleIdentity | None = None
    lamps: tuple[Lamp, ...] = ()
    grades: tuple[Grade, ...] = ()
    identifying: bool = False
    needs_setup: bool = False


@dataclass(frozen=True, slots=True)
class EventRow:
    """One line of the event log; numbers grow by one and never begin anew."""

    number: int
    unix_s: float
    level: EventLevel
    text: str
    code: str = ""


@dataclass(frozen=True, slots=True)
class Appearance:
    """A solved appearance; ``preview`` is a PNG of how the object will look, or None."""

    name: str
    made_unix_s: float
    delta_e: float | None = None
    playing: bool = False
    preview: Path | None = None


@dataclass(frozen=True, slots=True)
class ComputeSettings:
    """How a target is fitted. ``brightness`` 0.05..1 of what the projectors can do, None to choose the brightest that
    fits.
    """

    brightness: float | None = None


@dataclass(frozen=True, slots=True)
class ScheduleRow:
    """Opening hours of one weekday ("mon".."sun") or of one date ("2026-12-24", which takes precedence over weekdays).

    ``opens`` and ``closes`` are local times "HH:MM"; both empty means closed. ``closes`` at or before ``opens`` is on
    the next day. ``appearance`` empty: what was played last.
    """

    day: str
    opens: str
    closes: str
    appearance: str = ""


@dataclass(frozen=True, slots=True)
class Schedule:
    """``time_zone`` is an IANA name ("Europe/Vienna"); ``drift_check`` the nightly check's local time, or empty."""

    time_zone: str
    rows: tuple[ScheduleRow, ...] = ()
    drift_check: str = ""


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding of the doctor."""

    level: EventLevel
    title: str
    what: str
    remedy: str


@dataclass(frozen=True, slots=True)
class ProjectorAim:
    """``coverage`` the share of the object that this projector lights, 0..1; ``focus`` 0 (soft) to 1 (sharp)."""

    projector: str
    coverage: float
    focus: float


@dataclass(frozen=True, slots=True)
class Aiming:
    """What the aiming page shows. Shares are of the object's area in the camera's picture, 0..1.

    ``overlap`` lit by two projectors or more; ``too_dark`` and ``too_grazing`` where nothing can be done;
    ``camera_focus`` 0..1; ``exposure`` the brightest hundredth's level, 0..1 of full scale; ``hints`` sentences on
    what to turn which way
    """

    projectors: tuple[ProjectorAim, ...]
    overlap: float
    too_dark: float
    too_grazing: float
    camera_focus: float
    exposure: float
    hints: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class FoundDevice:
    """A device that a search found: ``key`` names it to ``try_device``; ``table`` is its text for stage.toml."""

    key: str
    kind: str
    driver: str
    label: str
    table: str


@dataclass(frozen=True, slots=True)
class TriedDevice:
    """What came of trying a device: ``works``, and a sentence in either case (the remedy in it)."""

    works: bool
    what: str


@dataclass(frozen=True, slots=True)
class Results:
    """Pictures of one run, as files the kiosk made itself (PNG or JPEG), by name.

    Names in use: "before", "target", "achieved", "error", "resolution". ``figures`` are (label, value text).
    """

    run: str
    grade: Grade | None
    pictures: dict[str, Path] = field(default_factory=dict)
    figures: tuple[tuple[str, str], ...] = ()


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

    def cancel(self) -> None:
        """Ask the running job to end at its next safe point. Raises WorkError when none is running."""

    def play(self, name: str) -> None: ...

    def stop(self) -> None:
        """Close: stop playing and cool the lamps down."""

    def start(self) -> None:
        """Open: lamps on, warm up, and play."""

    def compute(self, name: str, target: Path, settings: ComputeSettings) -> Job:
        """Begin to solve for the picture ``target`` (PNG, sRGB, the camera's view) as the appearance ``name``.

        The kiosk takes its own copy before it returns. A name that exists is replaced when the solve succeeds.
        """

    def feasibility(self, target: Path) -> Path:
        """A PNG that shows where the target can't be reached, brighter is worse. Seconds; raises WorkError
        uncalibrated.
        """

    def appearances(self) -> Sequence[Appearance]: ...

    def remove_appearance(self, name: str) -> None:
        """Raises UsageError for the one that is playing, or that the schedule names."""

    def schedule(self) -> Schedule: ...

    def set_schedule(self, schedule: Schedule) -> None:
        """Replace it whole. Raises UsageError with the row's number for a wrong day, time, zone or appearance."""

    def identify(self, on: bool) -> None:
        """Show each projector's name and a frame on it, or end that."""

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

    def aiming(self) -> Aiming:
        """The newest measurement; the first call begins measuring, which ends some seconds after the last call."""

    def find_devices(self) -> Sequence[FoundDevice]:
        """Search ports, network and USB. Seconds."""

    def try_device(self, key: str) -> TriedDevice:
        """Open the device and ask it who it is. Seconds; changes nothing."""
