"""How long a picture takes from the computer to the camera, and whether a photograph shows the picture before.

Projectors show a frame one to eight frames after they got it, cameras open their shutter a while after the command;
only the sum matters, and it is measured as a whole: by photographing a change ever later after it was shown.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from controller.core.arrays import ByteImage, Float64, FloatImage
from controller.core.channels import largest
from controller.core.errors import CalibrationError
from controller.optics.capture.linear_files import is_linear
from controller.optics.capture.profile import CameraNoise
from controller.optics.capture.raw import is_jpeg, read_jpeg_values, read_mosaic, read_samples

LONGEST_S = 1.5
"""No display is slower than this; pictures that must be visible are given this time."""
FIRST_DELAY_S = 0.04
RESOLUTION_S = 0.025
MARGIN_S = 0.035
"""Two frames: a picture may just have missed one at the display and one at the projector."""
MARGIN_SHARE = 0.5
"""Of the delay: a slow panel that shows 96 per cent of a change by then shows more than 99 after so much longer."""
WHOLE_SHARE = 0.96
"""A picture is complete when all but a few blocks show this much of the change; lamps flicker by less."""
NEARLY_SHARE = 0.9
"""Where the best blocks show this much, the rest is a lamp's flicker, or less than the margin."""
BLOCK_PX = 16
LIT_SHARE = 0.1
WORST_BLOCKS = 3.0
"""Per cent of the blocks that may be below, because something moved or reflects."""
LEAST_CONTRAST = 0.01
CONFIRMATIONS = 4
BEFORE_TIMES = 4.0
"""While the delay is searched, the picture before is shown for so many times the delay that was enough."""
CONFIRMED_TIMES, CONFIRMED_S = 8.0, 0.5
"""As ``BEFORE_TIMES``, and at least so long, while what was found is confirmed."""
SPARSE = 8
NOTICEABLE = 24
"""Of 255."""
CHANGED_FRAMES = 0.04
"""Of the pixels of a set of frames: a smaller change may be too small to be seen in sparse samples."""
DIFFERENT_SIGMAS = 6.0
DIFFERENT_SHARE = 0.03
FEWEST_DIFFERENT = 0.003


@dataclass(frozen=True, slots=True)
class Latency:
    """``delay_s`` after which pictures were whole, and the (delay, share of the change seen) of each try."""

    delay_s: float
    tries: tuple[tuple[float, float], ...]

    @property
    def wait_s(self) -> float:
        """How long to wait between a picture's presentation and the shutter."""
        return self.delay_s + max(MARGIN_S, MARGIN_SHARE * self.delay_s)


class CaptureFlat(Protocol):
    """Show white or black after the other one was shown for ``before_s``, and photograph it ``delay_s`` later.

    (rows, columns) or (rows, columns, 3) in linear light, NaN where saturated
    """

    def __call__(self, white: bool, delay_s: float, *, before_s: float) -> FloatImage: ...


def measure_latency(look: CaptureFlat) -> Latency:
    """Find the delay from which photographs show the new picture whole, changing to white and to black in turn.

    Parameters
    ----------
    look : see ``CaptureFlat``

    Raises CalibrationError("picture-not-seen") when white and black do not differ even after ``LONGEST_S``.
    """
    black = blocks(look(False, LONGEST_S, before_s=0.0))
    white = blocks(look(True, LONGEST_S, before_s=0.0))
    change = white - black
    lit = change > LIT_SHARE * np.nanmax(change, initial=0.0)
    if not np.any(lit) or float(np.nanmax(change)) < LEAST_CONTRAST:
        raise CalibrationError(
            "picture-not-seen",
            what=f"The camera sees no difference between white and black {LONGEST_S:g} s after they are shown.",
            remedy="Check that the camera sees the object and that the outputs are connected to the projectors. No "
            "projector may be frozen, blanked or on another input.",
        )
    tries: list[tuple[float, float]] = []

    def whole(delay_s: float, before_s: float = LONGEST_S) -> bool:
        to_white = len(tries) % 2 == 1  # the references ended with white
        seen_light = blocks(look(to_white, delay_s, before_s=before_s))
        share: npt.NDArray[np.float64] = (seen_light - black)[lit] / change[lit]
        finite = share[np.isfinite(share)]
        seen = finite if to_white else 1 - finite
        share_seen = float(np.percentile(seen, WORST_BLOCKS)) if seen.size else 0.0
        best = float(np.percentile(seen, 100 - WORST_BLOCKS)) if seen.size else 0.0
        if best >= NEARLY_SHARE:
            share_seen /= best
        tries.append((delay_s, share_seen))
        return share_seen >= WHOLE_SHARE

    late_s, delay_s = 0.0, 0.0
    while not whole(delay_s) and delay_s < LONGEST_S:
        late_s, delay_s = delay_s, min(max(FIRST_DELAY_S, 2 * delay_s), LONGEST_S)
    # Here several times the delay that was enough is enough for the picture before, too.
    before_s = min(LONGEST_S, BEFORE_TIMES * delay_s)
    confirming_s = min(LONGEST_S, max(CONFIRMED_S, CONFIRMED_TIMES * delay_s))
    while delay_s - late_s > RESOLUTION_S:
        middle_s = 0.5 * (late_s + delay_s)
        late_s, delay_s = (late_s, middle_s) if whole(middle_s, before_s) else (middle_s, delay_s)
    return Latency(_confirmed(partial(whole, before_s=confirming_s), delay_s), tuple(tries))


