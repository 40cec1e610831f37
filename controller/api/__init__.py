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

from controller.api.calibration import CalibratedRun, calibrate, decode, fit_metapixels, measure_response, read_run
from controller.api.captures import CaptureSet, Developed, develop, draw_patterns, merge_brackets, read_captures
from controller.api.codes import decode_folder
from controller.api.results import compare, export
from controller.api.solving import ReachableTarget, base_image, encode, reachable_target, scale, solve, solve_base
from controller.api.transport import (
    PairTransport,
    build_transport,
    indirect_light,
    transport_from_matrices,
    transport_from_pairs,
)
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
from controller.optics.solve.bounded.equations import Solution
from controller.optics.solve.result.metrics import Comparison
from controller.optics.transport import LightTransport
from controller.optics.transport.indirect.indirect_light import IndirectLight
from controller.stage.artefacts.solved import Solved
from controller.stage.exchange.pairs import Pairs, read_pairs

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
    "PairTransport",
    "Pairs",
    "PhaseMap",
    "Pinhole",
    "ProjectorCalibration",
    "Radiometry",
    "ReachableTarget",
    "Solution",
    "Solved",
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
    "read_pairs",
    "read_run",
    "scale",
    "solve",
    "solve_base",
    "transport_from_matrices",
    "transport_from_pairs",
]
