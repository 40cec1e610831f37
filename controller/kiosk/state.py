"""The state of a kiosk as of one moment: what the panel shows first, and what subscribers are called for.

Any text may come from a device or a file, so it is untrusted: escape it where it is shown.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Literal, Self

EventLevel = Literal["info", "warning", "error"]


@dataclass(frozen=True, slots=True)
class LiveValue:
    """One value of a device as text: label "Lamp", text "1,204 h".

    ``pattern``: the text with a place for each of ``numbers``, "{0} h", so that a page can say it in another language;
    empty for a name. ``digits`` after the point.
    """

    label: str
    text: str
    pattern: str = ""
    numbers: tuple[float, ...] = ()
    digits: int = 0

    @classmethod
    def said(cls, label: str, pattern: str, *numbers: float, digits: int = 0) -> Self:
        """Of words and numbers, which are rounded, so that a value that reads the same is the same."""
        kept = tuple(round(float(one), digits) for one in numbers)
        return cls(label, pattern.format(*(f"{one:,.{digits}f}" for one in kept)), pattern, kept, digits)


@dataclass(frozen=True, slots=True)
class DeviceRow:
    """One device. ``kind`` is "projector", "camera", "display", "relay", "sensor" or "buttons"; ``problem`` a
    sentence or None.

    ``remedy`` says what to do about the problem, or is empty; ``output``: of the graphics card, that feeds a projector.
    """

    name: str
    kind: str
    driver: str
    values: tuple[LiveValue, ...] = ()
    problem: str | None = None
    remedy: str = ""
    output: str = ""


@dataclass(frozen=True, slots=True)
class JobStep:
    """``done`` is the share of this step that is done, 0..1."""

    title: str
    done: float


@dataclass(frozen=True, slots=True)
class Job:
    """The job that is running, or the last one that ended (``ended`` True).

    ``number`` grows with every job; ``left_s`` None until it is known; ``run`` the run's folder name if the job
    makes one; ``outcome`` a sentence when it ended, with ``failed`` if it failed; ``count`` the number of steps it will
    have, 0 until that is known; ``waits`` a sentence on what a job waits for that did not start yet;
    ``why``: why ``left_s`` rose; ``steps`` those up to the current one; ``appearance``: the one that it makes, or
    empty; ``background``: it makes way for what people ask
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
    count: int = 0
    waits: str = ""
    why: str = ""
    appearance: str = ""
    background: bool = False


@dataclass(frozen=True, slots=True)
class NextEvent:
    """The next scheduled event: ``what`` "opens", "closes", "drift check", ...; ``at_unix_s`` seconds."""

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
    """``hours`` lit and ``strikes`` as counted; ``life_hours``: the maker's rated life, or None."""

    projector: str
    hours: float
    strikes: int
    lit: bool
    life_hours: float | None = None


@dataclass(frozen=True, slots=True)
class Grade:
    """The grade of one calibration: ``grade`` as shown ("A", "B", ...), ``kept`` False if the older one stays in use.

    ``delta_e`` is the largest of the newest median colour differences (CIEDE2000) of the appearances that were solved
    on this calibration, None if none was photographed. ``worst_percent``: the largest predicted error, per cent of
    white.
    """

    run: str
    unix_s: float
    kind: str
    grade: str
    kept: bool
    delta_e: float | None = None
    note: str = ""
    worst_percent: float | None = None


@dataclass(frozen=True, slots=True)
class DriftCheck:
    """One drift check: ``advice`` "nothing", "quick", "full" or "look"; ``moved_px`` the rms motion of the camera's or
    the object's picture, camera pixels, None if it was not recognised; ``apart_s`` from the first output's change
    to the last one's, by the camera, and its uncertainty (95 %), None if that was not measured.
    """

    run: str
    unix_s: float
    advice: str
    moved_px: float | None
    apart_s: float | None = None
    uncertain_s: float | None = None


@dataclass(frozen=True, slots=True)
class Place:
    """Where a projector stands around the object, seen from the camera: ``word`` "left", "right above", "in front";
    ``aside_deg`` from -180 to 180, 0 is the camera's direction, right is positive; ``up_deg`` from -90 to 90.
    """

    projector: str
    word: str
    aside_deg: float
    up_deg: float


@dataclass(frozen=True, slots=True)
class EventRow:
    """One line of the event log; numbers grow by one and never start again."""

    number: int
    unix_s: float
    level: EventLevel
    text: str
    code: str = ""


@dataclass(frozen=True, slots=True)
class KioskState:
    """Everything that the panel's first page shows, as of one moment.

    ``state`` is a value of ``controller.run.state_machine.State``; ``reason`` one sentence; ``since_unix_s`` when
    it began. ``warnings``: sentences on problems that belong to no device (light in the room); ``failures``: failed
    jobs, as in the event log, until an operator confirms them. ``in_turn``: ``playing`` is one of those that are
    shown in turn. ``disk_free_bytes``: free space on the stage's disk, in steps of 10 MB, 0 until it is known.
    ``places`` of the projectors, empty until they are calibrated. ``drifts``: the drift checks, newest first.
    ``revision`` grows with every change, also over restarts of the service. ``needs_setup`` is True while the stage
    has no valid stage.toml. ``black``, ``paused``, ``brightness`` (percent): what people changed of the picture until
    the stage closes. ``made``: a computed appearance that was not shown yet, or empty. ``dose_klx_h``: light
    on the object since its light sensor was first used, None without one.
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
    warnings: tuple[str, ...] = ()
    failures: tuple[EventRow, ...] = ()
    in_turn: bool = False
    disk_free_bytes: int = 0
    places: tuple[Place, ...] = ()
    black: bool = False
    paused: bool = False
    made: str = ""
    brightness: float = 100.0
    drifts: tuple[DriftCheck, ...] = ()
    dose_klx_h: float | None = None


_WORST: Final = ("disk", "display", "projector")


def troubles(devices: Iterable[DeviceRow]) -> list[tuple[str, str, str]]:
    """Problems of devices, worst first: names, problems, and the remedy; one line for each remedy.

    First the disk, without which nothing can be kept, then what takes the whole picture away, then the most devices.
    """
    groups: dict[tuple[str, str], list[DeviceRow]] = {}
    for row in devices:
        if row.problem is not None:
            groups.setdefault((row.kind, row.remedy or row.problem), []).append(row)
    rank = {kind: number for number, kind in enumerate(_WORST)}
    ordered = sorted(groups.values(), key=lambda rows: (rank.get(rows[0].kind, len(rank)), -len(rows)))
    return [
        (
            ", ".join(row.name for row in rows),
            " ".join(dict.fromkeys(row.problem or "" for row in rows)),
            rows[0].remedy,
        )
        for rows in ordered
    ]
