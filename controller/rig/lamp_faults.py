"""What a projector's faults mean for the work, and what to do about them."""

from __future__ import annotations

from hal.errors import DeviceRefused
from hal.values import ProjectorStatus

_REMEDIES = {
    "lamp": "Let it cool for some minutes, then start again; if it comes back, replace the lamp.",
    "temperature": "Free its air inlets, clean the filter, and let it cool for 45 minutes before the next start.",
    "cover": "Close its cover and start again.",
    "fan": "Check that its fans turn; have it repaired if they don't.",
    "filter": "Clean or replace its air filter.",
}


def fatal_faults(status: ProjectorStatus) -> tuple[str, ...]:
    """Faults that forbid work; a driver's words that end in ``-warning`` (lamp hours, a filter) do not."""
    return tuple(fault for fault in status.faults if not fault.endswith("-warning"))


def faulty(name: str, status: ProjectorStatus) -> DeviceRefused:
    """The error for a projector that reports faults."""
    faults = ", ".join(status.faults) or "a fault without a name"
    remedy = next((text for word, text in _REMEDIES.items() if word in faults), "Read its display and its manual.")
    return DeviceRefused("projector-fault", what=f"Projector {name} reports {faults}.", remedy=remedy)
