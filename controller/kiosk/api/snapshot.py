"""The state that the panel's first page shows, read from a running service."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from controller.core.arrays import Float64
from controller.core.errors import VelaturaError
from controller.kiosk.decide.interfaces import title_of
from controller.kiosk.service import Service
from controller.kiosk.state import BundleIdentity, DeviceRow, DriftCheck, Grade, Job, KioskState, Place
from controller.kiosk.store import runs
from controller.kiosk.world import World
from controller.run.state_machine import State
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.names import json_path, read_json
from controller.stage.sessions.calibrations import finished_calibrations

ASIDE_DEG: Final = 12.0
"""Nearer to the camera's direction than this, a projector is in front, neither left nor right."""
BEHIND_DEG: Final = 110.0
LEAST_CROSSING: Final = 0.02
"""Of the axes: camera and one projector 12 degrees apart. Nearly parallel ones meet anywhere."""
_UNREADABLE: Final = (VelaturaError, OSError, ValueError, KeyError, TypeError, AttributeError, np.linalg.LinAlgError)


def places(stage: Path) -> tuple[Place, ...]:
    """One for each projector, in the run's order; empty without a finished calibration that can be read."""
    try:
        run = next(iter(finished_calibrations(stage)), None)
        return () if run is None else _placed(read_json(json_path(run, StepKind.GEOMETRY)))
    except _UNREADABLE:
        return ()


def _placed(figures: Mapping[str, Any]) -> tuple[Place, ...]:
    centres, axes = [np.zeros(3)], [np.array([0.0, 0.0, 1.0])]
    for row in figures["projectors"].values():
        rotation, shift = np.array(row["rotation"], float), np.array(row["translation_m"], float)
        width, height = row["size_px"]
        middle = np.linalg.solve(np.array(row["matrix"], float), np.array([width / 2, height / 2, 1.0]))
        centres.append(-rotation.T @ shift)
        axes.append(rotation.T @ middle / np.linalg.norm(middle))
    on = _where_they_meet(centres, axes)
    if on is None or not np.isfinite([on, *centres]).all():
        return ()
    return tuple(
        _place(name, centre - on, -on) for name, centre in zip(figures["projectors"], centres[1:], strict=True)
    )


def _where_they_meet(centres: list[Float64], axes: list[Float64]) -> Float64 | None:
    """The point (3,) nearest to all axes: all devices look at the object. None where the axes do not say where."""
    across = [np.eye(3) - np.outer(axis, axis) for axis in axes]
    right = sum((part @ centre for part, centre in zip(across, centres, strict=True)), np.zeros(3))
    whole = np.sum(across, axis=0)
    if np.linalg.eigvalsh(whole)[0] < LEAST_CROSSING:
        return None
    on = np.asarray(np.linalg.solve(whole, right), np.float64)
    in_front = all((on - centre) @ axis > 0 for centre, axis in zip(centres, axes, strict=True))
    return on if in_front else None


def _place(name: str, from_object: Float64, camera: Float64) -> Place:
    """``from_object`` (3,) and ``camera`` (3,): both from the object, metres, in the camera's frame (y down)."""
    turned = math.atan2(camera[0], -camera[2])
    aside = math.degrees(math.atan2(from_object[0], -from_object[2]) - turned)
    aside = (aside + 180) % 360 - 180
    up = math.degrees(math.atan2(-from_object[1], math.hypot(from_object[0], from_object[2])))
    return Place(name, _word(aside, up), aside, up)


def _word(aside_deg: float, up_deg: float) -> str:
    depth = "behind" if abs(aside_deg) > BEHIND_DEG else ""
    side = "" if abs(aside_deg) < ASIDE_DEG else "left" if aside_deg < 0 else "right"
    height = "" if abs(up_deg) < ASIDE_DEG else "above" if up_deg > 0 else "below"
    return " ".join(filter(None, (depth, side, height))) or "in front"


