"""The lamp rules against a lamp that strikes whenever it is told to, and remembers every sin."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

from controller.errors import WorkError
from controller.session.lamps import LampFile, LampRecord
from controller.session.power import cool_all, light, power_down, power_up, steady
from controller.session.safety import LampGuard
from hal.deadline import Cancelled, Deadline, in_seconds
from hal.errors import DeviceError, DeviceGone, DeviceRefused, DeviceTimeout
from hal.interfaces import Projector
from hal.values import DeviceIdentity, LampRules, Power, ProjectorCapabilities, ProjectorStatus

ROUNDING_S = 1e-6
RULES = LampRules(warm_up_s=2.0, stable_s=10.0, cool_down_s=5.0, minimum_off_s=8.0)


@dataclass
class World:
    """Physical time, and the machine's clock, which begins anew with every boot."""

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
    sins: list[str] = field(default_factory=list)

    @property
    def capabilities(self) -> ProjectorCapabilities:
        return ProjectorCapabilities(lamp_hours=False, shutter=False, inputs=(), errors=True, lamp_rules=RULES)

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        return DeviceIdentity("Model", "Lamp")

    def close(self) -> None:
        """Nothing to release."""

    def set_shutter(self, closed: bool, *, deadline: Deadline) -> None:
        raise DeviceRefused("no-shutter", what="No shutter.", remedy="None.")

    def status(self, *, deadline: Deadline) -> ProjectorStatus:
        if self.trouble in ("silent", "gone"):
            self.fail()
        return self.reports or ProjectorStatus(self.power())

    def switch_on(self, *, deadline: Deadline) -> None:
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


def soon() -> Deadline:
    return in_seconds(60)


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
        self.guard.require_stable(deadline=soon())
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


def test_no_random_life_breaks_a_rule() -> None:
    strikes = refusals = 0
    for seed in range(100_000):
        life = Life(seed)
        for _ in range(25):
            life.step()
        assert not life.lamp.sins, (seed, life.lamp.sins)
        strikes += life.lamp.strikes
        refusals += life.guard.rest_left_s() > 0
    # The rules must not hold because nothing ever happens.
    assert strikes > 100_000
    assert refusals > 5_000


def test_the_random_lives_would_find_a_guard_that_forgets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LampGuard, "rest_left_s", lambda self: 0.0)
    lives = [Life(seed) for seed in range(200)]
    for life in lives:
        for _ in range(25):
            life.step()
    assert any(life.lamp.sins for life in lives)


def a_guard(world: World, **more: object) -> tuple[LampGuard, Lamp]:
    lamp = Lamp(world)
    ledger = more.get("ledger", Shelf())
    assert isinstance(ledger, Shelf | LampFile)
    return LampGuard("left", lamp, ledger, clock=world), lamp


def refusal(act: Callable[[], object]) -> str:
    with pytest.raises(DeviceRefused) as error:
        act()
    return error.value.code


def test_the_guard_is_a_projector() -> None:
    assert isinstance(a_guard(World())[0], Projector)


def test_a_cooling_lamp_and_a_resting_lamp_are_not_struck() -> None:
    world = World()
    guard, lamp = a_guard(world)
    guard.switch_on(deadline=soon())
    world.time_s += 3
    guard.switch_off(deadline=soon())
    assert refusal(lambda: guard.switch_on(deadline=soon())) == "lamp-cooling"
    world.time_s += RULES.cool_down_s
    assert refusal(lambda: guard.switch_on(deadline=soon())) == "lamp-resting"
    world.time_s += RULES.minimum_off_s - RULES.cool_down_s
    guard.switch_on(deadline=soon())
    assert lamp.strikes == 2


@pytest.mark.parametrize(("power", "code"), [(Power.UNKNOWN, "lamp-state-unknown"), (Power.FAULT, "projector-fault")])
def test_a_lamp_of_which_nothing_good_is_known_is_not_struck(power: Power, code: str) -> None:
    guard, lamp = a_guard(World())
    lamp.reports = ProjectorStatus(power, ("lamp-failed",))
    assert refusal(lambda: guard.switch_on(deadline=soon())) == code
    assert lamp.strikes == 0


