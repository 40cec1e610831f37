"""The causes of an error, each with its words and its colour: on pictures, in reports and on the panel."""

from __future__ import annotations

import enum
from typing import Final


class ErrorCause(enum.IntEnum):
    """Codes of the label map; the first that holds is taken, in this order, INDIRECT before DIMMED."""

    FINE = 0
    SATURATED = 1
    UNDECODED = 2
    EDGE = 3
    MOVED = 4
    DIMMED = 5
    DARK = 6
    GRAZING = 7
    DEFOCUS = 8
    UNEXPLAINED = 9
    INDIRECT = 10


WORDS: Final[dict[ErrorCause, tuple[str, str, str]]] = {
    ErrorCause.SATURATED: ("saturated", "the photograph is saturated", "shorten the exposure or cover what glares"),
    ErrorCause.UNDECODED: (
        "not decoded", "the projector lights it but its patterns could not be read",
        "a shiny, very dark or barely lit surface; make it matt, or add light from another side",
    ),
    ErrorCause.EDGE: (
        "edge of two surfaces", "camera pixels see two surfaces at once, at a depth edge or in a mirror",
        "make polished metal matt; at edges usually no action is needed: move the projector or the camera if such "
        "lines disturb",
    ),
    ErrorCause.MOVED: ("moved", "the pattern lies elsewhere than predicted", "something moved: run `velatura drift`"),
    ErrorCause.DIMMED: (
        "brightness", "it is evenly brighter or darker than predicted",
        "let the lamps warm up longer, keep other light out, and calibrate again; if it stays, the projector's picture "
        "mode may bend its response",
    ),
    ErrorCause.DARK: (
        "noise", "most of the error is the camera's noise",
        "usually no action is needed; longer exposures, more light or a camera with less noise would help",
    ),
    ErrorCause.GRAZING: ("grazing light", "the light falls at a grazing angle",
                     "turn the object, or move a projector towards that side"),
    ErrorCause.DEFOCUS: ("out of focus", "the projector is out of focus there", "focus the projector on this depth"),
    ErrorCause.INDIRECT: (
        "indirect light", "much of the light comes by way of other surfaces, and varies more than the model of it",
        "darken what stands around the object, or use targets that are less dark there",
    ),
    ErrorCause.UNEXPLAINED: ("unexplained", "no simple reason was found",
                         "gloss, metal, translucent surfaces and reflections can cause this: make shiny metal matt"),
}  # fmt: skip
"""Short name, description, remedy."""

COLOURS: Final[dict[ErrorCause, tuple[int, int, int]]] = {
    ErrorCause.SATURATED: (240, 228, 66),
    ErrorCause.UNDECODED: (0, 0, 0),
    ErrorCause.EDGE: (0, 114, 178),
    ErrorCause.MOVED: (213, 94, 0),
    ErrorCause.DIMMED: (230, 159, 0),
    ErrorCause.DARK: (86, 180, 233),
    ErrorCause.GRAZING: (0, 158, 115),
    ErrorCause.DEFOCUS: (204, 121, 167),
    ErrorCause.INDIRECT: (146, 73, 0),
    ErrorCause.UNEXPLAINED: (255, 255, 255),
}
"""Okabe and Ito's palette and a brown, which people with any colour vision can distinguish."""
