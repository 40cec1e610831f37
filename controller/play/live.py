"""Live targets on an output: from a shared file of targets, by shaders where the output has them, else by numpy.

The file of targets is a frame file (docs/player-protocol.md) with one output, ``target``, of the size that the bundle's
live section says. Whoever makes targets (a program, or a reader of a video file) writes them there, sRGB, 8 bits.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from controller.errors import WorkError
from controller.play.frames import FrameFile, FrameSet, OutputSize
from controller.play.live_maps import LiveMaps, compensate
from controller.play.outputs import Output

TARGET: Final = "target"


@runtime_checkable
class LiveOutput(Protocol):
    """An output that makes the frames of a live target itself."""

    def load_live(self, maps: LiveMaps) -> None:
        """Take a bundle's live section over. Raises WorkError("display-unfit") where the driver can not use it."""

    def prepare_live(self, target: npt.NDArray[np.uint8], brightness: float) -> None:
        """As ``Output.prepare``, with the frames for this target (height, width, 3) uint8 sRGB."""


class LivePicture:
    """Prepares live targets on an output; ``on_gpu`` says how.

    ``tell`` gets a sentence where shaders were expected and the processor does their work.
    """

    def __init__(self, output: Output, maps: LiveMaps, tell: Callable[[str], None]) -> None:
        self._output, self._maps = output, maps
        self._shader: LiveOutput | None = None
        if isinstance(output, LiveOutput):
            try:
                output.load_live(maps)
                self._shader = output
            except WorkError as error:
                tell(f"{error.what} The processor makes the live frames, which takes far longer.")

    @property
    def on_gpu(self) -> bool:
        """Whether shaders make the frames."""
        return self._shader is not None

    def prepare(self, target: npt.NDArray[np.uint8], brightness: float) -> None:
        """Make the frames for a target (height, width, 3) uint8 sRGB ready; ``Output.flip`` then shows them."""
        if self._shader is not None:
            self._shader.prepare_live(target, brightness)
        else:
            self._output.prepare(compensate(self._maps, target, brightness))


class LiveTargets:
    """The shared file of targets: ``newest`` is what was last written whole."""

    def __init__(self, path: Path, maps: LiveMaps) -> None:
        """Map ``path``, making it where it is missing. Raises as ``FrameFile``."""
        size = OutputSize(TARGET, *maps.target_px)
        self._file = FrameFile(path, [size])
        self._set = FrameSet.black([size])
        self._seen = self._file.sequence

    def newest(self) -> npt.NDArray[np.uint8] | None:
        """The target (height, width, 3), valid until the next call; None where there is none since, or it changes."""
        if self._file.sequence in (self._seen, self._seen | 1):
            return None
        try:
            self._seen = self._file.read(self._set)
        except WorkError:
            return None
        return self._set.pixels[0]

    def close(self) -> None:
        """Release the mapping; the file stays."""
        self._file.close()
