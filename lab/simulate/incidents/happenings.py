"""What the items of a script do to a life, and how the witness has to take them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Final

from lab.simulate.disk import TOTAL_BYTES
from lab.simulate.incidents.commands import settings_edited
from lab.simulate.incidents.damage import bundle_damaged, bundles_unreadable, file_damaged, publish_again
from lab.simulate.incidents.living import Living
from lab.simulate.incidents.power import clock_lost, clock_set, display_away, power_cut
from lab.simulate.incidents.script import Item
from lab.simulate.judge.witness import PLAYER_S
from lab.simulate.lamps import RULES, Lamp
from lab.simulate.stage import OUTPUTS

GOES_OUT_S: Final = 35.0
"""Longer than a lamp takes to give light, and shorter than its light takes to be stable."""
LOOKS_AGAIN_S: Final = 300.0
"""Who switched a lamp by hand, or repaired a line, looks at the panel after so long."""
RETURNS_S: Final = 60.0
"""Somebody who finds no kiosk at the panel comes back after so long."""


def happen(life: Living, item: Item) -> None:
    """Let it happen. Raises Broken."""
    _DEEDS[item.what](life, item)


def _line(life: Living, item: Item) -> None:
    line = life.world.lines[item.who]
    line.trouble = item.how
    line.connection += item.how == "gone"
    life.witness.disturb_lamps(item.for_s + 120.0)

    def repair() -> None:
        line.trouble = ""
        _open_if_given_up(life, item.who)
        # It is asked again only now and then, and an attempt may still be waited for.
        life.later(LOOKS_AGAIN_S, partial(_open_if_given_up, life, item.who))

    life.later(item.for_s, repair)


def _open_if_given_up(life: Living, name: str) -> None:
    """Who repaired a line looks at the panel, and does what it says of a lamp that stays off after three attempts."""
    if life.service is None:
        life.later(RETURNS_S, partial(_open_if_given_up, life, name))
        return
    for supervisor in life.service.devices.projectors:
        problem = supervisor.view.problem
        if supervisor.name == name and problem is not None and problem.code == "lamp-given-up":
            supervisor.forgive()
            life.witness.lamps.forgive()


def _lamp_fails(life: Living, item: Item) -> None:
    lamp = life.world.lamps[item.who]
    if item.how == "goes out":
        lamp.lasts_s = GOES_OUT_S
    else:
        lamp.dud = True
        lamp.go_dark()
    life.witness.disturb_lamps(item.for_s)
    life.later(item.for_s, partial(_new_lamp, life, lamp))


def _new_lamp(life: Living, lamp: Lamp) -> None:
    """A technician puts in a new one, and opens the stage if it is to be open."""
    lamp.dud, lamp.fault, lamp.lasts_s = False, "", float("inf")
    life.witness.disturb_lamps(0.0)
    _press_open(life)


def _press_open(life: Living) -> None:
    """Where the kiosk does not run, they come back when it does."""
    if life.service is None:
        life.later(RETURNS_S, partial(_press_open, life))
        return
    for supervisor in life.service.devices.projectors:
        supervisor.forgive()
    life.witness.lamps.forgive()


def _lamp_reports(life: Living, item: Item) -> None:
    lamp = life.world.lamps[item.who]
    lamp.fault = item.how
    if item.how in ("temperature", "cover"):
        lamp.go_dark()
    life.witness.disturb_lamps(item.for_s)
    life.later(item.for_s, partial(_new_lamp, life, lamp))


def _by_hand(life: Living, item: Item) -> None:
    lamp = life.world.lamps[item.who]
    now_s = life.world.scheduler.now_s
    if item.how == "off":
        lamp.go_dark()
    elif not lamp.lit and not lamp.bad and now_s - lamp.off_at_s >= RULES.minimum_off_s:
        lamp.lit_at_s, lamp.by_hand = now_s, True
    life.witness.disturb_lamps(0.0)
    # Three times in a row, or one that is switched on when the kiosk is killed, is a lamp that gives no light.
    life.later(LOOKS_AGAIN_S, partial(_open_if_given_up, life, item.who))


def _player(life: Living, item: Item) -> None:
    screen, witness = life.world.screen, life.witness
    fell = item.how in ("killed", "hung") and witness.player_well
    # One that died again and again already is started after longer and longer pauses.
    again_s = PLAYER_S if life.world.scheduler.now_s < witness.player_disturbed_until_s else 0.0
    if item.how in ("killed", "crashes"):
        screen.dies_at_start = max(screen.dies_at_start, int(item.number))
        if screen.process is not None:
            screen.process.kill()
    elif item.how == "crashes at a picture":
        screen.dies_at_play = max(screen.dies_at_play, int(item.number))
        if screen.process is not None:
            screen.process.kill()
    elif item.how == "hung":
        screen.hung = True
    else:
        screen.trouble = item.how
        screen.heed()

        def repair() -> None:
            screen.trouble = ""
            screen.heed()

        life.later(item.for_s, repair)
    witness.disturb_picture(item.for_s + again_s)
    if fell:
        witness.player_fell()


def _x_server(life: Living, item: Item) -> None:
    display_away(life, item.for_s)


def _cable(life: Living, item: Item) -> None:
    """A projector's video cable is out, or its extender is without power."""
    screen, output = life.world.screen, OUTPUTS[item.who]
    screen.unplugged.add(output)
    life.witness.disturb_picture(item.for_s)

    def repair() -> None:
        screen.unplugged.discard(output)
        life.witness.disturb_picture(0.0)

    life.later(item.for_s, repair)


