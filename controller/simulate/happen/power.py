"""The computer without power, and its display, which comes back later than the service."""

from __future__ import annotations

from controller.simulate.happen.living import Living
from controller.simulate.judge.witness import PLAYER_S


def power_cut(life: Living, for_s: float) -> None:
    """Computer and projectors are without power for so long."""
    world = life.world
    life.end_of_program()
    if world.screen.process is not None:
        world.screen.process.kill()
    for line in world.lines.values():
        line.lamp.go_dark()
        line.let_go()
    world.scheduler.sleep(for_s + 1.0)
    world.reboot()
    life.witness.disturb(0.0)
    life.witness.lamps.forgive()
    if life.place.display_after_s:
        display_away(life, life.place.display_after_s)
    life.boot()


def display_away(life: Living, for_s: float) -> None:
    """The X server starts, restarts, crashes again and again, or its computer's graphics are gone for hours."""
    screen = life.world.screen
    screen.lose_server()
    life.witness.disturb_picture(for_s)

    def repair() -> None:
        screen.no_server = False
        # Without a server a player neither starts nor shows: crashes that are still to come, come now.
        life.witness.disturb_picture(PLAYER_S * (screen.dies_at_start + screen.dies_at_play))

    life.later(for_s, repair)
