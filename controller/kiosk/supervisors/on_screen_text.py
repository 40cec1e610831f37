"""Shows lines of text on a projector through the player's inbox (docs/reference/player-protocol.md, "Frame file")."""

from __future__ import annotations

import mmap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from controller.play.display.identification import write_text
from controller.play.frames import SEQUENCE_AT, FrameSet, OutputSize, layout_bytes

_TALL: Final = 14
"""The picture's height over that of a line; a line that is too long is written smaller."""


def outputs_of(hello: Mapping[str, Any]) -> tuple[OutputSize, ...]:
    """The outputs in a player's answer to hello."""
    return tuple(OutputSize(row["name"], row["width_px"], row["height_px"]) for row in hello["outputs"])


def notice(outputs: Sequence[OutputSize], lines: Sequence[str], turn: int) -> FrameSet:
    """The lines on output number ``turn``, in capitals, white on black, in the middle of the picture."""
    frames = FrameSet.black(outputs)
    image = frames.pixels[turn]
    height = image.shape[0]
    for number, line in enumerate(lines):
        row = height / 2 + (number - (len(lines) - 1) / 2) * 2 * height / _TALL
        write_text(image, line, centre_row=round(row), tall_px=max(7, height // _TALL))
    return frames


def put(inbox: Path, outputs: Sequence[OutputSize], frames: FrameSet) -> int:
    """Write a set into the inbox; returns the sequence number for ``show``. Raises OSError."""
    _, offsets = layout_bytes(outputs)
    with inbox.open("r+b") as file, mmap.mmap(file.fileno(), 0) as mapped:
        sequence = np.frombuffer(mapped, "<u8", 1, SEQUENCE_AT)
        odd = int(sequence[0]) | 1
        sequence[0] = odd
        for offset, image in zip(offsets, frames.pixels, strict=True):
            mapped[offset : offset + image.nbytes] = image.tobytes()
        sequence[0] = odd + 1
        del sequence
    return odd + 1
