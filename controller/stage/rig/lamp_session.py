"""Lamps for a run: on and stable before it, off after it in every case, and then their mains."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Final

from controller.run.progress import Reporter
from controller.run.runner import Context, Step
from controller.run.state_machine import Event, Machine
from controller.run.step_id import StepId
from controller.stage.rig.power import BY_HAND_S, light, open_circuits, power_down, steady
from controller.stage.rig.rig import Rig
from hal.errors import DeviceError
from hal.notices import Level

NEARLY_S: Final = 60.0
"""Before lamps are stable: from here on their light changes little, and what needs no more may be measured."""


@contextlib.contextmanager
def lit(rig: Rig, machine: Machine, *, power_down_s: float, reporter: Reporter) -> Iterator[None]:
    """Afterwards the lamps are off or cooling in every case.

    If a projector can't be switched off, warn the technician and raise DeviceError("lamp-still-lit"),
    unless the work itself failed: then raise its error.
    """
    try:
        yield
    finally:
        _report(reporter, "Switching the projectors off.")
        # Before the state changes: a failing listener (a full disk under the journal) must not keep lamps lit.
        failures = power_down(rig.guards, within_s=power_down_s)
        for failure in failures:
            _report(reporter, f"Projector {failure.projector} could not be switched off: {failure.error}", Level.ERROR)
        for name in (guard.name for guard in rig.guards if guard.by_hand):
            _report(reporter, f"Switch projector {name} off with its own remote control now.", Level.WARNING)
        if machine.allows(Event.STOP):
            machine.handle(Event.STOP, "the lamps are switched off")
        _cut_mains(rig, reporter)
        if not failures and machine.allows(Event.COOLED):
            machine.handle(Event.COOLED, "every lamp is off or cooling")
    if failures:
        names = ", ".join(failure.projector for failure in failures)
        raise DeviceError(
            "lamp-still-lit",
            what=f"The work is done, but {names} could not be switched off.",
            remedy="Switch them off with the remote control. Leave the mains on until the fans stop.",
        )


def _cut_mains(rig: Rig, reporter: Reporter) -> None:
    if not rig.circuits:
        return
    _report(reporter, "Waiting until the lamps have cooled, to switch their mains off.")
    for stuck in open_circuits(rig.circuits, rig.guards):
        _report(reporter, f"The mains of relay {stuck.circuit} stay on: {stuck.error}", Level.WARNING)


def _report(reporter: Reporter, text: str, level: Level = Level.INFO) -> None:
    # A closed terminal or reader must not keep lamps lit.
    with contextlib.suppress(OSError, ValueError):
        reporter.say(text, level)


def power_steps(rig: Rig, *, power_up_s: float, early: Sequence[Step] = ()) -> list[Step]:
    """Strike the lamps, do the ``early`` steps when these are nearly stable, and wait for stable light.

    Lamps are never skipped: hardware is checked, not restored.
    """

    def strike(context: Context) -> Sequence[Path]:
        light(rig.guards, deadline=context.deadline.within(power_up_s), advance=context.advance,
              tell=lambda sentence: context.reporter.say(sentence, Level.WARNING))  # fmt: skip
        note(context)
        return ()

    def settle(context: Context, *, but_s: float = 0.0) -> Sequence[Path]:
        steady(rig.guards, deadline=context.deadline.within(power_up_s), advance=context.advance, but_s=but_s)
        note(context)
        return ()

    def note(context: Context) -> None:
        for guard in rig.guards:
            for notice in guard.notices():
                context.journal.record(notice.code, notice.text, Level.WARNING)
                context.reporter.say(notice.text, Level.WARNING)

    rules = [guard.capabilities.lamp_rules for guard in rig.guards]
    light_s = max(rule.warm_up_s for rule in rules) + (BY_HAND_S if any(g.by_hand for g in rig.guards) else 0.5)
    steady_s = max(max(rule.stable_s for rule in rules) - light_s, 0.1)
    last_s = min(NEARLY_S, steady_s) if early else steady_s
    nearly = [
        Step(StepId("warm"), partial(settle, but_s=NEARLY_S), title="Warming the lamps up",
             weight=max(steady_s - last_s, 0.1), always=True)
    ] if early else []  # fmt: skip
    return [
        Step(StepId("strike"), strike, title="Switching the projectors on", weight=light_s, enter=Event.START,
             leave=Event.LAMPS_LIT, always=True),
        *nearly,
        *early,
        Step(StepId("steady"), settle, title="Waiting for stable light", weight=last_s,
             leave=Event.LAMPS_STABLE, always=True),
    ]  # fmt: skip
