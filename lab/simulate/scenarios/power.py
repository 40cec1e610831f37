"""The computer without power, and what comes back later than the service: its display, and its time."""

from __future__ import annotations

from typing import Final

from controller.kiosk.decide.planner import EARLIEST_S
from lab.simulate.monitors.monitor import PLAYER_S, REPAIR_S
from lab.simulate.scenarios.system import SystemUnderTest

HOLD_S: Final = 7200.0
"""For so long a kiosk's time may stand still after its clock was set back."""


def cut_power(life: SystemUnderTest, duration_s: float) -> None:
    """Computer and projectors are without power for so long."""
    world = life.world
    life.end_of_program()
    if world.screen.process is not None:
        world.screen.process.kill()
    for line in world.lines.values():
        line.lamp.go_dark()
        line.let_go()
    world.scheduler.sleep(duration_s + 1.0)
    world.reboot()
    life.monitor.disturb(0.0)
    life.monitor.lamps.forgive()
    if life.site.no_time_s:
        lose_clock(life, life.site.no_time_s)
    if life.site.display_after_s:
        remove_display(life, life.site.display_after_s)
    life.boot()


def remove_display(life: SystemUnderTest, duration_s: float) -> None:
    """The X server starts, restarts, crashes again and again, or its computer's graphics are gone for hours."""
    screen = life.world.screen
    screen.lose_server()
    life.monitor.disturb_picture(duration_s)

    def repair() -> None:
        screen.no_server = False
        # Without a server a player neither starts nor shows: crashes that are still to come, come now.
        life.monitor.disturb_picture(PLAYER_S * (screen.dies_at_start + screen.dies_at_play))

    life.later(duration_s, repair)


def lose_clock(life: SystemUnderTest, duration_s: float) -> None:
    """The computer is at 1970 for so long."""
    set_clock(life, -life.world.truth_s, duration_s)


def set_clock(life: SystemUnderTest, off_s: float, duration_s: float) -> None:
    """The computer's clock is wrong by this for so long, until it is synchronised."""
    world, wanted = life.world, life.monitor.expectation
    world.clock_off_s = off_s
    world.is_synchronised = False
    if world.wall() < EARLIEST_S and wanted.sure:
        wanted.lose_time()
    else:
        wanted.wrong(duration_s + HOLD_S + REPAIR_S, has_time=world.wall() >= EARLIEST_S)

    def repair() -> None:
        if world.is_synchronised:
            return
        world.clock_off_s, world.is_synchronised = 0.0, True
        if wanted.unknown:
            wanted.find_time()
        else:
            wanted.wrong(HOLD_S + REPAIR_S)

    life.later(duration_s, repair)
