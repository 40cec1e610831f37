"""Injects the incidents of a scenario into a life, and tells its monitor what they excuse."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Final

from lab.simulate.disk import TOTAL_BYTES
from lab.simulate.lamps import RULES, Lamp
from lab.simulate.monitors.monitor import PLAYER_S
from lab.simulate.scenarios.commands import edit_settings
from lab.simulate.scenarios.damage import damage_bundle, damage_file, make_bundles_unreadable, publish_again
from lab.simulate.scenarios.power import cut_power, lose_clock, remove_display, set_clock
from lab.simulate.scenarios.scenario import Incident
from lab.simulate.scenarios.system import SystemUnderTest
from lab.simulate.stage import OUTPUTS

GOES_OUT_S: Final = 35.0
"""Longer than a lamp takes to give light, and shorter than its light takes to be stable."""
LOOKS_AGAIN_S: Final = 300.0
"""Who switched a lamp by hand, or repaired a line, looks at the panel after so long."""
RETURNS_S: Final = 60.0
"""Somebody who finds no kiosk at the panel comes back after so long."""


def inject(life: SystemUnderTest, incident: Incident) -> None:
    """Injects one incident. Raises Violation."""
    _INJECTORS[incident.kind](life, incident)


def _line(life: SystemUnderTest, incident: Incident) -> None:
    line = life.world.lines[incident.target]
    line.trouble = incident.variant
    line.connection += incident.variant == "gone"
    life.monitor.disturb_lamps(incident.duration_s + 120.0)

    def repair() -> None:
        line.trouble = ""
        _open_if_given_up(life, incident.target)
        # It is asked again only now and then, and an attempt may still be waited for.
        life.later(LOOKS_AGAIN_S, partial(_open_if_given_up, life, incident.target))

    life.later(incident.duration_s, repair)


def _open_if_given_up(life: SystemUnderTest, name: str) -> None:
    """Who repaired a line looks at the panel, and does what it says of a lamp that stays off after three attempts."""
    if life.service is None:
        life.later(RETURNS_S, partial(_open_if_given_up, life, name))
        return
    for supervisor in life.service.devices.projectors:
        problem = supervisor.view.problem
        if supervisor.name == name and problem is not None and problem.code == "lamp-given-up":
            supervisor.forgive()
            life.monitor.lamps.forgive()


def _lamp_fails(life: SystemUnderTest, incident: Incident) -> None:
    lamp = life.world.lamps[incident.target]
    if incident.variant == "goes out":
        lamp.lasts_s = GOES_OUT_S
    else:
        lamp.dud = True
        lamp.go_dark()
    life.monitor.disturb_lamps(incident.duration_s)
    life.later(incident.duration_s, partial(_new_lamp, life, lamp))


def _new_lamp(life: SystemUnderTest, lamp: Lamp) -> None:
    """A technician puts in a new one, and opens the stage if it is to be open."""
    lamp.dud, lamp.fault, lamp.lasts_s = False, "", float("inf")
    life.monitor.disturb_lamps(0.0)
    _press_open(life)


def _press_open(life: SystemUnderTest) -> None:
    """Where the kiosk does not run, they come back when it does."""
    if life.service is None:
        life.later(RETURNS_S, partial(_press_open, life))
        return
    for supervisor in life.service.devices.projectors:
        supervisor.forgive()
    life.monitor.lamps.forgive()


def _lamp_reports(life: SystemUnderTest, incident: Incident) -> None:
    lamp = life.world.lamps[incident.target]
    lamp.fault = incident.variant
    if incident.variant in ("temperature", "cover"):
        lamp.go_dark()
    life.monitor.disturb_lamps(incident.duration_s)
    life.later(incident.duration_s, partial(_new_lamp, life, lamp))


def _by_hand(life: SystemUnderTest, incident: Incident) -> None:
    lamp = life.world.lamps[incident.target]
    now_s = life.world.scheduler.now_s
    if incident.variant == "off":
        lamp.go_dark()
    elif not lamp.lit and not lamp.bad and now_s - lamp.off_at_s >= RULES.minimum_off_s:
        lamp.lit_at_s, lamp.by_hand = now_s, True
    life.monitor.disturb_lamps(0.0)
    # Three times in a row, or one that is switched on when the kiosk is killed, is a lamp that gives no light.
    life.later(LOOKS_AGAIN_S, partial(_open_if_given_up, life, incident.target))


def _player(life: SystemUnderTest, incident: Incident) -> None:
    screen, monitor = life.world.screen, life.monitor
    fell = incident.variant in ("killed", "hung") and monitor.player_well
    # One that died again and again already is started after longer and longer pauses.
    again_s = PLAYER_S if life.world.scheduler.now_s < monitor.player_disturbed_until_s else 0.0
    if incident.variant in ("killed", "crashes"):
        screen.dies_at_start = max(screen.dies_at_start, int(incident.magnitude))
        if screen.process is not None:
            screen.process.kill()
    elif incident.variant == "crashes at a picture":
        screen.dies_at_play = max(screen.dies_at_play, int(incident.magnitude))
        if screen.process is not None:
            screen.process.kill()
    elif incident.variant == "hung":
        screen.hung = True
    else:
        screen.trouble = incident.variant
        screen.apply_trouble()

        def repair() -> None:
            screen.trouble = ""
            screen.apply_trouble()

        life.later(incident.duration_s, repair)
    monitor.disturb_picture(incident.duration_s + again_s)
    if fell:
        monitor.player_fell()


def _x_server(life: SystemUnderTest, incident: Incident) -> None:
    remove_display(life, incident.duration_s)


def _cable(life: SystemUnderTest, incident: Incident) -> None:
    """A projector's video cable is out, or its extender is without power."""
    screen, output = life.world.screen, OUTPUTS[incident.target]
    screen.unplugged.add(output)
    life.monitor.disturb_picture(incident.duration_s)

    def repair() -> None:
        screen.unplugged.discard(output)
        life.monitor.disturb_picture(0.0)

    life.later(incident.duration_s, repair)


