"""The composition root: stage.toml -> devices -> services. Nothing else builds objects."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from controller.bundle.install import CURRENT
from controller.bundle.signing import write_public_key
from controller.calibrate.intrinsics import read_intrinsics
from controller.calibrate.reconstruction import CameraPrior
from controller.calibrate.scale import MeasuredDistance
from controller.capture.acquire import Acquirer
from controller.config import Stage, check_driver_settings, load_stage
from controller.config.models import CameraTable, OpenTable
from controller.errors import UsageError
from controller.play.launch import PlayerProcess, PlayerSettings, replace_player
from controller.session.darkness import Darkness, dark_before
from controller.session.journal import Journal
from controller.session.lamps import LampFile
from controller.session.lighting import lit, power_steps
from controller.session.machine import Event, Machine
from controller.session.mains import Circuit, close_circuits
from controller.session.progress import Reporter
from controller.session.rig import Rig, RigProjector
from controller.session.runner import Runner, Step
from controller.session.safety import LampGuard
from controller.storage import clear_unfinished_writes, exclusive, runtime_folder
from hal.deadline import Deadline, in_seconds
from hal.errors import PluginError
from hal.interfaces import ButtonPanel, Camera, Display, LightSensor, PowerSwitch, Projector
from hal.registry import Driver, Drivers, OpenContext, load_drivers

OPEN_S = 20.0
"""Longest that opening one device may take."""
LONGEST_RUN_S = 12 * 3600.0
LOCK = "run/lock"
"""Held by whoever works on the stage."""


@dataclass(frozen=True, slots=True)
class Checked:
    """A stage whose every table has been checked; nothing is opened or switched on yet."""

    stage: Stage
    drivers: Drivers
    projectors: tuple[tuple[Driver, dict[str, Any]], ...]
    camera: tuple[Driver, dict[str, Any]]
    display: tuple[Driver, dict[str, Any]]
    relays: tuple[tuple[Driver, dict[str, Any]], ...] = ()
    light_sensor: tuple[Driver, dict[str, Any]] | None = None
    key_panel: tuple[Driver, dict[str, Any]] | None = None

    @property
    def prior(self) -> CameraPrior:
        """What stage.toml knows of the camera, and what was measured on the stage.

        Raises UsageError as ``read_intrinsics``, and "stage-key-missing" without any focal length.
        """
        table: CameraTable = self.stage.tables.camera
        measured = self.stage.tables.object.distances
        distances = tuple(MeasuredDistance(d.from_px, d.to_px, d.distance_m, d.sigma_m) for d in measured)
        if table.intrinsics is not None:
            return read_intrinsics(self.stage.path(table.intrinsics)).prior(
                distance_m=table.distance_m, distance_rel_sigma=table.distance_rel_sigma, distances=distances
            )
        if table.focal_length_px is None:
            allowed = "a number above 0, unless intrinsics names a file of `velatura camera calibrate`"
            raise table.place.missing("focal_length_px", allowed, written=[])
        return CameraPrior(
            focal_length_px=table.focal_length_px,
            focal_length_rel_sigma=table.focal_length_rel_sigma,
            distance_m=table.distance_m,
            distance_rel_sigma=table.distance_rel_sigma,
            distances=distances,
        )

    @property
    def names(self) -> tuple[str, ...]:
        """The projectors' names in stage order."""
        return tuple(table.name for table in self.stage.tables.projectors)