def _confirmed(whole: Callable[[float], bool], delay_s: float) -> float:
    """A delay at which the change was seen whole both ways: panels may rise faster than they fall."""
    in_a_row = 0
    for _ in range(CONFIRMATIONS):
        if whole(delay_s):
            in_a_row += 1
            if in_a_row == 2:
                break
        else:
            in_a_row = 0
            delay_s += RESOLUTION_S
    return delay_s


def blocks(image: FloatImage) -> npt.NDArray[np.float64]:
    """Means of 16x16 blocks of the grey image; NaN where none of a block was measured."""
    grey = image.mean(axis=2) if image.ndim == 3 else image
    rows, columns = (max(side // BLOCK_PX, 1) for side in grey.shape)
    measured = np.isfinite(grey)
    size = (columns, rows)
    total = cv2.resize(np.where(measured, grey, 0).astype(np.float64), size, interpolation=cv2.INTER_AREA)
    count = cv2.resize(measured.astype(np.float64), size, interpolation=cv2.INTER_AREA)
    means = np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0.5)
    return np.asarray(means, np.float64)


def seen_change(seen: Float64, before: Float64, after: Float64, whites: Float64) -> Float64:
    """When each output changed from what ``before`` shows to ``after`` during the exposure of ``seen``.

    All are ``blocks`` of photographs with the same exposure; ``whites`` (outputs, rows, columns): of each output alone,
    at any brightness.

    Returns (outputs + 1,): the share of the exposure after the change of each output, in the middle row; and how much
    larger it is in the last row than in the first, because shutters and panels may change line by line.
    """
    full, got = after - before, seen - before
    used = np.isfinite(full + got + whites.sum(axis=0)) & (abs(full) > LIT_SHARE * np.nanmax(abs(full), initial=0.0))
    full, got, whites = full[used], got[used], whites[:, used]
    lamps = np.linalg.lstsq(whites.T, full, rcond=None)[0]
    light = whites * lamps[:, None]
    row = (np.nonzero(used)[0] + 0.5) / len(seen) - 0.5
    parts = full * np.vstack([light / light.sum(axis=0), row])
    return np.asarray(np.linalg.lstsq(parts.T, got, rcond=None)[0], np.float64)


def changed_share(before: Mapping[str, ByteImage], after: Mapping[str, ByteImage]) -> float:
    """Share of all outputs' pixels whose value changes noticeably between two sets of frames of the same outputs."""
    if before.keys() != after.keys():
        return 1.0
    total = sum(image.shape[0] * image.shape[1] for image in after.values())
    changed: int = 0
    for name, image in after.items():
        if before[name].shape != image.shape:
            changed += image.shape[0] * image.shape[1]
        elif before[name] is not image:
            changed += int(np.count_nonzero(largest(cv2.absdiff(before[name], image)) > NOTICEABLE))
    share: float = changed / max(total, 1)
    return share


@dataclass(frozen=True, slots=True)
class Fingerprint:
    """Sparse green samples of a photograph in full scale per second, and what a full scale is: 1 / exposure_s."""

    samples: FloatImage
    full_scale: float


def fingerprint(path: Path, exposure_s: float) -> Fingerprint:
    """Read a photograph's fingerprint. Raises WorkError("photograph-unreadable")."""
    if is_jpeg(path):
        # Squared, a JPEG's values are near enough to light for telling whether two pictures are the same.
        light = (read_jpeg_values(path)[::SPARSE, ::SPARSE, 1].astype(np.float32) / 255) ** 2
        return Fingerprint((light / np.float32(exposure_s)).astype(np.float32), 1 / exposure_s)
    if is_linear(path):
        sparse = read_samples(path)[0][::SPARSE, ::SPARSE, 1]
        return Fingerprint((sparse / np.float32(exposure_s)).astype(np.float32), 1 / exposure_s)
    mosaic = read_mosaic(path)
    column = 0 if mosaic.levels.colours[0, 0] == 1 else 1
    sparse = mosaic.samples[0::SPARSE, column::SPARSE].astype(np.float32)
    black, white = mosaic.levels.black[0, column], mosaic.levels.white[0, column]
    samples = (sparse - np.float32(black)) / np.float32((white - black) * exposure_s)
    return Fingerprint(samples.astype(np.float32), 1 / exposure_s)


def same_picture(one: Fingerprint, other: Fingerprint) -> bool:
    """Whether two photographs show the same picture, as far as noise, flicker and clipping let one see."""
    noise = CameraNoise()
    if one.samples.shape != other.samples.shape:
        return False
    ceiling = 0.9 * min(one.full_scale, other.full_scale)
    below = (one.samples < ceiling) & (other.samples < ceiling)
    variance = np.zeros(one.samples.shape, np.float32)
    for print_ in (one, other):
        full = np.float32(print_.full_scale)
        light = np.maximum(print_.samples / full, 0)
        variance += (np.float32(noise.shot) * light + np.float32(noise.read**2)) * full**2
    level = np.maximum(np.maximum(one.samples, other.samples), 0)
    allowed = DIFFERENT_SIGMAS * np.sqrt(variance) + np.float32(DIFFERENT_SHARE) * level
    # A sample that is clipped in one alone differs; clipped in both it gives no information.
    clipped_in_one = (one.samples >= ceiling) != (other.samples >= ceiling)
    far = np.abs(one.samples - other.samples) > np.maximum(allowed, np.float32(DIFFERENT_SHARE * ceiling) / 4)
    different = np.count_nonzero(far & (below | clipped_in_one))
    return bool(different < FEWEST_DIFFERENT * one.samples.size)