GRADES_EVERY_S: Final = 10.0


class Snapshots:
    """Use it only in the reconciler's thread."""

    def __init__(self, stage: Path, world: World) -> None:
        self._stage, self._world = stage, world
        self._grades: tuple[float, tuple[Grade, ...]] = (0.0, ())
        self._bundle: Path | None = None
        self._places: tuple[Place, ...] = ()
        self._drifts: tuple[DriftCheck, ...] = ()
        self._since = ("", 0.0)
        self.others: Mapping[str, str] = {}
        """Warnings of parts that belong to no service, such as the connection to a broker; "" for none."""

    def of(self, service: Service, revision: int) -> KioskState:
        """The state now; the grades come from the disk and may be some seconds old, but not older than the bundle."""
        shown, wanted = service.player.view.shown, service.player.want
        job = self._job(service)
        state, reason = self._state(service, job)
        if self._since[0] != state:
            self._since = (state, self._world.wall())
        bundle = service.bundles.bundle()
        at_s, grades = self._grades
        if self._world.monotonic() - at_s > GRADES_EVERY_S or not at_s or bundle != self._bundle:
            grades = runs.grades(self._stage, service.tables.calibration.worst_grade)
            self._grades, self._bundle = (self._world.monotonic(), grades), bundle
            self._places, self._drifts = places(self._stage), runs.drifts(self._stage)
        index = service.bundles.index(bundle)
        identity = None
        if index is not None and bundle is not None:
            identity = BundleIdentity(index.revision, bundle.stem, float(index.created_unix_s))
        live = service.reconciler.live
        if shown is not None and shown.appearance == service.jobs.made:
            service.jobs.seen()
        return KioskState(
            revision=revision,
            stage=service.tables.stage.name,
            state=state,
            reason=reason,
            since_unix_s=self._since[1],
            devices=(*service.rows(), self._player_row(service), service.disk.row),
            job=job,
            playing=shown.appearance if shown is not None else "",
            disk_free_bytes=service.disk.free_bytes,
            in_turn=shown is not None and bool(shown.appearance) and bool(wanted is not None and wanted.in_turn),
            next_event=service.reconciler.plan.next,
            bundle=identity,
            lamps=service.lamps,
            grades=grades,
            identifying=service.player.identifying,
            warnings=self._warnings(service),
            failures=service.log.failures,
            places=self._places,
            drifts=self._drifts,
            black=live.black,
            paused=bool(live.held),
            made=service.jobs.made if service.jobs.made in service.bundles.names() else "",
            brightness=round(100 * live.brightness, 1),
            dose_klx_h=service.devices.dose_klx_h,
        )

    def _job(self, service: Service) -> Job | None:
        """The job that runs, or waits for its lamps; else the last one."""
        waiting = service.reconciler.waiting
        if waiting is None or not waiting.light:
            return service.jobs.job
        number = waiting.number or service.jobs.number + 1
        return Job(number, title_of(waiting), waits="It starts when the lamps are lit and steady.")

    def _state(self, service: Service, job: Job | None) -> tuple[str, str]:
        """A closed stage that computes is not only closed."""
        machine, request = service.reconciler.machine, service.jobs.running
        if machine.state is not State.OFF or request is None or job is None or job.ended:
            return machine.state.value, machine.reason
        state = State.PUBLISHING if request.kind == "publish" else State.SOLVING
        return state.value, f"{job.name}. The stage is closed, and the lamps are off."

    def _warnings(self, service: Service) -> tuple[str, ...]:
        said = (service.problem, service.player.view.warning, service.bundle_watch.warning)
        others = filter(None, self.others.values())
        return (*service.devices.warnings, *(one.text for one in said if one is not None), *others)

    def _player_row(self, service: Service) -> DeviceRow:
        problem = service.player.view.problem
        what, remedy = (None, "") if problem is None else (problem.what, problem.remedy)
        return DeviceRow("player", "display", "player", (), what, remedy)