def _camera(life: SystemUnderTest, incident: Incident) -> None:
    camera = life.world.camera
    camera.gone = True
    camera.connection += 1

    def repair() -> None:
        camera.gone = False

    life.later(incident.duration_s, repair)


def _disk_full(life: SystemUnderTest, incident: Incident) -> None:
    disk = life.world.disk
    disk.full = True
    life.monitor.disturb(incident.duration_s)

    def repair() -> None:
        disk.full = False

    life.later(incident.duration_s, repair)


def _disk_low(life: SystemUnderTest, incident: Incident) -> None:
    disk = life.world.disk
    disk.free_bytes = 1_000_000_000

    def repair() -> None:
        disk.free_bytes = TOTAL_BYTES // 2

    life.later(incident.duration_s, repair)


def _killed(life: SystemUnderTest, incident: Incident) -> None:
    lit = life.monitor.lamps_that_stay()
    life.end_of_program()
    life.world.scheduler.sleep(2.0)
    life.boot()
    life.monitor.lamps.stays_lit = lit


def _killed_writing(life: SystemUnderTest, incident: Incident) -> None:
    life.world.disk.kill_after = int(incident.magnitude)
    life.monitor.disturb(600.0)


def _power_cut(life: SystemUnderTest, incident: Incident) -> None:
    cut_power(life, incident.duration_s)


def _restarted(life: SystemUnderTest, incident: Incident) -> None:
    lit = life.monitor.lamps_that_stay() if incident.variant == "lamps stay lit" else {}
    life.restart(lit=incident.variant == "lamps stay lit")
    life.monitor.lamps.stays_lit = lit


def _clock(life: SystemUnderTest, incident: Incident) -> None:
    """Set wrongly, or ``lost``: at 1970, as after a battery that is empty."""
    if incident.variant == "lost":
        lose_clock(life, incident.duration_s)
    else:
        set_clock(life, incident.magnitude, incident.duration_s)


def _no_network(life: SystemUnderTest, incident: Incident) -> None:
    world = life.world
    world.no_network = True

    def repair() -> None:
        world.no_network = False

    life.later(incident.duration_s, repair)


def _drift(life: SystemUnderTest, incident: Incident) -> None:
    life.world.drifted = True


def _published(life: SystemUnderTest, incident: Incident) -> None:
    """Appearances that were made on another computer."""
    publish_again(life)
    life.monitor.disturb_picture(0.0)


def _command(life: SystemUnderTest, incident: Incident) -> None:
    life.command(incident)


_INJECTORS: Final[Mapping[str, Callable[[SystemUnderTest, Incident], None]]] = {
    "line": _line, "lamp fails": _lamp_fails, "lamp reports": _lamp_reports, "lamp switched by hand": _by_hand,
    "player": _player, "x server": _x_server, "cable out": _cable, "camera gone": _camera,
    "disk full": _disk_full, "disk low": _disk_low,
    "file damaged": damage_file, "bundle damaged": damage_bundle, "bundles unreadable": make_bundles_unreadable,
    "killed": _killed, "killed while writing": _killed_writing, "power cut": _power_cut, "restarted": _restarted,
    "clock set": _clock, "network gone": _no_network, "drift": _drift, "published": _published,
    "command": _command, "settings edited": edit_settings,
}  # fmt: skip
