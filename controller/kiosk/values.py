"""The answers of a kiosk beside its state: shown by the panel, returned by the API, printed by the command line.

Any text may come from a device or a file, so it is untrusted: escape it where it is shown.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Final, Literal, Self, TypeAlias

from pydantic import Field

from controller.kiosk.state import EventLevel, Grade
from hal.notices import Notice

RecalibrationKind = Literal["full", "quick"]
Fit = Literal["fit", "fill", "crop", "wrap", "restore"]
Unsubscribe = Callable[[], None]
Turn: TypeAlias = tuple[str, float, float]
"""An appearance's name, the seconds for which it is shown, and those of them in which it fades in."""
IN_TURN: Final = "*"
"""In the place of an appearance's name: all of the bundle, in turn."""
Picture = Annotated[Path | None, Field(exclude=True)]
"""A file of this machine, which the HTTP API leaves out: it has an address for each picture."""
Pictures = Annotated[dict[str, Path], Field(exclude=True)]


@dataclass(frozen=True, slots=True)
class LampDay:
    """A lamp at the end of one day (local date, "2026-12-24"): ``hours`` lit and ``strikes`` as counted then."""

    projector: str
    day: str
    hours: float
    strikes: int


@dataclass(frozen=True, slots=True)
class Appearance:
    """A solved appearance; ``preview`` is a picture of how the object will look, or None. ``delta_e``: the newest of
    its ``Comparison``, None if it was never photographed. ``outputs``: the projectors whose light can be shown;
    ``source``: the kind of its target in stage.toml, empty if it is not there.
    """

    name: str
    made_unix_s: float
    delta_e: float | None = None
    playing: bool = False
    preview: Picture = None
    outputs: tuple[str, ...] = ()
    source: str = ""


@dataclass(frozen=True, slots=True)
class Reach:
    """How much of a target the projectors can make. Shares of the visible object, 0..1: ``share`` in reach;
    ``too_bright`` for their light; ``too_dark`` for the room and the other projectors; ``too_colourful``. The rest is
    not lit, or not in the picture. ``pictures`` of the object: "target", "result" (what it will look like), "map".
    ``light``: with so much of the light that the picture has by the settings, ``light_share`` of it is in reach;
    ``held_back``: so many times as bright white could be without the darkest tenth of the object.
    ``coarse``: it was calculated on every so-many-th pixel of the camera, 1: on all.
    """

    share: float
    too_bright: float
    too_dark: float
    too_colourful: float
    pictures: Pictures = field(default_factory=dict)
    coarse: int = 1
    light: float = 1.0
    light_share: float = 0.0
    held_back: float = 1.0


@dataclass(frozen=True, slots=True)
class Computed:
    """What the object will look like by a whole solve of a target, as the computation makes it.
    Calculated, not photographed: ``delta_e`` and ``delta_e_p95`` median and 95th percentile of the colour difference
    (CIEDE2000) from the target on the whole visible object, ``in_reach`` the median where the target can be reached,
    which is ``in_reach_share`` of the object; each None without such pixels. ``seconds`` it took on ``device``;
    ``pictures`` of the object: "result".
    """

    delta_e: float | None
    delta_e_p95: float | None
    in_reach: float | None
    in_reach_share: float
    seconds: float
    device: str
    pictures: Pictures = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Scene:
    """A scene that Blender can render on the object: its ``name``; ``shipped`` with Velatura, or a .blend file of the
    stage; ``preview``: a small picture of it, None until it was looked at once.
    """

    name: str
    shipped: bool
    preview: Picture = None


@dataclass(frozen=True, slots=True)
class LaidMesh:
    """The mesh that lies on the object: its file, how far both differ, ``size`` in words; ``pictures``: "laid", it in
    the camera's view, and "map" of the differences.
    """

    file: str
    median_off_mm: float
    most_off_mm: float
    size: str
    pictures: Pictures = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class NewTarget:
    """An uploaded picture: ``target`` is its key."""

    target: str


@dataclass(frozen=True, slots=True)
class Achieved:
    """How close the photograph of an appearance is to its target: ``delta_e`` and ``delta_e_p95`` median and 95th
    percentile of the colour difference (CIEDE2000) on the whole visible object, ``rmse`` of the target's white,
    ``sharpness`` 0..1. ``in_reach``: the median where the target can be reached, which is ``in_reach_share`` of the
    object; None in photographs of an older version, whose ``delta_e`` is of the part in reach. ``aimed``: the median
    from the target that was bent into what the stage can make, None without one; ``held_back`` as of ``Reach``.
    """

    run: str
    unix_s: float
    delta_e: float
    delta_e_p95: float
    rmse: float
    sharpness: float
    in_reach: float | None = None
    in_reach_share: float | None = None
    aimed: float | None = None
    held_back: float | None = None


