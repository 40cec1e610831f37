"""Which engine solves: the one that stage.toml or a person asked for, or the fastest that this computer has.

The extra `gpu` may be missing; then nothing of ``solve.gpu`` is loaded.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import Literal, get_args

from controller.core.errors import UsageError
from controller.core.extras import extra_missing
from controller.optics.solve.engines.graphics import MODULE
from controller.optics.solve.engines.processor import Engine, Processor

Choice = Literal["auto", "cpu", "gpu"]


def choose_engine(wanted: str, note: Callable[[str], None]) -> Engine:
    """The engine for solves.

    ``wanted``: "cpu" the processor; "gpu" a graphics processor, also one in software; "auto" a real graphics processor
    where there is one, else the processor. ``note`` gets a sentence on what a graphics processor takes, and on what it
    had to leave to the processor.

    Raises UsageError("solve-device-unknown", "extra-missing", "no-graphics-processor").
    """
    if wanted not in get_args(Choice):
        raise UsageError(
            "solve-device-unknown",
            what=f"The device {wanted} to solve on is unknown.",
            remedy=f"Choose one of {', '.join(get_args(Choice))}.",
        )
    if wanted == "cpu":
        return Processor()
    if importlib.util.find_spec(MODULE) is None:
        if wanted == "gpu":
            missing = extra_missing(MODULE)
            assert missing is not None
            raise missing
        return Processor()
    from controller.optics.solve.gpu.device import Device, DeviceRefused, adapters
    from controller.optics.solve.gpu.engine import GpuEngine

    reason = "this computer has none that can be used"
    try:
        for found in adapters():
            if wanted == "gpu" or not found.software:
                return GpuEngine(Device(found), note)
    except DeviceRefused as refused:
        reason = str(refused)
        if wanted == "auto":
            note(f"The processor solves: {reason}.")
    if wanted == "gpu":
        raise UsageError(
            "no-graphics-processor",
            what=f"No graphics processor can solve: {reason}.",
            remedy='Install its Vulkan driver, or set device = "auto" under [solve] in stage.toml.',
        )
    return Processor()