def test_without_room_to_count_the_strike_there_is_none_but_off_goes_out() -> None:
    world, shelf = World(), Shelf()
    guard, lamp = a_guard(world, ledger=shelf)
    shelf.full = True
    with pytest.raises(WorkError):
        guard.switch_on(deadline=soon())
    assert lamp.strikes == 0
    shelf.full = False
    guard.switch_on(deadline=soon())
    shelf.full = True
    guard.switch_off(deadline=soon())
    assert lamp.lit_at_s is None
    assert guard.rest_left_s() == RULES.minimum_off_s


def test_a_look_that_fails_does_not_keep_off_from_going_out() -> None:
    guard, lamp = a_guard(World())
    guard.switch_on(deadline=soon())
    lamp.trouble = "silent"
    guard.switch_off(deadline=soon())
    assert lamp.lit_at_s is None


def test_strikes_and_hours_survive_restarts(tmp_path: Path) -> None:
    world = World()
    guard, lamp = a_guard(world, ledger=LampFile(tmp_path / LampFile.NAME))
    for _ in range(3):
        guard.switch_on(deadline=soon())
        world.time_s += 1800
        guard.switch_off(deadline=soon())
        world.time_s += 100
    guard = LampGuard("left", lamp, LampFile(tmp_path / LampFile.NAME), clock=world)
    assert guard.use().strikes == 3
    assert guard.use().hours == pytest.approx(1.5)


def test_hours_are_saved_while_the_lamp_burns() -> None:
    world, shelf = World(), Shelf()
    guard, _ = a_guard(world, ledger=shelf)
    guard.switch_on(deadline=soon())
    for _ in range(100):
        world.time_s += 36
        guard.status(deadline=soon())
    assert shelf.records["left"].lit_s == pytest.approx(3600, abs=120)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"[]",
        b'{"left": 3}',
        b'{"left": {"lit": "no"}}',
        b"\xff",
        b"[" * 100_000,
        b'{"left": {"lit": false, "since_s": NaN, "boot": "", "strikes": 0, "lit_s": 0}}',
    ],
    ids=range(8),
)
def test_a_damaged_ledger_makes_the_lamps_hot(tmp_path: Path, content: bytes) -> None:
    (tmp_path / LampFile.NAME).write_bytes(content)
    ledger = LampFile(tmp_path / LampFile.NAME)
    guard, lamp = a_guard(World(), ledger=ledger)
    assert ledger.damaged
    assert refusal(lambda: guard.switch_on(deadline=soon())) == "lamp-resting"
    assert lamp.strikes == 0


def test_the_stage_can_make_the_rules_stricter_but_not_laxer() -> None:
    lax = LampRules(0, 0, 0, 0)
    guard = LampGuard("left", Lamp(World()), Shelf(), at_least=replace(lax, stable_s=900.0), clock=World())
    assert guard.capabilities.lamp_rules == replace(RULES, stable_s=900.0)


