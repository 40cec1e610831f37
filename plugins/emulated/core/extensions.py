"""Parts of the bench that other distributions bring, by the entry-point group ``velatura.bench``.

``boards``: projectors with another control board than the usual one, or on a LAN port; ``bumps``: changes of a stage;
``dousers``: DMX nodes with dousers; ``effects``: depth of field, dithered panels, varnish, light by wavelength and
under the surface, and the room ``hard``; ``mitsuba``: an engine of indirect light
(``plugins.emulated.optics.indirect.transfers``); ``scenario``: players of a script of faults; ``solids``: objects of
plain shapes; ``stands``: projectors at planned places; ``tape``: the devices of a tape; ``usb``: what
``bench/usb.toml`` lists (``plugins.emulated.bench.UsbDevices``). All are in velatura-lab.
"""

from __future__ import annotations

import contextlib
from importlib.metadata import entry_points
from typing import Any, Final

from hal.errors import DeviceError

GROUP: Final = "velatura.bench"


def extension(name: str, *, asked_by: str) -> Any:
    """What this entry point names; ``asked_by``: what in a stage needs it. Raises DeviceError("bench-part-missing")."""
    for entry in entry_points(group=GROUP, name=name):
        with contextlib.suppress(ImportError, AttributeError):
            return entry.load()
    raise DeviceError(
        "bench-part-missing",
        what=f"{asked_by} needs the distribution velatura-lab of this version, which is not installed.",
        remedy="Run `pip install velatura-lab` in Velatura's environment, "
        "or `pip install --editable lab` in a copy of the source.",
    )
