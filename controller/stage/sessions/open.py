"""From a checked stage to opened devices, a player and a rig. The only place that builds them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Final, cast

from controller.bundle.install import CURRENT
from controller.bundle.signing import write_public_key
from controller.config import Stage
from controller.config.models import OpenConfigTable, OutputTable
from controller.core import kiosk_places
from controller.optics.capture.acquire import Acquirer
from controller.play.control.launch import PlayerProcess, PlayerSettings, replace_player
from controller.stage.rig.ambient_light import AmbientLightLimit
from controller.stage.rig.douser import ProjectorWithDouser
from controller.stage.rig.lamp_guard import LampGuard
from controller.stage.rig.lamp_ledger import LampFile
from controller.stage.rig.power import Circuit, close_circuits
from controller.stage.rig.rig import Rig, RigCamera, RigProjector
from controller.stage.rig.shared_display import SharedDisplay
from controller.stage.sessions.check import Checked, mistake_in
from controller.stage.sessions.run import open_context, used_runtime_folder
from hal import registry
from hal.deadline import Cancelled, Deadline, in_seconds
from hal.errors import CodedError, DeviceError, PluginError
from hal.interfaces import ButtonPanel, Camera, Device, Display, Douser, LightSensor, PowerSwitch, Projector
from hal.registry import Driver, OpenContext

PLAYERS_KEYS: Final = Path("keys") / "players"
"""In the stage's folder: the authority of the computers that have outputs of it."""
OPEN_S = 20.0
"""Longest that opening one device may take."""


@contextlib.contextmanager
def opened_rig(checked: Checked, *, deadline: Deadline, plays: bool = False, only: str | None = None) -> Iterator[Rig]:
    """Open every device of the stage and start the player; on leaving, close the devices and end the player.

    ``plays``: the player starts with the installed bundle; the start fails if it shows no picture of it.
    ``only``: the view of the only camera that is opened. A camera that is not the first may be missing.

    Mains relays are closed first, once other computers have said that they have the drivers of their devices. This
    function switches no relay or lamp off: ``lit`` does that.
    """
    stage = checked.stage
    with contextlib.ExitStack() as stack:
        context = open_context(stage.folder, runtime=stack.enter_context(used_runtime_folder(stage.folder)))
        # The player of an installed kiosk is systemd's.
        starts = stage.tables.display.driver == "player" and not kiosk_places.is_installed(stage.folder)
        # Other computers are asked by way of it. Without them, it starts once the devices are there.
        if starts and checked.elsewhere:
            stack.enter_context(_player(stage, context, plays=plays))
        for device in checked.elsewhere:
            device.ask(context, "check", deadline=deadline.within(OPEN_S))
        ambient_limit = light_sensor(checked, context, stack, deadline)
        circuits = mains_circuits(checked, context, stack, deadline)
        close_circuits(circuits, deadline=deadline)
        guards = []
        ledger = LampFile(stage.folder / LampFile.NAME)
        at_least = stage.tables.safety.at_least()
        for number, table in enumerate(stage.tables.projectors):
            projector = open_projector(checked, number, context, deadline)
            guard = LampGuard(table.name, projector, ledger, at_least=at_least)
            _closed_by(stack, guard)
            guards.append(guard)
        cameras = {}
        absent: dict[str, CodedError] = {}
        for number, name in enumerate(views_opened(checked, only)):
            try:
                cameras[name] = open_camera(checked, name, context, deadline)
            except DeviceError as error:
                if isinstance(error, Cancelled) or not number:
                    raise
                absent[name] = error
            else:
                _closed_by(stack, cameras[name])
        if starts and not checked.elsewhere:
            stack.enter_context(_player(stage, context, plays=plays))
        driver, settings = checked.display
        display = cast("Display", open_device(stage.tables.display, driver, settings, context, deadline))
        _closed_by(stack, display)
        rig = rig_of(stage, guards, cameras, display)
        yield replace(rig, circuits=circuits, ambient_limit=ambient_limit, absent=absent)


def views_opened(checked: Checked, only: str | None = None) -> tuple[str, ...]:
    """The views whose cameras are opened: all, or ``only`` one. A camera that is carried from place to place is in
    stage.toml once for each place, and opened for the first.

    A place that is not in stage.toml is photographed by the stage's only camera.
    """
    if only is not None:
        return (only,)
    views = [name for name, _ in checked.stage.tables.views]
    return tuple(name for n, name in enumerate(views) if checked.cameras[n] not in checked.cameras[:n])


def open_camera(checked: Checked, view: str, context: OpenContext, deadline: Deadline) -> Camera:
    """The camera of a view. Raises as ``open_device``."""
    views = checked.stage.tables.views
    number = next((n for n, (name, _) in enumerate(views) if name == view), 0)
    return cast("Camera", open_device(views[number][1], *checked.cameras[number], context, deadline))


@contextlib.contextmanager
def technicians_panel(checked: Checked, *, deadline: Deadline) -> Iterator[ButtonPanel | None]:
    """The panel of [key_panel] for a ``rig.key_panel.KeyService``, closed on leaving; None if the stage has none."""
    table = checked.stage.tables.key_panel
    if table is None or checked.key_panel is None:
        yield None
        return
    context = open_context(checked.stage.folder)
    panel = cast("ButtonPanel", open_device(table, *checked.key_panel, context, deadline))
    with contextlib.closing(panel):
        yield panel


