"""Which graphics processors this computer has. Loads no numeric library unless the extra `gpu` is installed."""

from __future__ import annotations

import importlib.util
from typing import Final

MODULE: Final = "wgpu"
"""The module of the extra `gpu`."""


def graphics_processors() -> list[str] | None:
    """A name for each that could solve; None where the extra `gpu` is not installed."""
    if importlib.util.find_spec(MODULE) is None:
        return None
    from controller.optics.solve.gpu.device import DeviceRefused, adapters

    try:
        found = adapters()
    except DeviceRefused:
        return []
    return [f"{one.name} ({one.backend}{', in software' if one.software else ''})" for one in found]


def graphics_sentence() -> str:
    """For people: what of this computer can solve."""
    found = graphics_processors()
    if found is None:
        return "Solves run on the processor: the extra gpu is not installed."
    if not found:
        return "Solves run on the processor: no graphics processor was found."
    return f"Graphics processors for solves: {', '.join(found)}."