def _camera(life: Living, item: Item) -> None:
    camera = life.world.camera
    camera.gone = True
    camera.connection += 1

    def repair() -> None:
        camera.gone = False

    life.later(item.for_s, repair)


def _disk_full(life: Living, item: Item) -> None:
    disk = life.world.disk
    disk.full = True
    life.witness.disturb(item.for_s)

    def repair() -> None:
        disk.full = False

    life.later(item.for_s, repair)


def _disk_low(life: Living, item: Item) -> None:
    disk = life.world.disk
    disk.free_bytes = 1_000_000_000

    def repair() -> None:
        disk.free_bytes = TOTAL_BYTES // 2

    life.later(item.for_s, repair)


def _killed(life: Living, item: Item) -> None:
    lit = life.witness.lamps_that_stay()
    life.end_of_program()
    life.world.scheduler.sleep(2.0)
    life.boot()
    life.witness.lamps.stays_lit = lit


def _killed_writing(life: Living, item: Item) -> None:
    life.world.disk.kill_after = int(item.number)
    life.witness.disturb(600.0)


def _power_cut(life: Living, item: Item) -> None:
    power_cut(life, item.for_s)


def _restarted(life: Living, item: Item) -> None:
    lit = life.witness.lamps_that_stay() if item.how == "lamps stay lit" else {}
    life.restart(lit=item.how == "lamps stay lit")
    life.witness.lamps.stays_lit = lit


def _clock(life: Living, item: Item) -> None:
    """Set wrongly, or ``lost``: at 1970, as after a battery that is empty."""
    if item.how == "lost":
        clock_lost(life, item.for_s)
    else:
        clock_set(life, item.number, item.for_s)


def _no_network(life: Living, item: Item) -> None:
    world = life.world
    world.no_network = True

    def repair() -> None:
        world.no_network = False

    life.later(item.for_s, repair)


def _drift(life: Living, item: Item) -> None:
    life.world.drifted = True


def _published(life: Living, item: Item) -> None:
    """Appearances that were made on another computer."""
    publish_again(life)
    life.witness.disturb_picture(0.0)


def _command(life: Living, item: Item) -> None:
    life.command(item)


_DEEDS: Final[Mapping[str, Callable[[Living, Item], None]]] = {
    "line": _line, "lamp fails": _lamp_fails, "lamp reports": _lamp_reports, "lamp switched by hand": _by_hand,
    "player": _player, "x server": _x_server, "cable out": _cable, "camera gone": _camera,
    "disk full": _disk_full, "disk low": _disk_low,
    "file damaged": file_damaged, "bundle damaged": bundle_damaged, "bundles unreadable": bundles_unreadable,
    "killed": _killed, "killed while writing": _killed_writing, "power cut": _power_cut, "restarted": _restarted,
    "clock set": _clock, "network gone": _no_network, "drift": _drift, "published": _published,
    "command": _command, "settings edited": settings_edited,
}  # fmt: skip
