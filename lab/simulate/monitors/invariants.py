"""What must hold in every life of a kiosk: its invariants, and how long a condition has held."""

from __future__ import annotations

from typing import Final

from lab.simulate.world import SimulatedWorld

INVARIANTS: Final = {
    "lamp rules": "No lamp is switched on while it is hot, or before its minimum off time.",
    "one owner": "A device is used by one program, and by one of its threads, at a time.",
    "no crash": "Nothing ends with an unexpected error.",
    "decides always": "The reconciler waits for nothing.",
    "remedy": "An error says what happened and what to do.",
    "state": "The log's last word on the state is the state.",
    "black while closed": "No picture is shown while the stage is closed.",
    "dark while closed": "No lamp burns while the stage is closed and no work needs it.",
    "rests while closed": "A closed stage without work is off, cools, or says what is wrong.",
    "lit through a restart": "A service that is killed or restarted leaves the lamps of an open stage lit.",
    "serves": "A started service runs, also on a full disk or with a damaged stage.toml if the last good one is there.",
    "settings kept": "A kiosk that runs has a copy of its stage.toml, soon after the disk has room for one.",
    "off is off": "When a stage says that every lamp is off, none burns that it struck.",
    "may burn": "A lamp that burns behind a broken line counts as one that may burn, whatever was damaged.",
    "plays while open": "With every fault repaired, an open stage plays, with all its lamps.",
    "says why it is dark": "While an open stage shows nothing, it says why.",
    "outputs named": "Outputs without a picture, and no others, are named while the player answers.",
    "picture back": "A player that dies or hangs is restarted, and the picture is back soon.",
    "nothing lost": "Events, settings and counts survive each end of the service.",
    "log written": "What is logged is on the disk, soon after the disk has room for it.",
    "once a night": "The nightly check is begun at most once a night.",
    "at night": "The nightly check begins only while the stage is closed.",
    "few words": "What goes wrong again every second does not fill the log.",
    "strikes counted": "A lamp is struck at most as often as it is counted.",
    "few strikes": "A lamp that gives no light is not struck again and again.",
    "alerts": "Each alert is sent once, in its order, unless the service was killed while it was sent.",
    "as usual again": "What people changed of the picture ends when the stage closes.",
    "bundle kept": "A bundle that can be read is given up only after three starts that were to show it, and did not.",
    "bundle back": "The player goes back only to a bundle that can be read.",
    "bundle shown": "A wanted picture comes, if a bundle can be read and the display is there, whatever else is wrong.",
    "bundle named": "A bundle that can't be read is named by each service that begins with it, open or closed.",
    "few ends": "A player that answers now and then is not ended again and again.",
    "work ends": "Work ends by itself, when it is cancelled and when it fails, and lets go of the stage.",
    "devices back": "A camera that is there again is opened again.",
}


class Violation(Exception):
    """A kiosk broke an ``invariant``, named as in ``INVARIANTS``."""

    def __init__(self, invariant: str, how: str) -> None:
        super().__init__(f"{invariant}: {how}")
        assert invariant in INVARIANTS
        self.invariant = invariant


class Durations:
    """For how long conditions have held in each check until now, in the world's time."""

    def __init__(self, world: SimulatedWorld) -> None:
        self._world = world
        self._since_s: dict[str, float] = {}

    def held_s(self, condition: str, holds: bool) -> float:
        """Seconds since the first of the checks in a row that found this. The check before it may be minutes older."""
        now_s = self._world.scheduler.now_s
        if not holds:
            self.restart(condition)
            return 0.0
        return now_s - self._since_s.setdefault(condition, now_s)

    def restart(self, condition: str) -> None:
        """Count this one from its next check on."""
        self._since_s.pop(condition, None)
