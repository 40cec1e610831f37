"""Which output of the X server is which output of the stage, and where on the screen it lies. No I/O."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from controller.core.errors import UsageError
from controller.play.display.x11 import Connector
from controller.play.frames import OutputSize

_MOST_RATES_APART_HZ: Final = 0.01
"""Outputs of one window that are farther apart drift by a frame in less than two minutes."""


def find_connectors(
    sizes: Sequence[OutputSize], where: Mapping[str, str], connectors: Sequence[Connector]
) -> dict[str, Connector]:
    """The X server's output of each of ours that is there, by our name, whatever its size.

    ``where`` gives a connector's name or a display's serial number for ours; without it, our name is taken for that.
    Raises UsageError("output-ambiguous") if two displays have the serial number.
    """
    found = {}
    for size in sizes:
        wanted = where.get(size.name, size.name)
        named = [c for c in connectors if c.name == wanted] or [c for c in connectors if wanted in c.serials]
        if len(named) > 1:
            raise UsageError(
                "output-ambiguous",
                what=f"The displays at {' and '.join(c.name for c in named)} have the same serial number {wanted}.",
                remedy=f"Give the connector's name for output {size.name} instead.",
            )
        found.update({size.name: named[0]} if named else {})
    return found


def fits(size: OutputSize, connector: Connector | None) -> bool:
    """Whether this output can show pictures of this size, pixel by pixel."""
    return connector is not None and (connector.width_px, connector.height_px) == (size.width_px, size.height_px)


def unfit(
    sizes: Sequence[OutputSize],
    where: Mapping[str, str],
    found: Mapping[str, Connector],
    connectors: Sequence[Connector],
) -> dict[str, UsageError]:
    """By our name, why an output can't show its pictures: UsageError("output-missing" or "output-size-differs")."""
    wrong = {}
    for size in sizes:
        wanted, connector = where.get(size.name, size.name), found.get(size.name)
        if connector is None:
            has = ", ".join(" ".join((c.name, *(f"(serial number {s})" for s in c.serials[:1]))) for c in connectors)
            wrong[size.name] = UsageError(
                "output-missing",
                what=f"The X server has no output {wanted}; it has {has or 'none'}.",
                remedy="Check the cable and stage.toml, and force the output on if the projector is off.",
            )
        elif not fits(size, connector):
            wrong[size.name] = UsageError(
                "output-size-differs",
                what=f"Output {size.name} is {connector.width_px}x{connector.height_px}, but stage.toml says "
                f"{size.width_px}x{size.height_px}.",
                remedy="Set the output's mode with xrandr, or correct stage.toml and calibrate again.",
            )
    return wrong


def check_rates(found: Mapping[str, Connector]) -> None:
    """Raise UsageError("output-rates-differ") unless these change together."""
    rates = sorted((connector.rate_hz, name) for name, connector in found.items())
    (slowest, one), (quickest, other) = rates[0], rates[-1]
    if quickest - slowest > _MOST_RATES_APART_HZ:
        raise UsageError(
            "output-rates-differ",
            what=f"Output {one} runs at {slowest:.3f} Hz and {other} at {quickest:.3f} Hz.",
            remedy="Give all outputs the same mode with xrandr, so that they change together.",
        )