def check_stage(folder: Path, *, drivers: Drivers | None = None) -> Checked:
    """Read stage.toml and check every key, the drivers' own among them, before anything is opened.

    Raises UsageError (see ``controller.config.load_stage``) and PluginError("driver-unknown").
    """
    stage = load_stage(folder)
    drivers = drivers or load_drivers(benches=False)
    tables = stage.tables

    def checked(kind: str, table: OpenTable, name: str) -> tuple[Driver, dict[str, Any]]:
        try:
            driver = drivers.get(kind, name)
        except PluginError as error:
            names = ", ".join(driver.name for driver in drivers.list if driver.kind == kind) or "none is installed"
            raise table.place.wrong_value("driver", name, f"is not a {kind} driver", f"one of {names}") from error
        return driver, check_driver_settings(table, driver)

    return Checked(
        stage=stage,
        drivers=drivers,
        projectors=tuple(checked("projector", table, table.driver) for table in tables.projectors),
        camera=checked("camera", tables.camera, tables.camera.driver),
        display=checked("display", tables.display, tables.display.driver),
        relays=tuple(checked("power_switch", table, table.driver) for table in tables.relays),
        light_sensor=(
            None if tables.light_sensor is None
            else checked("light_sensor", tables.light_sensor, tables.light_sensor.driver)
        ),
        key_panel=(
            None if tables.key_panel is None else checked("button_panel", tables.key_panel, tables.key_panel.driver)
        ),
    )  # fmt: skip


@contextlib.contextmanager
def opened(checked: Checked, *, deadline: Deadline, plays: bool = False) -> Iterator[Rig]:
    """Open every device of the stage and start the player; close them, and end the player, on leaving.

    ``plays``: the player starts with the installed bundle, and a start that shows no picture of it counts as failed.

    Mains relays are closed first. They and the lamps are left as they are: switching them off is ``lit``'s.
    """
    stage = checked.stage
    context = OpenContext(stage=stage.folder, runtime=runtime_folder(stage.folder))
    with contextlib.ExitStack() as stack:
        darkness = light_sensor(checked, context, stack, deadline)
        circuits = mains_circuits(checked, context, stack, deadline)
        close_circuits(circuits, deadline=deadline)
        guards = []
        ledger = LampFile(stage.folder / LampFile.NAME)
        at_least = stage.tables.safety.at_least()
        for table, (driver, settings) in zip(stage.tables.projectors, checked.projectors, strict=True):
            projector = cast("Projector", open_device(table, driver, settings, context, deadline))
            guard = LampGuard(table.name, projector, ledger, at_least=at_least)
            stack.callback(guard.close)
            guards.append(guard)
        driver, settings = checked.camera
        camera = cast("Camera", open_device(stage.tables.camera, driver, settings, context, deadline))
        stack.callback(camera.close)
        # A stage that names the player's socket has a player already, for instance systemd's.
        if checked.stage.tables.display.driver == "player" and "socket" not in checked.display[1]:
            stack.enter_context(_player(stage, context, plays=plays))
        driver, settings = checked.display
        display = cast("Display", open_device(stage.tables.display, driver, settings, context, deadline))
        stack.callback(display.close)
        yield replace(rig_of(stage, guards, camera, display), circuits=circuits, darkness=darkness)


@contextlib.contextmanager
def technicians_panel(checked: Checked, *, deadline: Deadline) -> Iterator[ButtonPanel | None]:
    """The panel of [key_panel] for a ``session.keys.KeyService``, closed on leaving; None where the stage has none."""
    table = checked.stage.tables.key_panel
    if table is None or checked.key_panel is None:
        yield None
        return
    context = OpenContext(stage=checked.stage.folder)
    panel = cast("ButtonPanel", open_device(table, *checked.key_panel, context, deadline))
    with contextlib.closing(panel):
        yield panel


def mains_circuits(
    checked: Checked, context: OpenContext, stack: contextlib.ExitStack, deadline: Deadline
) -> tuple[Circuit, ...]:
    circuits = []
    for table, (driver, settings) in zip(checked.stage.tables.relays, checked.relays, strict=True):
        switch = cast("PowerSwitch", open_device(table, driver, settings, context, deadline))
        stack.callback(switch.close)
        circuits += [
            Circuit(f"{table.name} {mains.channel}", mains.channel, mains.feeds, table.boot_s, switch)
            for mains in table.mains
        ]
    return tuple(circuits)


