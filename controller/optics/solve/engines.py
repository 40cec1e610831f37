"""What solves: the device that stage.toml or a person asked for, or the fastest that this computer has.

The extra `gpu` may be missing; then nothing of ``solve.gpu`` is loaded. No numeric library is loaded before an engine
is chosen, so that a check of a computer stays fast.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, Literal, get_args

from controller.core.errors import UsageError
from controller.core.extras import extra_missing

if TYPE_CHECKING:
    from controller.optics.solve.bounded.engine import Engine

MODULE: Final = "wgpu"
"""The module of the extra `gpu`."""

Choice = Literal["auto", "cpu", "gpu"]


def graphics_processors() -> list[str] | None:
    """A name for each that could solve; None where the extra `gpu` is not installed."""
    if importlib.util.find_spec(MODULE) is None:
        return None
    from controller.optics.solve.gpu.device import DeviceRefused, adapters

    try:
        usable = adapters()
    except DeviceRefused:
        return []
    return [f"{adapter.name} ({adapter.backend}{', in software' if adapter.software else ''})" for adapter in usable]


def graphics_sentence() -> str:
    """For people: what of this computer can solve."""
    names = graphics_processors()
    if names is None:
        return "Solves run on the processor: the extra gpu is not installed."
    if not names:
        return "Solves run on the processor: no graphics processor was found."
    return f"Graphics processors for solves: {', '.join(names)}."


def choose_engine(device: str, note: Callable[[str], None]) -> Engine:
    """The engine for solves.

    ``device``: "cpu" the processor; "gpu" a graphics processor, also one in software; "auto" a real graphics processor
    where there is one, else the processor. ``note`` gets a sentence on what a graphics processor takes, and on what it
    had to leave to the processor.

    Raises UsageError("solve-device-unknown", "extra-missing", "no-graphics-processor").
    """
    from controller.optics.solve.bounded.engine import Processor

    if device not in get_args(Choice):
        raise UsageError(
            "solve-device-unknown",
            what=f"The device {device} to solve on is unknown.",
            remedy=f"Choose one of {', '.join(get_args(Choice))}.",
        )
    if device == "cpu":
        return Processor()
    if importlib.util.find_spec(MODULE) is None:
        if device == "gpu":
            missing = extra_missing(MODULE)
            assert missing is not None
            raise missing
        return Processor()
    from controller.optics.solve.gpu.device import Device, DeviceRefused, adapters
    from controller.optics.solve.gpu.engine import GpuEngine

    reason = "this computer has none that can be used"
    try:
        for adapter in adapters():
            if device == "gpu" or not adapter.software:
                return GpuEngine(Device(adapter), note)
    except DeviceRefused as refused:
        reason = str(refused)
        if device == "auto":
            note(f"The processor solves: {reason}.")
    if device == "gpu":
        raise UsageError(
            "no-graphics-processor",
            what=f"No graphics processor can solve: {reason}.",
            remedy='Install its Vulkan driver, or set device = "auto" under [solve] in stage.toml.',
        )
    return Processor()
