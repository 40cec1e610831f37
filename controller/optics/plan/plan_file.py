"""plan.toml: what is to be planned. A field's description says what is allowed; errors quote it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import Field

from controller.config.loader import parse_tables, read_toml
from controller.config.models import ConfigTable, Name, Positive, Size
from controller.optics.plan.values import MountingPoint, PlanGoal, ProjectorModel

Metres3 = Annotated[tuple[float, float, float], Field(strict=False)]
Two = Annotated[tuple[float, float], Field(strict=False)]
Axis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
MOST_POINTS: Final = 5000
_AXIS: Final = 'one of "+x", "-x", "+y", "-y", "+z", "-z"'


class TargetObjectTable(ConfigTable):
    mesh: str = Field(min_length=1, description="a mesh file (.obj, .ply, .glb ...), relative to this file")
    height_m: Positive | None = Field(
        default=None, description="the object's height in metres, above 0; if omitted: the mesh is in metres"
    )
    up: Axis = Field(default="+y", description=f"the mesh's axis that points up, {_AXIS}")
    front: Axis = Field(default="+z", description=f"the mesh's axis that points towards the audience, {_AXIS}")


class AudienceTable(ConfigTable):
    positions_m: Annotated[tuple[Metres3, ...], Field(strict=False, min_length=1, max_length=64)] = Field(
        description="a list of the audience's positions [x, y, z] in metres: x right, y down, z away from the audience"
    )


class ProjectorsTable(ConfigTable):
    name: Name = Field(description="the model's name, 1 to 64 printable characters")
    count: int = Field(default=1, ge=1, le=64, description="how many projectors of this model there are, from 1 to 64")
    width_px: Size = Field(description="the picture's width in pixels, a whole number from 1 to 16384")
    height_px: Size = Field(description="the picture's height in pixels, a whole number from 1 to 16384")
    lumens: Positive = Field(description="the light of a white picture in lumens, above 0")
    throw_ratio: Two = Field(
        description="throw ratio (distance by picture width), [shortest, longest], from the data sheet"
    )
    lens_shift: Two = Field(
        default=(0.0, 0.0),
        description="offset of the picture's centre from the optical axis, [right, up], in picture widths and "
        "heights; a table projector has about [0, 0.55]",
    )
    pupil_mm: float = Field(
        default=25.0,
        ge=0,
        le=1000,
        description="the diameter of the lens pupil (focal length by f-number) in millimetres, 0 to 1000",
    )
    sharpest_px: float = Field(
        default=0.35, ge=0, le=10, description="a pixel's blur in focus, standard deviation in pixels, 0 to 10"
    )


class CamerasTable(ConfigTable):
    name: Name = Field(description="the camera's name, 1 to 64 printable characters")
    count: int = Field(default=1, ge=1, le=8, description="how many such cameras there are, from 1 to 8")
    width_px: Size = Field(description="the picture's width in pixels, a whole number from 1 to 16384")
    height_px: Size = Field(description="the picture's height in pixels, a whole number from 1 to 16384")
    focal_length_px: Positive = Field(description="the focal length in pixels, above 0")


class PlacesTable(ConfigTable):
    name: Name = Field(description="the place's name, different for every place")
    position_m: Metres3 = Field(
        description="[x, y, z] of the lens in metres from the object's centre: x right, y down, z to the back"
    )


class ShellTable(ConfigTable):
    """Places on a part of a sphere round the object."""

    distance_m: Two = Field(description="[nearest, farthest] in metres from the object's centre")
    right_degrees: Two = Field(description="[from, to], degrees to the audience's right, -180 to 180")
    above_degrees: Two = Field(description="[from, to], degrees above the object, -89 to 89")
    step_degrees: float = Field(default=10.0, ge=0.5, le=90, description="degrees between positions, 0.5 to 90")
    step_m: Positive = Field(default=0.25, description="metres between distances, above 0")


class PlanTables(ConfigTable):
    object: TargetObjectTable = Field(description="the table [object] with mesh")
    audience: AudienceTable = Field(description="the table [audience] with positions_m")
    projectors: Annotated[tuple[ProjectorsTable, ...], Field(strict=False, min_length=1, max_length=16)] = Field(
        description="a list of [[projectors]] tables, one for each model"
    )
    cameras: Annotated[tuple[CamerasTable, ...], Field(strict=False, max_length=8)] = Field(
        default=(), description="a list of [[cameras]] tables; optional"
    )
    places: Annotated[tuple[PlacesTable, ...], Field(strict=False, max_length=MOST_POINTS)] = Field(
        default=(), description="a list of [[places]] tables with name and position_m"
    )
    shell: ShellTable | None = Field(default=None, description="the table [shell]; optional")
    goal: PlanGoal = Field(default=PlanGoal(), description="the table [goal]; optional")

    def models(self) -> list[ProjectorModel]:
        """One for each projector that there is, the brightest model first."""
        tables = sorted(self.projectors, key=lambda table: -table.lumens)
        return [
            ProjectorModel(
                table.name, (table.width_px, table.height_px), table.lumens, table.throw_ratio, table.lens_shift,
                table.pupil_mm / 1e3, table.sharpest_px,
            )
            for table in tables
            for _ in range(table.count)
        ]  # fmt: skip

    def camera_models(self) -> list[ProjectorModel]:
        """One for each camera, which sees what a projector would light."""
        return [
            ProjectorModel(table.name, (table.width_px, table.height_px), 1.0, (throw, throw), (0.0, 0.0), 0.0, 0.0)
            for table in self.cameras
            for throw in [table.focal_length_px / table.width_px] * table.count
        ]

    def mounting_points(self) -> list[MountingPoint]:
        """Every place, those of the shell named by their angles and distance."""
        named = [MountingPoint(table.name, table.position_m) for table in self.places]
        return named + ([] if self.shell is None else _on_shell(self.shell))


def read_plan(file: Path) -> PlanTables:
    """Read and check a plan.toml.

    Raises UsageError "plan-missing", "plan-unreadable", "plan-syntax", "plan-key-unknown", "plan-key-missing",
    "plan-key-type", "plan-key-value"; all but the first two name the line.
    """
    content, place = read_toml(file, kind="plan")
    tables = parse_tables(PlanTables, content, place)
    for table in tables.projectors:
        _rising(table, "throw_ratio", low=0.05, high=50.0)
    if tables.shell is not None:
        for key, low, high in (("distance_m", 0.05, 1e4), ("right_degrees", -180, 180), ("above_degrees", -89, 89)):
            _rising(tables.shell, key, low=low, high=high)
    _check_places(tables)
    return tables


def _rising(table: ConfigTable, key: str, *, low: float, high: float) -> None:
    first, last = getattr(table, key)
    if not low <= first <= last <= high:
        allowed = f"two numbers from {low:g} to {high:g}, the smaller first"
        raise table.place.wrong_value(key, [first, last], "is no range", allowed)


def _check_places(tables: PlanTables) -> None:
    names: set[str] = set()
    for table in tables.places:
        if table.name in names:
            raise table.place.wrong_value("name", table.name, "is taken already", "is used twice")
        names.add(table.name)
    if not tables.places and tables.shell is None:
        raise tables.place.missing("places", "[[places]] with name and position_m, or a table [shell]")
    if tables.shell is not None and len(tables.mounting_points()) > MOST_POINTS:
        allowed = f"large enough for at most {MOST_POINTS} positions"
        raise tables.shell.place.wrong_value(
            "step_degrees", tables.shell.step_degrees, "gives too many positions", allowed
        )


def _on_shell(shell: ShellTable) -> list[MountingPoint]:
    points = []
    for distance in _steps(*shell.distance_m, shell.step_m):
        for above in _steps(*shell.above_degrees, shell.step_degrees):
            for right in _steps(*shell.right_degrees, shell.step_degrees):
                name = f"{right:+.0f}° right, {above:+.0f}° up, {distance:.2f} m"
                points.append(MountingPoint.around_object(name, right, above, distance))
    return points


def _steps(first: float, last: float, step: float) -> list[float]:
    count = min(int(np.floor((last - first) / step + 1e-9)) + 1, MOST_POINTS + 1)
    return [float(first + k * step) for k in range(count)]


EXAMPLE: Final = """\
# What `velatura plan` plans. Metres from the middle of the object: x to the right, y down, z away from the audience.
[object]
mesh = "object.obj"
height_m = 0.3

[audience]
positions_m = [[0.0, -0.2, -1.5], [0.5, -0.2, -1.4], [-0.5, -0.2, -1.4]]

[[projectors]]
name = "table projector"
count = 3
width_px = 1400
height_px = 1050
lumens = 3000.0
throw_ratio = [1.6, 2.0]
lens_shift = [0.0, 0.55]
pupil_mm = 15.0

# Placed last, where they see most of the light; leave them out if yours have their places.
[[cameras]]
name = "camera"
count = 2
width_px = 3888
height_px = 2592
focal_length_px = 5200.0

# Places that there are, by name ...
[[places]]
name = "shelf"
position_m = [0.0, -1.0, -1.2]

# ... and places all round, where a stand could be.
[shell]
distance_m = [1.0, 1.5]
right_degrees = [-60.0, 60.0]
above_degrees = [0.0, 40.0]
step_degrees = 10.0
step_m = 0.25

[goal]
lux = 5000.0
detail_mm = 0.8
overlap = 2
"""
