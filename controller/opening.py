"""From a checked stage to opened devices, a player and a rig; nothing else builds them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

from controller.bundle.install import CURRENT
from controller.bundle.signing import write_public_key
from controller.capture.acquire import Acquirer
from controller.checking import Checked, mistake_in
from controller.config import Stage
from controller.config.models import OpenTable
from controller.play.launch import PlayerProcess, PlayerSettings, replace_player
from controller.session.darkness import Darkness
from controller.session.lamps import LampFile
from controller.session.mains import Circuit, close_circuits
from controller.session.rig import Rig, RigProjector
from controller.session.safety import LampGuard
from controller.storage import runtime_folder
from hal.deadline import Deadline, in_seconds
from hal.errors import PluginError
from hal.interfaces import ButtonPanel, Camera, Display, LightSensor, PowerSwitch, Projector
from hal.registry import Driver, OpenContext

OPEN_S = 20.0
"""Longest that opening one device may take."""


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
        raise mistake_in(table, settings, error) from error


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
