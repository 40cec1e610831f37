"""Shows lines of text on a projector through the player's inbox (docs/reference/player-protocol.md, "Frame file").

A module of its own, because it only draws: ``player_supervisor`` decides when.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from controller.play.display.identification import write_text
from controller.play.frames import FrameSet, OutputSize
from hal.player import Inbox
from hal.values import OutputInfo

_TALL: Final = 14
"""The picture's height over that of a line; a line that is too long is written smaller."""
_CODE_SHARE: Final = 0.5
"""Of the picture's height, for a QR code and its margin."""


def outputs_of(hello: Mapping[str, Any]) -> tuple[OutputSize, ...]:
    """The outputs in a player's answer to hello."""
    return tuple(OutputSize(row["name"], row["width_px"], row["height_px"]) for row in hello["outputs"])


def notice(outputs: Sequence[OutputSize], lines: Sequence[str], turn: int) -> FrameSet:
    """The lines on output number ``turn``, white on black, in the middle of the picture. If one is an
    address that others reach, its QR code stands above them.
    """
    frames = FrameSet.black(outputs)
    image = frames.pixels[turn]
    # A telephone can't open what only this computer reaches.
    address = next((line for line in lines if line.startswith("http") and "//127." not in line), "")
    top = _draw_code(image, address) if address else 0
    height = image.shape[0] - top
    tall = height / max(_TALL, 2 * len(lines) + 1) if address else height / _TALL
    for number, line in enumerate(lines):
        row = top + height / 2 + (number - (len(lines) - 1) / 2) * 2 * tall
        write_text(image, line, centre_row=round(row), tall_px=max(7, round(tall)))
    return frames


def _draw_code(image: npt.NDArray[np.uint8], address: str) -> int:
    """A QR code in the middle of the picture's upper part; the row below it. None where the picture is too small."""
    import cv2

    # With the encoder's own margin of two it is the four modules of white that a reader needs.
    modules = np.pad(cv2.QRCodeEncoder.create().encode(address), 2, constant_values=255)
    size = min(round(_CODE_SHARE * image.shape[0]), image.shape[1]) // len(modules)
    if size < 1:
        return 0
    code = np.kron(modules, np.ones((size, size), np.uint8))
    left, above = (image.shape[1] - len(code)) // 2, (round(_CODE_SHARE * image.shape[0]) - len(code)) // 2
    image[above : above + len(code), left : left + len(code)] = code[:, :, None]
    return int(above + len(code))


def put(path: Path, outputs: Sequence[OutputSize], frames: FrameSet) -> int:
    """Write a set into the inbox at ``path``; returns the sequence number for ``show``. Raises as ``Inbox``."""
    inbox = Inbox(path, [OutputInfo(output.name, output.width_px, output.height_px) for output in outputs])
    try:
        return inbox.put({output.name: image for output, image in zip(outputs, frames.pixels, strict=True)})
    finally:
        inbox.close()
