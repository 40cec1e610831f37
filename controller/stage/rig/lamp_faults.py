"""Which projector faults stop the work, and their remedies."""

from __future__ import annotations

from typing import Final

from hal.errors import DeviceRefused
from hal.values import ProjectorStatus

START_AGAIN: Final = "Then start the same command or job again: it continues where it stopped."
_REMEDIES = {
    "lamp": "Let it cool for some minutes. If the fault returns, replace the lamp.",
    "temperature": "Clear its air inlets, clean the filter, and let it cool for 45 minutes before the next start.",
    "cover": "Close its cover.",
    "fan": "Check that its fans turn. If not, have it repaired.",
    "filter": "Clean or replace its air filter.",
}


def fatal_faults(status: ProjectorStatus) -> tuple[str, ...]:
    """Faults that stop the work; those that end in ``-warning`` (lamp hours, a filter) do not."""
    return tuple(fault for fault in status.faults if not fault.endswith("-warning"))


def faulty(name: str, status: ProjectorStatus, *, then: str = "") -> DeviceRefused:
    """The error for a projector that reports faults; ``then``: what to do after the remedy."""
    faults = ", ".join(status.faults) or "a fault without a name"
    remedy = next((text for word, text in _REMEDIES.items() if word in faults), "Check its display and its manual.")
    return DeviceRefused(
        "projector-fault", what=f"Projector {name} reports {faults}.", remedy=f"{remedy} {then}".strip()
    )
