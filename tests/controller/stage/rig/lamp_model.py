"""A lamp that strikes when asked to, and remembers every violation; a clock; a ledger on a disk that may be full."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import cast

import pytest

from controller.core.errors import WorkError
from controller.optics.capture.acquire import Acquirer
from controller.stage.rig.lamp_guard import LampGuard
from controller.stage.rig.lamp_ledger import LampRecord
from controller.stage.rig.rig import Rig, RigProjector
from hal.deadline import Cancelled, Deadline, in_seconds
from hal.errors import DeviceGone, DeviceRefused, DeviceTimeout
from hal.interfaces import Camera, Display
from hal.values import DeviceIdentity, LampRules, Power, ProjectorCapabilities, ProjectorStatus

ROUNDING_S = 1e-6
RULES = LampRules(warm_up_s=2.0, stable_s=10.0, cool_down_s=5.0, minimum_off_s=8.0)


@dataclass
class World:
    """Physical time, and the machine's clock, which starts again with every boot."""

    time_s: float = 1000.0
    booted_s: float = 0.0
    boots: int = 0

    def now_s(self) -> float:
        return self.time_s - self.booted_s

    def boot(self) -> str:
        return f"boot-{self.boots}"

    def sleep(self, seconds: float, deadline: Deadline) -> None:
        if deadline.cancel is not None and deadline.cancel.is_set():
            raise Cancelled
        self.time_s += seconds

    def reboot(self) -> None:
        self.boots += 1
        self.booted_s = self.time_s


class Killed(BaseException):
    """The process is gone at this point."""


@dataclass
class Lamp:
    """A projector without any protection of its own."""

    world: World
    tells_cooling: bool = True
    lit_at_s: float | None = None
    off_at_s: float = -1e9
    reports: ProjectorStatus | None = None
    trouble: str = ""
    strikes: int = 0
    switchable: bool = True
    switch_s: float = 10.0
    patience_s: list[float] = field(default_factory=list)
    sins: list[str] = field(default_factory=list)
    odd: BaseException | None = None
    """What a look at it raises, as a driver of another author may."""
    forgets: bool = False
    """It no longer tells what it can do."""

    @property
    def capabilities(self) -> ProjectorCapabilities:
        if self.forgets:
            raise TypeError("no table")
        return ProjectorCapabilities(
            lamp_hours=False, shutter=False, inputs=(), errors=True, lamp_rules=RULES, power=self.switchable,
            switch_s=self.switch_s,
        )  # fmt: skip

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        return DeviceIdentity("Model", "Lamp")

    def close(self) -> None:
        """Nothing to release."""

    def set_shutter(self, closed: bool, *, deadline: Deadline) -> None:
        raise DeviceRefused("no-shutter", what="No shutter.", remedy="None.")

    def status(self, *, deadline: Deadline) -> ProjectorStatus:
        if self.odd is not None:
            raise self.odd
        if self.trouble in ("silent", "gone"):
            self.fail()
        if not self.switchable:
            return self.reports or ProjectorStatus(Power.UNKNOWN)
        return self.reports or ProjectorStatus(self.power())

    def switch_on(self, *, deadline: Deadline) -> None:
        self.patience_s.append(deadline.left_s())
        if not self.switchable:
            raise DeviceRefused("projector-power-unknown", what="No codes.", remedy="Switch it by hand.")
        if self.trouble in ("lost", "gone", "refuse", "killed before"):
            self.fail()
        self.strike(sin=True)
        if self.trouble in ("late", "killed after"):
            self.fail()

    def switch_off(self, *, deadline: Deadline) -> None:
        if self.trouble in ("lost", "gone", "refuse"):
            self.fail()
        self.go_dark()
        if self.trouble == "late":
            self.fail()

    def fail(self) -> None:
        if self.trouble.startswith("killed"):
            raise Killed
        kinds = {"refuse": DeviceRefused, "gone": DeviceGone}
        raise kinds.get(self.trouble, DeviceTimeout)("model-trouble", what=f"It is {self.trouble}.", remedy="Mend it.")

    def power(self) -> Power:
        if self.lit_at_s is not None:
            return Power.ON if self.world.time_s - self.lit_at_s >= RULES.warm_up_s else Power.WARMING
        cools = self.world.time_s - self.off_at_s < RULES.cool_down_s
        return Power.COOLING if cools and self.tells_cooling else Power.OFF

    def strike(self, *, sin: bool) -> None:
        if self.lit_at_s is None:
            if sin and self.world.time_s - self.off_at_s < RULES.minimum_off_s - ROUNDING_S:
                self.sins.append(f"struck {self.world.time_s - self.off_at_s:.2f} s after it went off")
            self.lit_at_s = self.world.time_s
            self.strikes += sin

    def go_dark(self) -> None:
        if self.lit_at_s is not None:
            self.lit_at_s, self.off_at_s = None, self.world.time_s


@dataclass
class Shelf:
    """A ledger in memory, on a disk that may be full."""

    records: dict[str, LampRecord] = field(default_factory=dict)
    full: bool = False

    def read(self, name: str) -> LampRecord | None:
        return self.records.get(name)

    def write(self, name: str, record: LampRecord) -> None:
        if self.full:
            raise WorkError("no-space", what="Full.", remedy="Free some space.")
        self.records[name] = record

    def keep(self, name: str, record: LampRecord) -> bool:
        self.records[name] = record
        return not self.full

    def forgive(self, name: str, most: int) -> None:
        if name in self.records:
            self.keep(name, replace(self.records[name], failed=min(self.records[name].failed, most)))


def soon() -> Deadline:
    return in_seconds(60)


def check_light(guards: Sequence[LampGuard]) -> None:
    """The check of a stage whose other devices are not asked."""
    projectors = tuple(RigProjector(guard.name, guard.name, (1, 1), guard) for guard in guards)
    rig = Rig(Path(), projectors, cast("Camera", None), cast("Display", None), cast("Acquirer", None))
    rig.check_light(deadline=soon())


def refusal(act: Callable[[], object]) -> str:
    with pytest.raises(DeviceRefused) as error:
        act()
    return error.value.code
