"""Random lives of a lamp: whatever happens, and whatever fails, no rule is broken.

    python -m tests.campaigns.lamp_lives 100000

Ends with 1 and the seed of the first life in which a rule was broken.
"""

from __future__ import annotations

import random
import sys
from collections.abc import Callable

from controller.core.errors import WorkError
from controller.stage.rig.lamp_guard import LampGuard
from hal.errors import DeviceError
from hal.values import Power, ProjectorStatus
from tests.controller.stage.rig.lamp_model import ROUNDING_S, RULES, Killed, Lamp, Shelf, World, check_light, soon


class Life:
    """One lamp through a random life; every step may break a rule, and says so."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        self.world, self.shelf = World(), Shelf()
        self.lamp = Lamp(self.world, tells_cooling=self.random.random() < 0.7)
        self.guard = self.restarted()

    def restarted(self) -> LampGuard:
        return LampGuard("left", self.lamp, self.shelf, clock=self.world)

    def step(self) -> None:
        choose = self.random.random
        self.lamp.trouble = self.random.choice(TROUBLES) if choose() < 0.2 else ""
        self.lamp.reports = (
            ProjectorStatus(self.random.choice([Power.UNKNOWN, Power.FAULT])) if choose() < 0.05 else None
        )
        self.shelf.full = choose() < 0.1
        act = self.random.choices(ACTS, WEIGHTS)[0]
        try:
            act(self)
        except (DeviceError, WorkError):
            return
        except Killed:
            self.guard = self.restarted()

    def on(self) -> None:
        self.guard.switch_on(deadline=soon())

    def off(self) -> None:
        self.guard.switch_off(deadline=soon())

    def look(self) -> None:
        self.guard.status(deadline=soon())

    def wait(self) -> None:
        self.world.time_s += self.random.choice([0.1, 1.0, 3.0, 5.0, 8.0, 11.0])

    def kill(self) -> None:
        self.guard = self.restarted()

    def projector_loses_power(self) -> None:
        self.lamp.go_dark()

    def everything_loses_power(self) -> None:
        self.lamp.go_dark()
        self.world.time_s += self.random.choice([0.5, 20.0])
        self.world.reboot()
        self.guard = self.restarted()

    def remote_control(self) -> None:
        """Somebody else presses the key, while the guard looks on."""
        self.lamp.trouble, self.lamp.reports, self.shelf.full = "", None, False
        self.look()
        if self.lamp.lit_at_s is None:
            self.lamp.strike(sin=False)
        else:
            self.lamp.go_dark()
        self.look()

    def cut_the_mains(self) -> None:
        if self.guard.may_open_mains(deadline=soon()):
            if self.lamp.lit_at_s is not None or self.cooled_s() < RULES.cool_down_s - ROUNDING_S:
                self.lamp.sins.append("the mains of a hot lamp were cut")
            self.lamp.go_dark()

    def cooled_s(self) -> float:
        return self.world.time_s - self.lamp.off_at_s

    def measure(self) -> None:
        check_light([self.guard])
        if self.lamp.lit_at_s is None or self.world.time_s - self.lamp.lit_at_s < RULES.stable_s - ROUNDING_S:
            self.lamp.sins.append("measured in unsteady light")


TROUBLES = ["silent", "lost", "late", "refuse", "gone", "killed before", "killed after"]
ACTS: list[Callable[[Life], None]] = [
    Life.on,
    Life.off,
    Life.look,
    Life.wait,
    Life.kill,
    Life.projector_loses_power,
    Life.everything_loses_power,
    Life.remote_control,
    Life.cut_the_mains,
    Life.measure,
]
WEIGHTS = [8, 4, 2, 8, 2, 1, 1, 1, 3, 3]
STEPS = 25


def lived(seed: int) -> Life:
    """A life of 25 steps."""
    life = Life(seed)
    for _ in range(STEPS):
        life.step()
    return life


def main(count: int) -> int:
    strikes = refusals = 0
    for seed in range(count):
        life = lived(seed)
        if life.lamp.sins:
            print(f"Life {seed} broke a rule: {'; '.join(life.lamp.sins)}.")
            return 1
        strikes += life.lamp.strikes
        refusals += life.guard.rest_left_s() > 0
    print(f"{count:,} lives, {strikes:,} strikes, {refusals:,} refused in the end. All hold.")
    return 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 100_000))