def light_sensor(
    checked: Checked, context: OpenContext, stack: contextlib.ExitStack, deadline: Deadline
) -> Darkness | None:
    table = checked.stage.tables.light_sensor
    if table is None or checked.light_sensor is None:
        return None
    sensor = cast("LightSensor", open_device(table, *checked.light_sensor, context, deadline))
    stack.callback(sensor.close)
    return Darkness(sensor, table.most_lux)


def open_device(
    table: OpenTable, driver: Driver, settings: Mapping[str, Any], context: OpenContext, deadline: Deadline
) -> object:
    """Open a device; what the driver finds wrong in its settings is a mistake in stage.toml, told with its line."""
    try:
        return driver.open(settings, context, deadline.within(OPEN_S))
    except PluginError as error:
        place = table.place
        named = (key for key, value in settings.items() if f"'{key}'" in error.what or f"'{value}'" in error.what)
        line = place.line(next(named, None))
        raise UsageError(error.code, what=f"{place.file}, line {line}: {error.what}", remedy=error.remedy) from error


def _player(stage: Stage, context: OpenContext, *, plays: bool) -> PlayerProcess:
    """The player of this stage; a context manager that ends it."""
    assert context.runtime is not None
    settings = player_settings(stage, context.runtime, plays=plays)
    # A run that was killed leaves its player, which plays on by design; it still has our socket.
    return replace_player(context.runtime, settings)


def player_settings(stage: Stage, runtime: Path, *, plays: bool) -> PlayerSettings:
    """What the stage's player is started with; ``plays``: with the installed bundle, if there is one."""
    table = stage.tables.display
    frames = None if table.frames is None else stage.path(table.frames)
    if frames is not None:
        frames.parent.mkdir(parents=True, exist_ok=True)
    # Given as the link, so that a bundle that never shows a picture is given up (docs/bundle-format.md). Not to a
    # calibration, which must go on whatever is installed.
    bundle = stage.folder / "bundles" / CURRENT
    return PlayerSettings(
        outputs=[(output.name, output.width_px, output.height_px) for output in table.outputs],
        frames=frames,
        where={output.name: output.where for output in table.outputs if output.where is not None},
        bundle=bundle if plays and bundle.is_symlink() else None,
        trusted=_key_files(stage.tables.bundle.trusted_keys, runtime, "trusted"),
        revoked=_key_files(stage.tables.bundle.revoked_keys, runtime, "revoked"),
        allow_unsigned=stage.tables.bundle.allow_unsigned,
    )


def _key_files(keys: Sequence[str], folder: Path, name: str) -> list[Path]:
    """Public key files for the player, which reads no stage.toml."""
    paths = [folder / f"{name}-{number}.pub" for number in range(len(keys))]
    for path, key in zip(paths, keys, strict=True):
        write_public_key(path, bytes.fromhex(key))
    return paths


def rig_of(stage: Stage, guards: Sequence[LampGuard], camera: Camera, display: Display) -> Rig:
    sizes = {
        output.name: (output.width_px, output.height_px) for output in display.outputs(deadline=in_seconds(OPEN_S))
    }
    for table in stage.tables.projectors:
        if table.output not in sizes:
            raise table.place.wrong_value("output", table.output, "is not an output of the display",
                                          f"one of {', '.join(sizes)}")  # fmt: skip
    projectors = tuple(
        RigProjector(table.name, table.output, sizes[table.output], guard)
        for table, guard in zip(stage.tables.projectors, guards, strict=True)
    )
    acquirer = Acquirer(
        display,
        camera,
        iso=stage.tables.camera.iso,
        aperture_f=stage.tables.camera.aperture_f,
        settle_s=stage.tables.capture.settle_s,
    )
    return Rig(stage.folder, projectors, camera, display, acquirer)


def marker(name: str, title: str, *, enter: Event | None = None, leave: Event | None = None) -> Step:
    """A step that only moves the state machine; never skipped, so that a resumed run is in the right state too."""
    return Step(name, lambda _: (), title=title, weight=0.01, enter=enter, leave=leave, always=True)


@dataclass(frozen=True, slots=True)
class Held:
    """A stage whose lock, lamps and player somebody keeps, the kiosk; ``rig`` None for work that touches no device."""

    folder: Path
    rig: Rig | None


