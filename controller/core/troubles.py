"""What a calibration may find wrong with devices, object or room, by its stable code."""

from __future__ import annotations

import enum


class TroubleCode(enum.StrEnum):
    """What it is, whatever the sentence about it says."""

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
    SURFACE_SPREAD = "surface-spread"
    UNSTEADY_LAMP = "unsteady-lamp"
    WHITE_SEGMENT = "white-segment"
