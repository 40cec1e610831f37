"""The picture by which a technician finds out which projector is which, and whether its picture is whole and sharp."""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from controller.play.frames import FrameSet, OutputSize

_GLYPHS: Final = (
    "A0E11111F111111 B1E11111E11111E C0E11101010110E D1E11111111111E E1F10101E10101F F1F10101E101010 "
    "G0E11101713110F H1111111F111111 I0E04040404040E J0702020202120C K11121418141211 L1010101010101F "
    "M111B1515111111 N11191513111111 O0E11111111110E P1E11111E101010 Q0E11111115120D R1E11111E141211 "
    "S0F10100E01011E T1F040404040404 U1111111111110E V11111111110A04 W1111111515150A X11110A040A1111 "
    "Y11110A04040404 Z1F01020408101F 00E11131519110E 1040C040404040E 20E11010608101F 30E11010601110E "
    "402060A121F0202 51F101E0101110E 60608101E11110E 71F010204080808 80E11110E11110E 90E11110F01020C "
    "-0000001F000000 _0000000000001F .00000000000C0C ?0E110102040004 :000C0C000C0C00 /01010204081010"
)
_FONT: Final = {glyph[0]: glyph[1:] for glyph in _GLYPHS.split()} | {" ": "00" * 7}
"""Characters of 5 x 7 dots: seven rows from the top, two hexadecimal digits each, the leftmost dot worth 16."""
_COLUMNS, _ROWS, _ADVANCE = 5, 7, 6


def identification(outputs: Sequence[OutputSize]) -> FrameSet:
    """For each output a frame of one pixel, lines to the corners, steps of grey, its number (from 1), name and size."""
    return FrameSet(tuple(_picture(number, output) for number, output in enumerate(outputs, start=1)))


def _picture(number: int, output: OutputSize) -> npt.NDArray[np.uint8]:
    height, width = output.height_px, output.width_px
    image = np.zeros(output.shape, np.uint8)
    along = np.arange(max(width, height))
    rows, columns = along * height // len(along), along * width // len(along)
    image[rows, columns] = image[rows, width - 1 - columns] = 96
    band = height // 12
    if band:
        image[height - 2 * band : height - band] = (np.arange(width) * 16 // width * 17).astype(np.uint8)[None, :, None]
    write_text(image, str(number), centre_row=height * 2 // 5, tall_px=height // 2)
    write_text(image, output.name, centre_row=height * 3 // 4, tall_px=height // 14)
    write_text(image, f"{width}X{height}", centre_row=height // 10, tall_px=height // 14)
    image[[0, -1], :] = image[:, [0, -1]] = 255
    return image


def write_text(image: npt.NDArray[np.uint8], text: str, *, centre_row: int, tall_px: int) -> None:
    """Write white on black round the middle column, as tall as given or smaller where it would not fit."""
    text = text.upper()
    dots = np.zeros((_ROWS + 2, _ADVANCE * len(text) + 1), np.uint8)
    for place, character in enumerate(text):
        # A letter with an accent is its letter; what has no likeness here is a question mark.
        plain = unicodedata.normalize("NFKD", character)[0]
        rows = bytes.fromhex(_FONT.get(plain, _FONT["?"]))
        bits = np.unpackbits(np.frombuffer(rows, np.uint8)[:, None], axis=1)[:, -_COLUMNS:]
        dots[1:-1, 1 + _ADVANCE * place :][:, :_COLUMNS] = bits
    scale = min(max(1, tall_px // _ROWS), image.shape[1] // dots.shape[1], image.shape[0] // dots.shape[0])
    if scale < 1:
        return
    block = np.kron(dots, np.full((scale, scale), 255, np.uint8))
    top = min(max(0, centre_row - len(block) // 2), image.shape[0] - len(block))
    left = (image.shape[1] - block.shape[1]) // 2
    image[top : top + len(block), left : left + block.shape[1]] = block[:, :, None]
