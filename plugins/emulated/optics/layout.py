"""How a new stage is laid out: where its projectors stand, and in which room, with how much of real light."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from hal.errors import PluginError
from hal.escapes import toml_value
from plugins.emulated.core.extensions import extension
from plugins.emulated.core.truth import (
    ENGINES,
    BenchTruth,
    SurfaceTruth,
)
from plugins.emulated.optics.effects import rare
from plugins.emulated.optics.objects import StageObject
from plugins.emulated.optics.scenes import BUILT_IN, SOLIDS

DARK: Final = "dark"
ROOMS: Final = (DARK, "room", "hard")
TABLE_GAP_M: Final = 5e-4
"""Between the object and the table, so that no two surfaces are one."""
HALF_WIDTH_M: Final = 0.7
FRONT_M, WALL_M, CEILING_M = 0.4, 0.35, 0.7
"""The table's edge, the wall and its upper edge, from the object's middle."""
WOOD: Final = (0.42, 0.36, 0.29)
PAINT: Final = (0.46, 0.46, 0.44)


def arranged(truth: BenchTruth, room: str, thing: StageObject, *, hung: bool = False) -> BenchTruth:
    """The stage in a room of ``ROOMS``; ``dark`` leaves it as it is. ``hung``: the object hangs on a wall."""
    if hung:
        corner = (-HALF_WIDTH_M, -CEILING_M, float(thing.vertices[:, 2].max()) + TABLE_GAP_M)
        wall = SurfaceTruth("wall", corner, (2.0 * HALF_WIDTH_M, 0.0, 0.0), (0.0, 2.0 * CEILING_M, 0.0), PAINT)
        truth = dataclasses.replace(truth, surfaces=(wall,))
    if room == DARK:
        return truth
    truth = dataclasses.replace(
        truth,
        # A wall would hide the object from those that stand behind it.
        surfaces=truth.surfaces or table_and_wall(thing)[: 1 if len(truth.cameras) >= AROUND else None],
        engine="radiosity",
        camera=dataclasses.replace(truth.camera, glare=0.02),
        more_cameras=tuple(dataclasses.replace(one, glare=0.02) for one in truth.more_cameras),
        projectors=tuple(
            dataclasses.replace(one, lamp=dataclasses.replace(one.lamp, flicker=0.01, drift=0.02))
            for one in truth.projectors
        ),
    )
    return truth if room == "room" else rare('The room "hard"').hard(truth, thing)


def table_and_wall(thing: StageObject) -> tuple[SurfaceTruth, ...]:
    """A table under the object, and a wall behind it."""
    low = float(thing.vertices[:, 1].max()) + TABLE_GAP_M
    across = (2.0 * HALF_WIDTH_M, 0.0, 0.0)
    return (
        SurfaceTruth("table", (-HALF_WIDTH_M, low, -FRONT_M), across, (0.0, 0.0, FRONT_M + WALL_M), WOOD),
        SurfaceTruth("wall", (-HALF_WIDTH_M, -CEILING_M, WALL_M), across, (0.0, low + CEILING_M, 0.0), PAINT),
    )


PLACES: Final = (
    ("left", -29.0, 6.0),
    ("right", 27.0, 3.0),
    ("above", 2.0, 27.0),
    ("far-left", -50.0, 14.0),
    ("far-right", 48.0, 12.0),
    ("high", -16.0, 38.0),
)
"""Name, degrees to the right of the camera and above it, as seen from the object."""
DEFAULT: Final = 3
MOST_CAMERAS: Final = 8
AROUND: Final = 4


@dataclass(frozen=True, slots=True)
class Stands:
    """How many projectors, or where each of them: ``placed`` (``lab.emulated.stands.Stand``); else at the ``PLACES`` of
    ``names``; else at the first ``count`` of them.

    ``count`` None: as many as stages of the size have; ``cameras``: how many; from ``AROUND`` on, all devices stand
    all around
    """

    count: int | None = None
    placed: tuple[Any, ...] = ()
    names: tuple[str, ...] = ()
    cameras: int = 1

    @property
    def camera_degrees(self) -> tuple[float, ...]:
        """How far to the right each camera stands: before the object, or four and more all around it."""
        if self.cameras >= AROUND:
            return tuple(360.0 * n / self.cameras for n in range(self.cameras))
        return ((0.0,), (-30.0, 30.0), (-40.0, 0.0, 40.0))[self.cameras - 1]

    def places(self, usual: int) -> Sequence[tuple[str, float, float]]:
        """Name and two angles of each; ``usual``: how many stages of the size have."""
        if self.placed:
            return [(stand.name, *PLACES[0][1:]) for stand in self.placed]
        if self.names:
            by_name = {place[0]: place for place in PLACES}
            return [by_name[name] for name in self.names]
        found = PLACES[: usual if self.count is None else self.count]
        if self.cameras < AROUND:
            return found
        return [(name, 360.0 * (n + 0.5) / len(found), above) for n, (name, _, above) in enumerate(found)]


CHOICES: Final = {"object": (*BUILT_IN, *SOLIDS), "room": ROOMS, "engine": ENGINES}
SETTINGS: Final = {
    "projectors": f"how many projectors there are, a whole number from 1 to {len(PLACES)}, or a list of places, each"
    f" one of {', '.join(place[0] for place in PLACES)}; if omitted: {DEFAULT}, or 4 at size uhd",
    "cameras": f"how many cameras there are, a whole number from 1 to {MOST_CAMERAS}; if omitted: 1",
    "stands": "instead, a TOML file with a table [[stands]] for each projector: name, position_m, rotation_vector,"
    " throw_ratio, centre_share, focus_m, lumens, pupil_m and sharpest_px; without the last, it is drawn at random",
    "object": f"one of {', '.join(CHOICES['object'])}; if omitted: a mesh (`velatura demo --object FILE`), or a vase"
    " and a bust",
    "room": f"one of {', '.join(ROOMS)}; if omitted: {DARK}",
    "engine": f"what works out the light between surfaces, one of {', '.join(ENGINES)}; if omitted: as the room says",
}


def read_stands(settings: Mapping[str, Any], folder: Path) -> Stands:
    """From the settings of the bench; a file's path is relative to ``folder``.

    Raises PluginError("setting-wrong"), DeviceError as ``tables.load``.
    """
    cameras = settings.get("cameras", 1)
    if isinstance(cameras, bool) or not isinstance(cameras, int) or not 1 <= cameras <= MOST_CAMERAS:
        raise _wrong("cameras", cameras)
    return dataclasses.replace(_projectors(settings, folder), cameras=cameras)


def _projectors(settings: Mapping[str, Any], folder: Path) -> Stands:
    count, file = settings.get("projectors"), settings.get("stands")
    if isinstance(count, list | tuple):
        names = [place[0] for place in PLACES]
        if not count or len(set(map(str, count))) != len(count) or any(name not in names for name in count):
            raise _wrong("projectors", count)
        return Stands(len(count), names=tuple(count))
    if count is not None and (isinstance(count, bool) or not isinstance(count, int) or not 1 <= count <= len(PLACES)):
        raise _wrong("projectors", count)
    if file is None:
        return Stands(count)
    try:
        placed = extension("stands", asked_by="Projectors at given places")(folder, str(file))
    except ValueError as error:
        raise _wrong("stands", error.args[0]) from error
    return Stands(len(placed), placed)


def read_choice(settings: Mapping[str, Any], key: str) -> str | None:
    """One of ``CHOICES`` from the settings of the bench; None if omitted. Raises PluginError("setting-wrong")."""
    value = settings.get(key)
    if value is not None and value not in CHOICES[key]:
        raise _wrong(key, value)
    return value


def _wrong(key: str, value: object) -> PluginError:
    return PluginError(
        "setting-wrong",
        what=f"The bench's '{key}' = {toml_value(value)} is wrong.",
        remedy=f"'{key}' is {SETTINGS[key]}.",
    )
