"""Cross-fades and dimming: sets of device values mixed in (nearly) linear light."""

from __future__ import annotations

from concurrent.futures import Executor
from typing import Final

import numpy as np
import numpy.typing as npt

from controller.play.frames import FrameSet

_BLOCK_BYTES: Final = 96 * 1024
"""Small enough that the working copies stay in the processor's cache."""


def mix_sets(before: FrameSet, after: FrameSet, share: float, into: FrameSet, pool: Executor | None = None) -> None:
    """Write ``sqrt((1 - share) before^2 + share after^2)``, rounded, into ``into``; ``share`` is in [0, 1].

    The square stands for every projector's response (docs/decisions/0016-fades-mix-squares.md). Both ends are
    exact. All sets have the same shapes; ``into`` is neither of the others. On the threads of ``pool`` if given.
    """
    halves = []
    for old, new, out in zip(before.pixels, after.pixels, into.pixels, strict=True):
        rows = len(out)
        for part in (slice(0, rows // 2), slice(rows // 2, rows)):
            halves.append((old[part].reshape(-1), new[part].reshape(-1), out[part].reshape(-1)))
    if pool is None:
        for half in halves:
            _mix(*half, share)
    else:
        for future in [pool.submit(_mix, *half, share) for half in halves]:
            future.result()


def dimmed(frames: FrameSet, share: float) -> FrameSet:
    """A new set with ``share`` (0..1) of the light of ``frames``: its mixture with black, as ``mix_sets`` makes it."""
    table = (np.sqrt(np.float64(share)) * np.arange(256) + 0.5).astype(np.uint8)
    return FrameSet(tuple(table[image] for image in frames.pixels))


def _mix(old: npt.NDArray[np.uint8], new: npt.NDArray[np.uint8], out: npt.NDArray[np.uint8], share: float) -> None:
    length = min(_BLOCK_BYTES, out.size)
    light, other = np.empty(length, np.float32), np.empty(length, np.float32)
    # Scaled before squaring: one multiplication for both.
    scales = np.sqrt(np.float32(1 - share)), np.sqrt(np.float32(share))
    for start in range(0, out.size, _BLOCK_BYTES):
        end = min(start + _BLOCK_BYTES, out.size)
        first, second = light[: end - start], other[: end - start]
        np.multiply(old[start:end], scales[0], out=first)
        np.multiply(first, first, out=first)
        np.multiply(new[start:end], scales[1], out=second)
        np.multiply(second, second, out=second)
        np.add(first, second, out=first)
        np.sqrt(first, out=first)
        np.add(first, np.float32(0.5), out=first)
        np.copyto(out[start:end], first, casting="unsafe")
