"""Checks every key of stage.toml, including the drivers' keys, before a device is opened; and the stage's time zone."""

from __future__ import annotations

import tomllib
import zoneinfo
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import tzinfo
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from controller.config import Stage, check_driver_settings, load_stage
from controller.config.models import OpenConfigTable, PoseTable, ProjectorTable, RelaysTable
from controller.core.errors import UsageError
from controller.core.extras import extra_missing
from controller.core.files import read_text
from controller.stage.rig.elsewhere import DeviceElsewhere
from hal.errors import DeviceError, DriverFault, PluginError
from hal.registry import Driver, Drivers, OpenContext, check_device, load_drivers

if TYPE_CHECKING:
    from controller.optics.calibrate.geometry.values import CameraPrior


@dataclass(frozen=True, slots=True)
class Checked:
    """A completely checked stage; no device is opened yet.

    ``faults``: drivers that failed to check their settings. Their devices may still open. ``dousers``: of each
    projector. ``elsewhere``: the devices of other computers.
    """

    stage: Stage
    drivers: Drivers
    projectors: tuple[tuple[Driver, dict[str, Any]], ...]
    cameras: tuple[tuple[Driver, dict[str, Any]], ...]
    display: tuple[Driver, dict[str, Any]]
    relays: tuple[tuple[Driver, dict[str, Any]], ...] = ()
    light_sensor: tuple[Driver, dict[str, Any]] | None = None
    key_panel: tuple[Driver, dict[str, Any]] | None = None
    faults: tuple[DriverFault, ...] = ()
    dousers: tuple[tuple[Driver, dict[str, Any]] | None, ...] = ()
    elsewhere: tuple[DeviceElsewhere, ...] = ()

    def prior(self, view: str | None = None) -> CameraPrior:
        """The values of a view's camera from stage.toml and from measurements on the stage; None: of the first view.

        Distances were measured from the places, and in the pictures, of the cameras in stage.toml alone.
        Raises UsageError as ``read_intrinsics``, and "stage-key-missing" without any focal length.
        """
        from controller.optics.calibrate.geometry.intrinsics import read_intrinsics
        from controller.optics.calibrate.geometry.values import CameraPrior, MeasuredDistance

        views = self.stage.tables.views
        name, table = views[0] if view is None else (view, dict(views).get(view, views[0][1]))
        measured = self.stage.tables.object.distances if name == views[0][0] else ()
        distance_m = table.distance_m if name in dict(views) else None
        distances = tuple(MeasuredDistance(d.from_px, d.to_px, d.distance_m, d.sigma_m) for d in measured)
        pose = table.pose if name in dict(views) else None
        if table.intrinsics is not None:
            prior = read_intrinsics(self.stage.path(table.intrinsics)).prior(
                distance_m=distance_m, distance_rel_sigma=table.distance_rel_sigma, distances=distances
            )
            return replace(prior, pose=pose)
        if table.focal_length_px is None:
            allowed = "a number above 0, or intrinsics with a file from `velatura camera calibrate`"
            raise table.place.missing("focal_length_px", allowed, written=[])
        return CameraPrior(
            focal_length_px=table.focal_length_px,
            focal_length_rel_sigma=table.focal_length_rel_sigma,
            distance_m=distance_m,
            distance_rel_sigma=table.distance_rel_sigma,
            distances=distances,
            pose=pose,
        )

    @property
    def poses(self) -> dict[str, PoseTable | None]:
        """What was measured of where each projector stands, by its name, in stage order."""
        return {table.name: table.pose for table in self.stage.tables.projectors}

    @property
    def names(self) -> tuple[str, ...]:
        """The projectors' names in stage order."""
        return tuple(table.name for table in self.stage.tables.projectors)


def check_stage(folder: Path, *, drivers: Drivers | None = None, instead: Path | None = None) -> Checked:
    """Read stage.toml and check every key, including the drivers' keys; opens no device.

    ``instead``: the file that is read in the place of stage.toml.

    Raises UsageError (see ``controller.config.load_stage``) and PluginError("driver-unknown").
    """
    stage = load_stage(folder, instead=instead)
    drivers = drivers or load_drivers(benches=False)
    tables = stage.tables

    faults: list[DriverFault] = []
    elsewhere: list[DeviceElsewhere] = []

    def checked(kind: str, table: OpenConfigTable, name: str) -> tuple[Driver, dict[str, Any]]:
        try:
            driver = drivers.get(kind, name)
        except PluginError as error:
            missing = extra_missing(drivers.missing_for(name))
            if missing is not None:
                raise missing from error
            names = ", ".join(driver.name for driver in drivers.list if driver.kind == kind) or "none is installed"
            raise table.place.wrong_value("driver", name, f"is not a {kind} driver", f"one of {names}") from error
        settings = check_driver_settings(table, driver)
        try:
            name = str(getattr(table, "name", ""))
            check_device(driver, settings, OpenContext(stage=stage.folder), name=name)
        except DriverFault as error:
            faults.append(error)
        except DeviceError as error:
            raise mistake_in(table, settings, error) from error
        if isinstance(table, ProjectorTable | RelaysTable) and table.host:
            alone_s = tables.display.alone_s if tables.display.alone == "black" else None
            rules = tables.safety.at_least()
            elsewhere.append(DeviceElsewhere(table.host, kind, name, driver.name, settings, rules, alone_s))
            driver = elsewhere[-1].opened_by(driver)
        return driver, settings

    return Checked(
        stage=stage,
        drivers=drivers,
        projectors=tuple(checked("projector", table, table.driver) for table in tables.projectors),
        cameras=tuple(checked("camera", table, table.driver) for _, table in tables.views),
        display=checked("display", tables.display, tables.display.driver),
        relays=tuple(checked("power_switch", table, table.driver) for table in tables.relays),
        light_sensor=(
            None if tables.light_sensor is None
            else checked("light_sensor", tables.light_sensor, tables.light_sensor.driver)
        ),
        key_panel=(
            None if tables.key_panel is None else checked("button_panel", tables.key_panel, tables.key_panel.driver)
        ),
        dousers=tuple(
            None if table.douser is None else checked("douser", table.douser, table.douser.driver)
            for table in tables.projectors
        ),
        faults=tuple(faults),
        elsewhere=tuple(elsewhere),
    )  # fmt: skip


def mistake_in(table: OpenConfigTable, settings: Mapping[str, Any], error: DeviceError) -> UsageError:
    """Turn a driver's error about its settings into an error with the line in stage.toml."""
    place = table.place
    named = (key for key, value in settings.items() if f"'{key}'" in error.what or f"'{value}'" in error.what)
    line = place.line(next(named, None))
    return UsageError(error.code, what=f"{place.file}, line {line}: {error.what}", remedy=error.remedy)


PANELS_FILE: Final = "schedule.toml"
"""Written by the panel; it replaces the table [schedule] of stage.toml."""


def time_zone(checked: Checked) -> tzinfo | None:
    """None, for the computer's own, on a stage that has no opening hours and names no zone, or one that is unknown."""
    table = checked.stage.tables.schedule
    named = table.time_zone if table.hours or table.time_zone != "UTC" else ""
    file = checked.stage.folder / PANELS_FILE
    if file.exists():
        try:
            named = str(tomllib.loads(read_text(file)).get("time_zone", named))
        except (UsageError, ValueError, OSError):
            return None
    try:
        return zoneinfo.ZoneInfo(named) if named else None
    except (zoneinfo.ZoneInfoNotFoundError, ValueError, OSError):
        return None