def open_projector(checked: Checked, number: int, context: OpenContext, deadline: Deadline) -> Projector:
    """The projector of this number, with its douser if it has one."""
    table, (driver, settings) = checked.stage.tables.projectors[number], checked.projectors[number]
    projector = cast("Projector", open_device(table, driver, settings, context, deadline))
    douser = checked.dousers[number]
    if table.douser is None or douser is None:
        return projector
    place, (its_driver, its_settings) = table.douser, douser

    def open_douser(until: Deadline) -> Douser:
        return cast("Douser", open_device(place, its_driver, its_settings, context, until))

    return ProjectorWithDouser(table.name, projector, open_douser)


def mains_circuits(
    checked: Checked, context: OpenContext, stack: contextlib.ExitStack, deadline: Deadline
) -> tuple[Circuit, ...]:
    circuits = []
    for table, (driver, settings) in zip(checked.stage.tables.relays, checked.relays, strict=True):
        switch = cast("PowerSwitch", open_device(table, driver, settings, context, deadline))
        _closed_by(stack, switch)
        circuits += [
            Circuit(f"{table.name} {mains.channel}", mains.channel, mains.feeds, table.boot_s, switch)
            for mains in table.mains
        ]
    return tuple(circuits)


def light_sensor(
    checked: Checked, context: OpenContext, stack: contextlib.ExitStack, deadline: Deadline
) -> AmbientLightLimit | None:
    table = checked.stage.tables.light_sensor
    if table is None or checked.light_sensor is None:
        return None
    sensor = cast("LightSensor", open_device(table, *checked.light_sensor, context, deadline))
    _closed_by(stack, sensor)
    return AmbientLightLimit(sensor, table.most_lux)


def open_device(
    table: OpenConfigTable, driver: Driver, settings: Mapping[str, Any], context: OpenContext, deadline: Deadline
) -> object:
    """Open a device as ``hal.registry.open_device``.

    An error that the driver finds in its settings is raised with the line in stage.toml.
    """
    try:
        name = str(getattr(table, "name", ""))
        return registry.open_device(driver, settings, context, deadline.within(OPEN_S), name=name)
    except PluginError as error:
        raise mistake_in(table, settings, error) from error


def _closed_by(stack: contextlib.ExitStack, device: Device) -> None:
    """Close ``device`` on leaving. A driver's error here never hides the error that ended the work."""

    def leave(kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            device.close()
        except DeviceError as fault:
            if error is None:
                raise
            error.add_note(str(fault))

    stack.push(leave)


def _player(stage: Stage, context: OpenContext, *, plays: bool) -> PlayerProcess:
    """The player of this stage; a context manager that ends it."""
    assert context.runtime is not None
    settings = player_settings(stage, context.runtime, plays=plays)
    # A killed run leaves its player running by design; it still has our socket.
    return replace_player(context.runtime, settings)


def player_settings(stage: Stage, runtime: Path, *, plays: bool) -> PlayerSettings:
    """Arguments of the stage's player; ``plays``: with the installed bundle, if there is one."""
    table = stage.tables.display
    frames = None if table.frames is None else stage.path(table.frames)
    if frames is not None:
        frames.parent.mkdir(parents=True, exist_ok=True)
    # As the link, so that the player drops a bundle that never shows a picture. Not for a
    # calibration, which must work with any installed bundle.
    bundle = stage.folder / "bundles" / CURRENT
    # What systemd starts the player with lasts: it must not change with the first bundle, nor go with the power.
    installed = kiosk_places.is_installed(stage.folder)
    keys = kiosk_places.STATE if installed else runtime
    return PlayerSettings(
        outputs=[(output.name, output.width_px, output.height_px) for output in table.outputs],
        frames=frames,
        where={output.name: place for output in table.outputs if (place := _where(output))},
        hosts={output.name: output.elsewhere for output in table.outputs if output.elsewhere},
        keys=stage.folder / PLAYERS_KEYS if any(output.host for output in table.outputs) else None,
        alone=(table.alone_s, table.alone),
        bundle=bundle if plays and (installed or bundle.is_symlink()) else None,
        trusted=_key_files(stage.tables.bundle.trusted_keys, keys, "trusted"),
        revoked=_key_files(stage.tables.bundle.revoked_keys, keys, "revoked"),
        allow_unsigned=stage.tables.bundle.allow_unsigned,
    )


def _where(output: OutputTable) -> str:
    """Connector or serial number, and the output's place in its picture, as the player's options name them."""
    if output.left_top_px is None:
        return output.where or ""
    return "{}@{},{}".format(output.where or output.name, *output.left_top_px)


def _key_files(keys: Sequence[str], folder: Path, name: str) -> list[Path]:
    """Public key files for the player, which does not read stage.toml."""
    paths = [folder / f"{name}-{number}.pub" for number in range(len(keys))]
    for path, key in zip(paths, keys, strict=True):
        write_public_key(path, bytes.fromhex(key))
    return paths


def rig_of(stage: Stage, guards: Sequence[LampGuard], cameras: Mapping[str, Camera], display: Display) -> Rig:
    """``cameras``: by the names of their views, at least one; the first is the rig's own."""
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
    tables, shared = dict(stage.tables.views), SharedDisplay(display)
    found = []
    for name, camera in cameras.items():
        seat = shared.seat()
        own = tables.get(name, stage.tables.views[0][1])
        acquirer = Acquirer(
            display, camera, iso=own.iso, aperture_f=own.aperture_f, settle_s=stage.tables.capture.settle_s,
            turns=seat if len(cameras) > 1 else None,
        )  # fmt: skip
        found.append(RigCamera(name, camera, acquirer, seat))
    first, *others = found
    return Rig(
        stage.folder, projectors, first.camera, display, first.acquirer, view=first.name, seat=first.seat,
        others=tuple(others),
    )  # fmt: skip