@dataclass
class Room:
    """Three projectors, as a stage has."""

    world: World = field(default_factory=World)
    notes: list[tuple[float, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.lamps = [Lamp(self.world) for _ in range(3)]
        names = ("left", "middle", "right")
        shelf = Shelf()
        self.guards = [LampGuard(*pair, shelf, clock=self.world) for pair in zip(names, self.lamps, strict=True)]

    def advance(self, fraction: float, note: str) -> None:
        self.notes.append((fraction, note))


def test_power_up_strikes_all_and_returns_in_steady_light() -> None:
    room = Room()
    power_up(room.guards, deadline=soon(), advance=room.advance, clock=room.world)
    for guard in room.guards:
        guard.require_stable(deadline=soon())
    assert RULES.stable_s <= room.world.time_s - 1000 <= RULES.stable_s + 2
    fractions = [fraction for fraction, _ in room.notes]
    assert fractions == sorted(fractions)
    assert fractions[-1] <= 1


def test_power_up_waits_for_lamps_that_must_rest() -> None:
    room = Room()
    light(room.guards, deadline=soon(), advance=room.advance, clock=room.world)
    assert power_down(room.guards, clock=room.world) == ()
    power_up(room.guards, deadline=soon(), advance=room.advance, clock=room.world)
    assert [lamp.sins for lamp in room.lamps] == [[], [], []]
    assert any("rests" in note for _, note in room.notes)


def test_a_silent_projector_is_named_before_any_lamp_is_struck() -> None:
    room = Room()
    room.lamps[2].trouble = "silent"
    with pytest.raises(DeviceTimeout):
        light(room.guards, deadline=soon(), advance=room.advance, clock=room.world)
    assert [lamp.strikes for lamp in room.lamps] == [0, 0, 0]


def test_a_projector_may_be_silent_while_it_boots() -> None:
    room = Room()

    def hears_again(fraction: float, note: str) -> None:
        room.advance(fraction, note)
        room.lamps[1].trouble = "silent" if len(room.notes) < 4 else ""

    light(room.guards, deadline=soon(), advance=hears_again, clock=room.world)
    assert any("middle" in note for _, note in room.notes)


def test_a_fault_during_warm_up_ends_it_with_the_projectors_name() -> None:
    room = Room()
    light(room.guards, deadline=soon(), advance=room.advance, clock=room.world)
    room.lamps[0].reports = ProjectorStatus(Power.ON, ("over-temperature",))
    with pytest.raises(DeviceRefused, match="left reports over-temperature") as error:
        steady(room.guards, deadline=soon(), advance=room.advance, clock=room.world)
    assert "45 minutes" in error.value.remedy


def test_a_lamp_that_goes_out_during_warm_up_is_named() -> None:
    room = Room()
    light(room.guards, deadline=soon(), advance=room.advance, clock=room.world)
    room.lamps[1].go_dark()
    assert (
        refusal(lambda: steady(room.guards, deadline=soon(), advance=room.advance, clock=room.world)) == "lamp-went-off"
    )


def test_a_lamp_that_never_lights_ends_at_the_deadline() -> None:
    room = Room()
    room.lamps[1].reports = ProjectorStatus(Power.WARMING)
    with pytest.raises(DeviceTimeout, match="middle") as error:
        light(room.guards, deadline=in_seconds(0.1), advance=room.advance, clock=room.world)
    assert error.value.code == "lamps-not-lit"


def test_power_down_reaches_every_projector_though_one_fails() -> None:
    room = Room()
    light(room.guards, deadline=soon(), advance=room.advance, clock=room.world)
    room.lamps[0].trouble = "gone"
    failures = power_down(room.guards, within_s=0.1, clock=room.world)
    assert [failure.projector for failure in failures] == ["left"]
    assert isinstance(failures[0].error, DeviceGone)
    assert [lamp.lit_at_s for lamp in room.lamps[1:]] == [None, None]


def test_power_down_asks_again_until_it_is_heard() -> None:
    room = Room()
    light(room.guards, deadline=soon(), advance=room.advance, clock=room.world)
    room.lamps[0].trouble = "lost"
    slept = room.world.sleep

    def sleep(seconds: float, deadline: Deadline) -> None:
        slept(seconds, deadline)
        room.lamps[0].trouble = ""

    room.world.sleep = sleep  # type: ignore[method-assign]
    assert power_down(room.guards, clock=room.world) == ()
    assert room.lamps[0].lit_at_s is None


def test_a_projector_that_was_never_lit_and_does_not_answer_is_not_waited_for() -> None:
    room = Room()
    room.lamps[0].trouble = "gone"
    began_s = room.world.time_s
    assert len(power_down(room.guards, within_s=60, clock=room.world)) == 1
    assert room.world.time_s - began_s < 5


def test_cool_all_returns_only_when_every_mains_may_be_cut() -> None:
    room = Room()
    light(room.guards, deadline=soon(), advance=room.advance, clock=room.world)
    assert cool_all(room.guards, deadline=soon(), advance=room.advance, clock=room.world) == ()
    assert all(guard.may_open_mains(deadline=soon()) for guard in room.guards)