_HELD: ContextVar[Held | None] = ContextVar("held", default=None)


@contextlib.contextmanager
def holding(held: Held) -> Iterator[None]:
    """Inside, what runs on that stage (in this thread) uses the holder's devices and lock, and leaves its lamps lit."""
    token = _HELD.set(held)
    try:
        yield
    finally:
        _HELD.reset(token)


@contextlib.contextmanager
def stage_lock(folder: Path) -> Iterator[None]:
    """The lock of whoever works on the stage. Raises UsageError("already-running")."""
    held = _HELD.get()
    if held is not None and held.folder == folder:
        yield
        return
    with exclusive(folder / LOCK, what_is_running="Velatura"):
        yield


MakeSteps = Callable[[Rig, Path], Sequence[Step]]
"""The steps of a run on the opened stage; the path is the run's folder."""


def run_on_stage(
    checked: Checked,
    make_steps: MakeSteps,
    *,
    name: str,
    reporter: Reporter,
    cancel: threading.Event,
    around: contextlib.AbstractContextManager[object] | None = None,
    dark: bool = False,
    plays: bool = False,
    again: bool = False,
) -> Path:
    """Open the stage, run the steps of a new or unfinished run with the lamps on, and leave the lamps safe.

    ``around`` is entered before the devices are opened and left when they are closed; ``dark``: not in a bright room,
    where the stage has a light sensor; ``plays``: as in ``opened``; ``again``: a finished run of the name is gone on
    with, too, and what it has done already is not repeated. Returns the run's folder.
    Raises what the steps raise; UsageError("already-running") if another program works on the stage.
    """
    stage = checked.stage
    deadline = in_seconds(LONGEST_RUN_S, cancel)
    safety = stage.tables.safety
    held = _HELD.get()
    if held is not None and held.folder == stage.folder and held.rig is not None:
        return _run_held(held.rig, make_steps, name=name, reporter=reporter, deadline=deadline, dark=dark)
    with (
        exclusive(stage.folder / LOCK, what_is_running="Velatura"),
        around or contextlib.nullcontext(),
        opened(checked, deadline=deadline, plays=plays) as rig,
        Journal(unfinished_run(stage.folder, name, finished=again)) as journal,
    ):
        clear_unfinished_writes(journal.folder)
        machine = Machine(journal.record_change)
        first = dark_before(rig.darkness) if dark else []
        steps = [*first, *power_steps(rig, power_up_s=safety.power_up_s), *make_steps(rig, journal.folder)]
        with lit(rig, machine, power_down_s=safety.power_down_s, reporter=reporter):
            Runner(steps, journal, reporter=reporter, machine=machine).run(name, deadline=deadline)
        return journal.folder


def _run_held(
    rig: Rig, make_steps: MakeSteps, *, name: str, reporter: Reporter, deadline: Deadline, dark: bool
) -> Path:
    """As ``run_on_stage`` with lamps that are lit already, and stay so; the state machine is the holder's."""
    with Journal(unfinished_run(rig.stage, name)) as journal:
        clear_unfinished_writes(journal.folder)
        first = dark_before(rig.darkness) if dark else []
        Runner([*first, *make_steps(rig, journal.folder)], journal, reporter=reporter).run(name, deadline=deadline)
        return journal.folder


def unfinished_run(stage: Path, name: str, *, finished: bool = False) -> Path:
    """The newest run folder of ``name`` whose work was begun and not finished, or a new one, not yet made.

    ``finished``: the newest one, finished or not. For the holder of the stage's lock.
    """
    runs = stage / "runs"
    for folder in sorted(runs.glob(f"*-{name}"), reverse=True):
        if (folder / Journal.FILE).exists():
            with Journal(folder) as journal:
                outcomes = journal.outcomes()
            if finished or not outcomes or outcomes[-1][1] != "done":
                return folder
            break
    stamp = time.strftime("%Y%m%d-%H%M%S")
    return runs / f"{stamp}-{name}"
