"""The controller's errors, and the codes of what a calibration may find wrong with devices, object or room.

The base of the errors and the errors of devices are in ``hal.errors``.
"""

from __future__ import annotations

import enum
from typing import ClassVar, Final

from hal.errors import CodedError

SEND_DIAGNOSTICS: Final = "Export the diagnostics and send them to the maintainers."
"""What to do about the code ``crash``: an error that the program did not expect."""


class VelaturaError(CodedError):
    """An error of the controller that a person can act on: ``code``, ``what`` and ``remedy`` as in ``CodedError``.

    ``exit_code`` is what the command line returns: 1 the work failed, 2 wrong use, 3 a device failed.
    """

    exit_code: ClassVar[int] = 1


class UsageError(VelaturaError):
    """Wrong arguments, a wrong stage.toml, a wrong file."""

    exit_code = 2


class WorkError(VelaturaError):
    """The work could not be done: no solution, no space, too little light."""


class CalibrationError(WorkError):
    """The captures do not allow a trustworthy calibration."""


class BundleError(WorkError):
    """A bundle is damaged, not trusted, or does not fit this stage."""


class TroubleCode(enum.StrEnum):
    """What a calibration may find wrong; the code of a ``Notice`` in the report."""

    CAMERA_GLARE = "camera-glare"
    COLOUR_FRINGES = "colour-fringes"
    EXPOSURE_TIMES = "exposure-times"
    GLOSS = "gloss"
    HOT_PIXELS = "hot-pixels"
    LENS_DISTORTION = "lens-distortion"
    PAINT_COLOURS = "paint-colours"
    PANEL_ALIGNMENT = "panel-alignment"
    PIXEL_RESPONSE = "pixel-response"
    PROJECTOR_GLARE = "projector-glare"
    SHAPE_UNKNOWN = "shape-unknown"
    SURFACE_SPREAD = "surface-spread"
    UNSTEADY_LAMP = "unsteady-lamp"
    WHITE_SEGMENT = "white-segment"