@dataclass(frozen=True, slots=True)
class Comparison:
    """What one installed appearance achieves: ``history`` newest first, at least one, and the newest one's pictures.

    Keys: "before", "target", "achieved", "error", "resolution"; files that the kiosk made itself (JPEG).
    """

    name: str
    history: tuple[Achieved, ...]
    pictures: Pictures = field(default_factory=dict)


MIDNIGHT: Final = "24:00"
"""The end of a day, as people write it."""


@dataclass(frozen=True, slots=True)
class ScheduleRow:
    """Opening hours of one weekday ("mon".."sun") or of one date ("2026-12-24", which takes precedence over weekdays).

    ``opens`` and ``closes`` are local times "HH:MM"; both empty means closed. ``closes`` at or before ``opens`` is on
    the next day, and 24:00 becomes 00:00. ``appearance`` empty: the last one.
    """

    day: str
    opens: str
    closes: str
    appearance: str = ""

    def __post_init__(self) -> None:
        if self.closes == MIDNIGHT:
            object.__setattr__(self, "closes", "00:00")


@dataclass(frozen=True, slots=True)
class Schedule:
    """``time_zone`` is an IANA name ("Europe/Vienna"); ``drift_check`` the nightly check's local time, or empty."""

    time_zone: str
    rows: tuple[ScheduleRow, ...] = ()
    drift_check: str = ""

    def __post_init__(self) -> None:
        if self.drift_check == MIDNIGHT:
            object.__setattr__(self, "drift_check", "00:00")


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding of the doctor."""

    level: EventLevel
    title: str
    what: str
    remedy: str

    @classmethod
    def of(cls, notice: Notice) -> Self:
        """As the HTTP API and the command line show it."""
        return cls(notice.level.value, notice.about, notice.what, notice.remedy)


@dataclass(frozen=True, slots=True)
class ProjectorAim:
    """``coverage`` the share of the object that this projector lights, 0..1; ``focus`` 0 (soft) to 1 (sharp)."""

    projector: str
    coverage: float
    focus: float


@dataclass(frozen=True, slots=True)
class Sharpness:
    """How sharp earlier test shots were: the sharpest pattern, and the focus of each projector by name, all 0..1."""

    unix_s: float
    camera_focus: float
    projectors: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Aiming:
    """What the aiming page shows. Shares are of the object's area in the camera's picture, 0..1.

    ``overlap`` lit by two projectors or more; ``too_dark`` and ``too_grazing``: shares that can't be used;
    ``camera_focus`` 0..1, and ``exposure`` the level of the brightest 1 %, 0..1 of full scale: None without test shots;
    ``hints`` sentences on what to change; ``source`` "test shots", "calibration", or empty if nothing was measured yet
    (``projectors`` is empty then); ``picture`` an overview that the kiosk drew (PNG), or None; ``outlined``: it shows
    where each projector's light ends; ``clipped``: the share of the object at the camera's limit; ``histogram``: shares
    of the object's pixels by level, dark first; ``history``: earlier test shots, oldest first
    """

    projectors: tuple[ProjectorAim, ...] = ()
    overlap: float = 0.0
    too_dark: float = 0.0
    too_grazing: float = 0.0
    camera_focus: float | None = None
    exposure: float | None = None
    hints: tuple[str, ...] = ()
    source: str = ""
    measured_unix_s: float = 0.0
    picture: Picture = None
    outlined: bool = False
    clipped: float | None = None
    histogram: tuple[float, ...] = ()
    history: tuple[Sharpness, ...] = ()


@dataclass(frozen=True, slots=True)
class FoundDevice:
    """A device that a search found: ``key`` identifies it for ``try_device``; ``table`` is its text for stage.toml."""

    key: str
    kind: str
    driver: str
    label: str
    table: str


@dataclass(frozen=True, slots=True)
class TriedDevice:
    """The result of trying a device: ``works``, and a sentence in both cases (with the remedy)."""

    works: bool
    what: str


@dataclass(frozen=True, slots=True)
class Results:
    """Pictures of one run, as files the kiosk made itself (PNG or JPEG), by name.

    Keys: "before", "target", "achieved", "error", "resolution". ``figures`` are (label, value text).
    """

    run: str
    grade: Grade | None
    pictures: Pictures = field(default_factory=dict)
    figures: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class Change:
    """One thing that differs from the last good day.

    ``kind`` is a key of ``compare.KINDS``; ``name``: which one; ``before`` and ``now`` as they were read, empty where
    there was or is none; ``sentence`` says it, ``remedy`` what to do. ``since_unix_s``: when it was first seen.
    """

    kind: str
    name: str
    before: str
    now: str
    sentence: str
    remedy: str
    since_unix_s: float


@dataclass(frozen=True, slots=True)
class Changes:
    """``good_unix_s``: when the last good day's inventory was taken, None if there is none; ``run``: what graded well;
    ``unknown``: what can't be read now, so that it is not compared.
    """

    good_unix_s: float | None
    run: str
    changes: tuple[Change, ...]
    unknown: tuple[str, ...]
