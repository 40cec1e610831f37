"""Finding drivers: everything that a distribution lists under the entry-point group ``velatura.devices``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hal.deadline import Deadline

GROUP = "velatura.devices"
KINDS = ("projector", "camera", "display", "power_switch", "light_sensor", "button_panel", "bench")


@dataclass(frozen=True, slots=True)
class OpenContext:
    """What a driver may know of the stage: its folder (relative paths in settings start there), and where to log.

    ``transcripts``: folder for byte transcripts, or None to keep none. ``runtime``: short private folder for sockets.
    """

    stage: Path
    transcripts: Path | None = None
    runtime: Path | None = None


@dataclass(frozen=True, slots=True)
class Driver:
    """What an entry point names.

    ``open`` gets the device's table of stage.toml (without ``name`` and ``driver``), and returns an opened device of
    ``kind`` (see ``hal.interfaces``; for ``"bench"`` it is called with no settings and returns a ``Bench``).
    ``settings`` explains each key that ``open`` understands; keys in ``required`` must be there.
    """

    kind: str
    name: str
    summary: str
    open: Callable[[Mapping[str, Any], OpenContext, Deadline], Any]
    settings: Mapping[str, str] = field(default_factory=dict)
    required: tuple[str, ...] = ()
