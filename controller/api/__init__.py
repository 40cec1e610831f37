"""Velatura for researchers: from photographs to compensation images in Python, without a stage, a device or a command.

Arrays in, arrays out. Every name is imported from ``controller.api``::

    from controller import api

Install it with the extra ``controller``. The extras ``panel`` and ``cluster`` are not needed.

Light is linear everywhere: a value twice as large is twice as much light. Images are float32 arrays (rows, columns, 3),
red, green, blue. Sizes in pixels are (width, height), pixel positions are (x, y) = (column, row), and the centre of the
first pixel is (0, 0). Other number types are converted to float32. Lengths are in metres, exposure times in seconds.

Errors are ``VelaturaError``, with a stable ``code``, a sentence ``what`` happened and a ``remedy``.

The stable interface: all names in ``controller.api.__all__``, the parameters and attributes on this page, the
file formats of ``export``, and the error codes. Versions follow semantic versioning (semver.org): from 1.0 on
the interface changes only with a new major version; before 1.0 only with a new minor version. Deprecated names warn
with ``DeprecationWarning`` and stay for at least one more minor release. All other modules of ``controller`` may change
with every release.

Read ``captures`` first if you have photographs, ``transport`` if you have matrices.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from controller.api.calibration import CalibratedRun, calibrate, decode, fit_metapixels, measure_response, read_run
    from controller.api.captures import CaptureSet, draw_patterns, read_captures
    from controller.api.codes import decode_folder
    from controller.api.photographs import Developed, develop, merge_brackets
    from controller.api.results import compare, export
    from controller.api.solving import (
        ReachableTarget,
        base_image,
        encode,
        reachable_target,
        scale,
        solve,
        solve_base,
    )
    from controller.api.transport import build_transport, indirect_light, transport_from_matrices
    from controller.core.errors import VelaturaError
    from controller.optics.calibrate.metapixels.from_phase import FittedPixels
    from controller.optics.calibrate.values import (
        Calibration,
        Correspondence,
        Geometry,
        Metapixels,
        PhaseMap,
        Pinhole,
        ProjectorCalibration,
        Radiometry,
    )
    from controller.optics.capture.brackets import MergedBracket
    from controller.optics.capture.profile import CameraNoise, CameraProfile
    from controller.optics.solve.appearance import Base
    from controller.optics.solve.bounded.problem import Solution
    from controller.optics.solve.result.metrics import Comparison
    from controller.optics.transport import LightTransport
    from controller.optics.transport.indirect.indirect_light import IndirectLight

__all__ = [
    "Base",
    "CalibratedRun",
    "Calibration",
    "CameraNoise",
    "CameraProfile",
    "CaptureSet",
    "Comparison",
    "Correspondence",
    "Developed",
    "FittedPixels",
    "Geometry",
    "IndirectLight",
    "LightTransport",
    "MergedBracket",
    "Metapixels",
    "PhaseMap",
    "Pinhole",
    "ProjectorCalibration",
    "Radiometry",
    "ReachableTarget",
    "Solution",
    "VelaturaError",
    "base_image",
    "build_transport",
    "calibrate",
    "compare",
    "decode",
    "decode_folder",
    "develop",
    "draw_patterns",
    "encode",
    "export",
    "fit_metapixels",
    "indirect_light",
    "measure_response",
    "merge_brackets",
    "reachable_target",
    "read_captures",
    "read_run",
    "scale",
    "solve",
    "solve_base",
    "transport_from_matrices",
]

_MODULES: Final = {
    "controller.api.photographs": ("Developed", "develop", "merge_brackets"),
    "controller.api.captures": ("CaptureSet", "draw_patterns", "read_captures"),
    "controller.api.codes": ("decode_folder",),
    "controller.api.calibration": (
        "CalibratedRun", "calibrate", "decode", "fit_metapixels", "measure_response", "read_run",
    ),
    "controller.api.transport": ("build_transport", "indirect_light", "transport_from_matrices"),
    "controller.api.solving": (
        "ReachableTarget", "base_image", "encode", "reachable_target", "scale", "solve", "solve_base",
    ),
    "controller.api.results": ("compare", "export"),
    "controller.optics.calibrate.metapixels.from_phase": ("FittedPixels",),
    "controller.optics.calibrate.values": (
        "Calibration", "Correspondence", "Geometry", "Metapixels", "PhaseMap", "Pinhole", "ProjectorCalibration",
        "Radiometry",
    ),
    "controller.optics.capture.brackets": ("MergedBracket",),
    "controller.optics.capture.profile": ("CameraNoise", "CameraProfile"),
    "controller.core.errors": ("VelaturaError",),
    "controller.optics.solve.appearance": ("Base",),
    "controller.optics.solve.bounded.solver": ("Solution",),
    "controller.optics.solve.result.metrics": ("Comparison",),
    "controller.optics.transport": ("LightTransport",),
    "controller.optics.transport.indirect.indirect_light": ("IndirectLight",),
}  # fmt: skip
_HOME: Final = {name: module for module, names in _MODULES.items() for name in names}


def __dir__() -> list[str]:
    return [*__all__, "__doc__", "__name__"]


if not TYPE_CHECKING:  # a type checker sees the imports above, and reports names that are not there

    def __getattr__(name: str) -> object:
        """Import a name when it is first used, so that ``import controller.api`` takes no time."""
        if name not in _HOME:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        found = getattr(importlib.import_module(_HOME[name]), name)
        globals()[name] = found
        return found
