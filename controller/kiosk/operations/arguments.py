"""The types of what may be sent to an operation: limits, a description, and how the command line asks for it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import BaseModel, Field

from controller.kiosk.operations.fields import INTEGER, NAME, NEW_NAME, NUMBER, TEXT, CommandLine, Flag, Sent
from controller.kiosk.schedule import ALLOWED_DAYS
from controller.kiosk.state import EventLevel
from controller.kiosk.values import Fit

MOST_EVENTS: Final = 2000
MOST_NUMBER: Final = 10**12
_TIME: Final = r"^(([01][0-9]|2[0-3]):[0-5][0-9]|24:00)?$"
_PROJECTOR: Final = r"^[^\u0000-\u001f\u007f/\\]+$"
_PROJECTORS: Final = CommandLine(completes="projector")

AppearanceName = Annotated[str, Field(pattern=NAME, max_length=64, description=(
    "an appearance's name, 1 to 64 letters, digits, spaces, dots, dashes")), TEXT,
    CommandLine(completes="appearance")]  # fmt: skip
# The same rule as in stage.toml.
NewName = Annotated[str, Field(pattern=NEW_NAME, max_length=64, description=(
    "a name of 1 to 64 letters, digits, - and _; the first is a letter or digit")), TEXT,
    CommandLine(completes="appearance")]  # fmt: skip
OnlyAppearance = Annotated[str, Field(pattern=NAME, max_length=64, description="only this appearance"), TEXT,
                           CommandLine(completes="appearance", argument=True)]  # fmt: skip
ProjectorName = Annotated[str, Field(pattern=_PROJECTOR, max_length=64, description="a projector's name"), TEXT,
                          _PROJECTORS]  # fmt: skip
OnlyProjector = Annotated[str, Field(pattern=_PROJECTOR, max_length=64, description="only this projector"), TEXT,
                          _PROJECTORS]  # fmt: skip
FadeSeconds = Annotated[float, Field(ge=0, le=600, allow_inf_nan=False, description=(
    "seconds of the fade, 0 to 600; default: as the playlist says")), NUMBER]  # fmt: skip
Percent = Annotated[float, Field(ge=0, le=100, allow_inf_nan=False, description="share of the light, 0 to 100"),
                    NUMBER]  # fmt: skip
Black = Annotated[bool, Field(description="true or false"),
                  CommandLine(flag=Flag("--off", "Show the picture again.", False, True))]  # fmt: skip
Paused = Annotated[bool, Field(description="true or false"), CommandLine(flag=Flag("--off", "Continue.", False, True))]
Identifying = Annotated[bool, Field(description="true or false"),
                        CommandLine(flag=Flag("--off", "Stop identifying and resume.", False, True))]  # fmt: skip
FullOrQuick = Annotated[Literal["full", "quick"], Field(description="full or quick"), CommandLine(
    flag=Flag("--quick", "Redo only what changed since the last calibration.", "quick", "full"))]  # fmt: skip
TargetFile = Annotated[Path, Field(description="the key of an uploaded target"), Sent.TARGET,
                       CommandLine(metavar="PNG")]  # fmt: skip
TargetKey = Annotated[str, Field(pattern=r"^[0-9a-f]{24}$", description="the key of an uploaded target"), TEXT]
PictureFile = Annotated[Path, Field(description="a PNG, JPEG, TIFF or WebP"), Sent.FILE]
FitName = Annotated[Fit, Field(description=(
    "how a picture of another size is fitted to the camera's view: fit (whole picture), fill (edges are cut), "
    "crop (original pixels), wrap (around the object) or restore (laid on what it shows); default: fit"))]  # fmt: skip
Outline = Annotated[str, Field(max_length=1 << 16, description=(
    "regions as lists of corners [x, y], each from 0 to 1 of the picture, such as [[[0,0],[1,0],[1,1]]]")),
    TEXT]  # fmt: skip
PointPairs = Annotated[str, Field(max_length=1 << 14, description=(
    "for restore: at least four [x, y, x, y], a place in the picture and the same one in the camera's view, each "
    "number from 0 to 1; default: found by what both show")), TEXT]  # fmt: skip
SceneName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9 ._-]{0,47}$", max_length=48, description=(
    "a scene's name, as `scenes` lists it")), TEXT]  # fmt: skip
MeshName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9 ._-]{0,51}$", max_length=52, description=(
    "the file of a mesh, as `meshes` lists it")), TEXT]  # fmt: skip
MeshSide = Annotated[int, Field(ge=0, le=31, description=(
    "from where a mesh is seen: 0 to 7 turned by 45 degrees, then tipped by a quarter")), INTEGER]  # fmt: skip
MeshPoints = Annotated[str, Field(max_length=1 << 14, description=(
    "at least four [x, y, x, y], a place in the mesh's picture and the same one in the camera's view, each number from "
    "0 to 1; default: found by its shape")), TEXT]  # fmt: skip
LaidPicture = Annotated[Literal["laid", "map"], Field(description="laid or map")]
ReachPicture = Annotated[Literal["target", "result", "map"], Field(description="target, result or map")]
ComparisonPicture = Annotated[Literal["before", "target", "achieved", "error", "resolution"], Field(
    description="before, target, achieved, error or resolution")]  # fmt: skip
RunName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,95}$", max_length=96, description="a run's name"),
                    TEXT]  # fmt: skip
AfterNumber = Annotated[int, Field(ge=0, le=MOST_NUMBER, description="only events after this number"), INTEGER]
OnlyLevel = Annotated[EventLevel, Field(description="only this level")]
MostEvents = Annotated[int, Field(ge=1, le=MOST_EVENTS, description="only this many of the newest events"), INTEGER]
UpToNumber = Annotated[int, Field(ge=0, le=MOST_NUMBER, description=(
    "the event number of the newest one to confirm; default: all")), INTEGER]  # fmt: skip
JobNumber = Annotated[int, Field(ge=0, le=MOST_NUMBER, description=(
    "the number that was returned when the job was requested")), INTEGER]  # fmt: skip
StageText = Annotated[str, Field(max_length=1 << 20, description="the text of stage.toml"), TEXT]
WithPhotographs = Annotated[bool, Field(description="true or false; default: false"), CommandLine(
    flag=Flag("--photographs", "Also the photographs of the calibration, often gigabytes.", True, False))]  # fmt: skip
BackupFile = Annotated[Path, Field(description="a Velatura backup"), Sent.FILE, CommandLine(metavar="FILE")]
DeviceKey = Annotated[str, Field(max_length=256, description="the key of a found device"), TEXT]
TimeZone = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_+/-]{1,63}$", max_length=64, description=(
    "a time zone such as Europe/Vienna")), TEXT]  # fmt: skip
CheckTime = Annotated[str, Field(pattern=_TIME, max_length=5, description=(
    "the time of the nightly check, such as 03:00")), TEXT]  # fmt: skip


class HoursRow(BaseModel, extra="forbid"):
    """One row of the opening hours."""

    # Which days it names, ``schedule.expanded`` finds out.
    day: Annotated[str, Field(pattern=r"^[^\u0000-\u001f\u007f]+$", max_length=64, description=ALLOWED_DAYS), TEXT]
    opens: Annotated[str, Field(pattern=_TIME, max_length=5, description=(
        "a time such as 10:00; default: closed")), TEXT] = ""  # fmt: skip
    closes: Annotated[str, Field(pattern=_TIME, max_length=5, description=(
        "a time such as 18:00; default: closed")), TEXT] = ""  # fmt: skip
    appearance: Annotated[str, Field(pattern=rf"^({NAME[1:-1]}|\*)?$", max_length=64, description=(
        "an appearance's name, or * for all in turn; default: the last one")), TEXT] = ""  # fmt: skip


Hours = Annotated[list[HoursRow], Field(max_length=400, description="the opening hours, at most 400 rows")]
