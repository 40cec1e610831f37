"""Every fault of every model device at every step of the kiosk's sequence, and what must hold afterwards."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from controller.kiosk.decide.interfaces import Request
from controller.run.state_machine import State
from hal.values import Power, ProjectorStatus
from tests.controller.kiosk.model import Kiosk

PROFILES = Path(__file__).parents[3] / "firmware_configs" / "projectors"
DEADLINE_S = 700.0
"""Two strikes' rests, the retry out of FAULT, and the lamps' own times."""
SETTLED = (State.PLAYING, State.DEGRADED, State.FAULT, State.OFF)


@dataclass(frozen=True, slots=True)
class Fault:
    name: str
    strike: Callable[[Kiosk], None]
    repair: Callable[[Kiosk], None]


def _trouble(name: str, kind: str) -> Fault:
    def strike(kiosk: Kiosk) -> None:
        kiosk.lamps[name].trouble = kind

    def repair(kiosk: Kiosk) -> None:
        kiosk.lamps[name].trouble = ""

    return Fault(f"{name} {kind}", strike, repair)


def _reports(name: str, word: str) -> Fault:
    def strike(kiosk: Kiosk) -> None:
        if "temperature" in word:
            kiosk.lamps[name].go_dark()
        power = Power.ON if word.endswith("-warning") else Power.FAULT
        kiosk.lamps[name].reports = ProjectorStatus(power, (word,))

    def repair(kiosk: Kiosk) -> None:
        kiosk.lamps[name].reports = None

    return Fault(f"{name} reports {word}", strike, repair)


def words() -> list[str]:
    """What projectors may say of themselves: every word of every profile that is shipped, and PJLink's own."""
    told = {"lamp-failed", "temperature", "cover", "fan", "filter"}
    for profile in PROFILES.glob("*.toml"):
        told.update(tomllib.loads(profile.read_text()).get("notices", {}).get("trouble", {}).values())
    return sorted(told)


def _burst(name: str) -> Fault:
    def repair(kiosk: Kiosk) -> None:
        kiosk.lamps[name].dud = False
        for supervisor in kiosk.supervisors:
            supervisor.forgive()

    return Fault(f"{name} bursts", lambda kiosk: kiosk.lamps[name].burst(), repair)


def _unplugged(name: str) -> Fault:
    def strike(kiosk: Kiosk) -> None:
        kiosk.gone.add(name)
        kiosk.lamps[name].trouble = "gone"

    def repair(kiosk: Kiosk) -> None:
        kiosk.gone.discard(name)
        kiosk.lamps[name].trouble = ""

    return Fault(f"{name} unplugged", strike, repair)


def _slow(name: str) -> Fault:
    def set_to(seconds: float) -> Callable[[Kiosk], None]:
        return lambda kiosk: setattr(kiosk.lamps[name], "slow_s", seconds)

    return Fault(f"{name} slow", set_to(4.0), set_to(0.0))


def _everyone(kind: str) -> Fault:
    def set_to(trouble: str) -> Callable[[Kiosk], None]:
        def turn(kiosk: Kiosk) -> None:
            for lamp in kiosk.lamps.values():
                lamp.trouble = trouble

        return turn

    return Fault(f"everyone {kind}", set_to(kind), set_to(""))


def _remote_control(kiosk: Kiosk) -> None:
    kiosk.lamps["left"].go_dark()


def _killed(kiosk: Kiosk) -> None:
    kiosk.log.close()
    kiosk.boot()


def _nothing(kiosk: Kiosk) -> None:
    """Repairs itself."""


def _set(what: str, on: object, off: object) -> Fault:
    owner, _, key = what.partition(".")
    return Fault(
        f"{what} {on}",
        lambda kiosk: setattr(getattr(kiosk, owner), key, on),
        lambda kiosk: setattr(getattr(kiosk, owner), key, off),
    )


FAULTS = (
    *(_trouble("left", kind) for kind in ("silent", "lost", "late", "refuse", "gone")),
    *(_reports("left", word) for word in words()),
    _burst("left"), _unplugged("left"), _slow("left"), _everyone("silent"), _everyone("refuse"),
    Fault("left switched off by its remote control", _remote_control, _nothing),
    Fault("power cut", lambda kiosk: kiosk.power_cut(120.0), _nothing),
    Fault("service killed", _killed, _nothing),
    Fault("player hung", lambda kiosk: setattr(kiosk.player, "hung_at_s", kiosk.world.time_s), _nothing),
    _set("player.broken", True, False), _set("jobs.camera", False, True), _set("shelf.full", True, False),
    _set("bundles.installed", None, Path("bundles/one.vel")),
    Fault("clock a day back", lambda kiosk: setattr(kiosk, "wall_offset_s", kiosk.wall_offset_s - 86_400), _nothing),
    Fault("clock lost", lambda kiosk: setattr(kiosk, "wall_offset_s", 0.0), _nothing),
)  # fmt: skip

STEPS = ("off", "powering", "warming", "playing", "calibrating", "degraded", "cooling")


def reach(kiosk: Kiosk, step: str) -> None:
    """Bring the kiosk to a step of its sequence."""
    if step == "off":
        kiosk.reconciler.step()
        return
    if step in ("powering", "warming"):
        kiosk.run_until(State(step))
        return
    kiosk.run_until(State.PLAYING)
    if step == "calibrating":
        kiosk.reconciler.submit(Request("quick", light=True))
        kiosk.run_until(State.CALIBRATING)
    elif step == "degraded":
        kiosk.lamps["right"].burst()
        kiosk.run_until(State.DEGRADED)
    elif step == "cooling":
        kiosk.reconciler.shut()
        kiosk.run_until(State.COOLING)


def cases() -> Iterator[tuple[str, Fault]]:
    for step in STEPS:
        for fault in FAULTS:
            yield step, fault


def judge(kiosk: Kiosk, step: str, fault: Fault) -> None:
    """Strike, wait, look; repair, wait, look again."""
    reach(kiosk, step)
    fault.strike(kiosk)
    kiosk.run(DEADLINE_S)
    kiosk.run_until(*SETTLED, within_s=DEADLINE_S)
    _explained(kiosk, f"{step}, {fault.name}")
    fault.repair(kiosk)
    kiosk.lamps["right"].dud = False
    for supervisor in kiosk.supervisors:
        supervisor.forgive()
    wanted = State.OFF if step == "cooling" else State.PLAYING
    kiosk.run_until(wanted, within_s=1800.0)
    assert not kiosk.sins, (step, fault.name, kiosk.sins)
    kiosk.log.close()


def _explained(kiosk: Kiosk, case: str) -> None:
    """DEGRADED and FAULT say why; every problem in the log says what to do; no lamp was harmed."""
    assert not kiosk.sins, (case, kiosk.sins)
    if kiosk.state in (State.FAULT, State.DEGRADED):
        assert kiosk.reconciler.machine.reason.strip(), case
        problems = [row for row in kiosk.log.after(0) if row.level == "error"]
        assert problems or kiosk.state is State.DEGRADED, case
        assert all(row.text.count(".") >= 2 for row in problems if row.code != "state"), (case, problems)
