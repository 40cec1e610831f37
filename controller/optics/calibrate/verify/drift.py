"""What has changed since a calibration, from a few photographs: what moved, by how much, and which lamps have dimmed.

Each projector shows one random pattern alone, then all show white, then black. Every photograph is compared with what
the light transport predicts. A projector that moved shifts its own pattern; a camera that moved shifts the object's
paint and all patterns alike; an object that moved shifts the paint, and patterns lie elsewhere on it.

After a projector has turned, where all lies now follows from the homography, without new codes (``update_positions``).
"""

from __future__ import annotations

import dataclasses
import enum
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Protocol

import cv2
import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.channels import finite, smallest, total
from controller.optics.calibrate.values import Calibration, ProjectorCalibration, Radiometry
from controller.optics.calibrate.verify.registration import Motion, no_motion, register, warp

STILL_PX = 0.1
"""Motion of a projector's picture, in its pixels, or of the camera's that still counts as none: the model's own
error."""
SAME_LIGHT = 0.015
"""A gain within this of 1 is the model's own error."""
LOCAL_PX = 0.35
"""Parts of a picture whose motion disagrees by more were not moved by a simple turn of the projector."""
PARALLAX_SHARE = 0.15
"""Of the camera's own motion: what a homography may leave unexplained on an object with depth."""
CAMERA_PIXELS = 1_200_000
"""Larger camera images are shrunk before they are registered."""
LEAST_LIGHT = 0.25
"""Below this share of its light a projector counts as dark, and the position of its picture is not reported."""
PART_PX: Final = 8
"""Side of a part of a projector's picture: its mean is the same in a softer picture."""
CHANGE_PX: Final = 6.0
"""Camera pixels over which a change of light is even: a Gaussian's standard deviation."""
NOISE_AROUND: Final = (7, 7)
"""Camera pixels over which a difference is compared with noise."""
AMBIENT_SHARE = 0.003
"""Of white: a larger change of the black image is reported."""


class TransportModel(Protocol):
    """The part of the light transport that the drift check needs."""

    @property
    def lit(self) -> Mask:
        """(projectors, rows, columns): where each projector's light is known."""
        ...

    def forward_part(self, n: int, p: FloatImage) -> FloatImage:
        """(rows, columns, 3) light of projector ``n`` alone that shows ``p``."""
        ...

    def gaussian_mean(self, image: FloatImage, n: int) -> FloatImage:
        """The mean of a camera ``image`` over the light of each of projector ``n``'s pixels."""
        ...


@dataclass(frozen=True, slots=True)
class DriftPhotographs:
    """The photographs: (rows, columns, 3) float32, full scales per second, NaN where saturated.

    ``patterns``: of each projector alone, by name; ``white``: of all projectors at white; ``black``: at black.
    """

    black: FloatImage
    white: FloatImage
    patterns: Mapping[str, FloatImage]


@dataclass(frozen=True, slots=True)
class ProjectorDrift:
    """One projector since the calibration.

    ``motion`` in its own pixels: where a point of the object lies in its image now, from where it lay
    ``gain`` (3,) light of its red, green and blue channel now over then, with ``gain_sigma`` (3,)
    ``local_px`` how far parts of its picture, once registered, still lie from where they should
    ``light_share`` what reaches the camera, over what should
    """

    name: str
    motion: Motion
    gain: tuple[float, float, float]
    gain_sigma: tuple[float, float, float]
    local_px: float
    light_share: float

    @property
    def known(self) -> bool:
        """Whether its picture was recognised."""
        return self.motion.found

    @property
    def moved(self) -> bool:
        """Whether its picture lies elsewhere than before."""
        return self.motion.moved(STILL_PX)

    @property
    def turned_only(self) -> bool:
        """Whether a homography explains all of its motion."""
        return self.known and self.local_px <= LOCAL_PX

    def flickering(self, flicker: float) -> ProjectorDrift:
        """The same of a lamp whose light differs by so much from one photograph to the next, relative."""
        red, green, blue = (math.hypot(sigma, flicker) for sigma in self.gain_sigma)
        return replace(self, gain_sigma=(red, green, blue))

    @property
    def dimmed(self) -> bool:
        """Whether the light of some channel has changed, either way."""
        return self.known and any(
            abs(gain - 1) > max(SAME_LIGHT, 3 * sigma) for gain, sigma in zip(self.gain, self.gain_sigma, strict=True)
        )


class DriftCause(enum.Enum):
    """What shifted the picture as a whole."""

    NONE = "none"
    CAMERA = "camera"
    OBJECT = "object"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class Drift:
    """What has changed since the calibration.

    ``projectors``: as seen after the camera's own motion was taken out; ``camera``: how the object's picture moved, in
    camera pixels; ``ambient_share``: change of the black image over white; ``ambient_ratio``: black now over then
    """

    projectors: tuple[ProjectorDrift, ...]
    camera: Motion
    culprit: DriftCause
    ambient_share: float
    ambient_ratio: float

    @property
    def moved(self) -> tuple[str, ...]:
        """Projectors whose pictures moved on the object, or were not recognised."""
        return tuple(one.name for one in self.projectors if one.moved or not one.known)

    @property
    def dimmed(self) -> tuple[str, ...]:
        """Projectors whose light has changed."""
        return tuple(one.name for one in self.projectors if one.dimmed)

    @property
    def ambient_changed(self) -> bool:
        """Whether other light in the room has changed."""
        return abs(self.ambient_share) > AMBIENT_SHARE

    @property
    def nothing(self) -> bool:
        """Whether the calibration still holds."""
        return self.culprit is DriftCause.NONE and not (self.moved or self.dimmed or self.ambient_changed)


def find_drift(
    light: TransportModel, calibration: Calibration, frames: Sequence[FloatImage], seen: DriftPhotographs
) -> Drift:
    """Compare photographs with the prediction.

    Parameters
    ----------
    light : the light transport of ``calibration``
    frames : (rows, columns, 3) float32 linear light that each projector showed
    """
    names = [part.name for part in calibration.projectors]
    black = np.where(np.isfinite(seen.black), seen.black, calibration.black).astype(np.float32)
    patterns = [seen.patterns[name] - black for name in names]
    parts = list(zip(range(len(names)), calibration.projectors, frames, strict=True))
    drifts = [_projector(light, n, part, frame, patterns[n]) for n, part, frame in parts]
    camera = _camera(calibration, drifts, seen)
    culprit = DriftCause.NONE if camera.found else DriftCause.UNKNOWN
    seen_here = [one for n, one in enumerate(drifts) if light.lit[n].any()]
    if camera.moved(STILL_PX) and not _explained_by_projectors(camera, seen_here):
        back = np.asarray(np.linalg.inv(camera.matrix), np.float64)
        patterns = [warp(pattern, back) for pattern in patterns]
        drifts = [_projector(light, n, part, frame, patterns[n]) for n, part, frame in parts]
        camera = _camera(calibration, drifts, seen)
        culprit = _culprit(camera, drifts, light, calibration)
    share, ratio = _ambient(calibration, seen)
    return Drift(tuple(drifts), _backwards(camera), culprit, share, ratio)


def _explained_by_projectors(camera: Motion, found: Sequence[ProjectorDrift]) -> bool:
    """Shading that went with a projector can shift the object's picture a little, though the others lie still."""
    still = [one for one in found if one.known and not one.moved]
    return bool(still) and camera.rms_px < 3 * STILL_PX


def _culprit(
    camera: Motion, found: Sequence[ProjectorDrift], light: TransportModel, calibration: Calibration
) -> DriftCause:
    """After the camera's motion was taken out, patterns lie still on the object, unless it was the object."""
    known = [(n, one) for n, one in enumerate(found) if one.known and light.lit[n].any()]
    if not known or not camera.found:
        return DriftCause.UNKNOWN
    elsewhere = []
    for n, one in known:
        # A homography leaves a part of the camera's motion unexplained where the object has depth.
        tolerated = PARALLAX_SHARE * camera.rms_px / camera_px_per_pixel(calibration.projectors[n])
        elsewhere.append(one.motion.moved(STILL_PX + tolerated))
    if 2 * sum(elsewhere) <= len(known) - (len(known) == 2):
        return DriftCause.CAMERA
    return DriftCause.OBJECT if all(elsewhere) or sum(elsewhere) >= 2 else DriftCause.UNKNOWN


def camera_px_per_pixel(part: ProjectorCalibration) -> float:
    """How many camera pixels lie between two neighbouring pixels of a projector, in the median."""
    apart = np.hypot(*np.moveaxis(np.diff(part.metapixels.centre_px, axis=1), -1, 0))
    apart = apart[np.isfinite(apart)]
    return float(np.median(apart)) if apart.size else math.nan


def _projector(
    light: TransportModel, n: int, part: ProjectorCalibration, frame: FloatImage, seen: FloatImage
) -> ProjectorDrift:
    """Register one projector's picture in its own pixels; one that this view does not see is as it was."""
    if not light.lit[n].any():
        still = replace(no_motion(frame.shape, 3), found=True)
        return ProjectorDrift(part.name, still, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), 0.0, 1.0)
    use = light.lit[n] & finite(seen)
    white = np.where(use[:, :, None], part.white, 0).astype(np.float32)
    strength = light.gaussian_mean(white * white, n)
    faint = 1e-3 * float(np.percentile(strength, 99)) + 1e-30

    def on_projector(image: FloatImage) -> FloatImage:
        """What each pixel shows, as least squares over the camera pixels that it lights."""
        filled = np.where(use[:, :, None], image, 0).astype(np.float32)
        return np.asarray(light.gaussian_mean(filled * white, n) / np.maximum(strength, faint), np.float32)

    channels = []
    for k in range(3):
        alone = np.zeros_like(frame)
        alone[:, :, k] = frame[:, :, k]
        channels.append(on_projector(light.forward_part(n, alone)))
    picture, reference = on_projector(seen), np.asarray(np.sum(channels, axis=0), np.float32)
    level: FloatImage = smallest(strength)
    weight = np.clip(level / max(float(np.median(level[level > faint])) if np.any(level > faint) else 1.0, faint), 0, 1)
    weight = np.where(level > faint, weight, 0).astype(np.float32)
    share = float((weight[:, :, None] * picture).sum() / max(float((weight[:, :, None] * reference).sum()), 1e-30))
    motion = register(reference, picture, weight)
    if not motion.found or share < LEAST_LIGHT:
        nothing = (math.nan, math.nan, math.nan)
        motion = motion if share >= LEAST_LIGHT else no_motion(weight.shape, 3)
        return ProjectorDrift(part.name, motion, nothing, nothing, math.nan, share)
    there = [warp(channel, motion.matrix) for channel in channels]
    gain, sigma = _gains(there, picture, weight)
    fitted = np.einsum("krcx,k->rcx", np.stack(there), gain).astype(np.float32)
    local = _local_px(fitted, picture, weight)
    return ProjectorDrift(part.name, motion, _three(gain), _three(sigma), local, share)


def _gains(channels: Sequence[FloatImage], seen: FloatImage, weight: FloatImage) -> tuple[Float64, Float64]:
    """Least squares for the strength of each of the projector's channels, and its uncertainty from parts that differ.

    Means of small parts are compared: pixel by pixel, a picture that is a little softer than predicted would count as
    less light. ``channels``: what each looks like alone; an outer frame of NaN is left out.
    """
    rows, columns = weight.shape
    known = (weight > 0) & np.isfinite(np.stack(channels)).all(axis=(0, 3)) & finite(seen)
    y, x = np.nonzero(known)
    part, of = np.unique(y // PART_PX * columns + x // PART_PX, return_inverse=True)
    w = np.bincount(of, weight[known])

    def means(image: FloatImage) -> Float64:
        return np.stack([np.bincount(of, weight[known] * image[known][:, c]) / w for c in range(3)], axis=1)

    a, b = np.stack([means(channel) for channel in channels]), means(seen)
    block = part // columns * PART_PX * 6 // rows * 6 + part % columns * PART_PX * 6 // columns
    gain, inverse = np.ones(3), np.eye(3)
    for _ in range(4):
        error = b - np.einsum("knc,k->nc", a, gain)
        spread = 1.4826 * np.median(np.abs(error)) + 1e-12
        robust = w[:, None] * np.maximum(1 - (error / (4 * spread)) ** 2, 0) ** 2
        inverse = np.linalg.pinv(np.einsum("knc,lnc,nc->kl", a, a, robust), hermitian=True)
        gain = inverse @ np.einsum("knc,nc,nc->k", a, robust, b)
    error = b - np.einsum("knc,k->nc", a, gain)
    scores = np.stack([np.bincount(block, (one * robust * error).sum(axis=1), 36) for one in a], axis=1)
    return gain, np.sqrt(np.maximum(np.diag(inverse @ (scores.T @ scores) @ inverse), 0))


def _local_px(fitted: FloatImage, seen: FloatImage, weight: FloatImage) -> float:
    """The rms, over parts of the picture, of the shift that they still ask for (Lucas and Kanade 1981)."""
    known = (weight > 0) & finite(fitted) & finite(seen)
    known &= cv2.erode(known.astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=0) > 0
    if not known.any():
        return math.nan
    blur = [cv2.GaussianBlur(np.where(known[:, :, None], image, 0).astype(np.float32), (0, 0), 1.0)
            for image in (fitted, seen)]  # fmt: skip
    w = np.where(known, weight, 0)[:, :, None]
    dx, dy = (np.gradient(blur[0], axis=axis) for axis in (1, 0))
    error = blur[1] - blur[0]
    size = (max(16, weight.shape[1] // 8), max(16, weight.shape[0] // 8))

    def around(image: FloatImage) -> FloatImage:
        return np.asarray(cv2.boxFilter(total(w * image), -1, size), np.float32)

    xx, xy, yy, ex, ey = (around(image) for image in (dx * dx, dx * dy, dy * dy, dx * error, dy * error))
    det = xx * yy - xy * xy
    enough = known & (det > 0.05 * np.percentile(det[known], 50))
    across = (yy * ex - xy * ey)[enough] / det[enough]
    down = (xx * ey - xy * ex)[enough] / det[enough]
    return float(np.sqrt(np.mean(np.minimum(across**2 + down**2, 100.0))))


def _camera(calibration: Calibration, found: Sequence[ProjectorDrift], seen: DriftPhotographs) -> Motion:
    """Register the object's picture in full light: its paint and its outline."""
    expected = calibration.black.astype(np.float32)
    for part, one in zip(calibration.projectors, found, strict=True):
        tint = part.radiometry.mixing @ np.asarray(one.gain) if one.known else np.full(3, max(one.light_share, 0.0))
        expected = expected + (part.white * tint).astype(np.float32)
    rows, columns = expected.shape[:2]
    factor = max(1, math.ceil(math.sqrt(rows * columns / CAMERA_PIXELS)))
    near = cv2.dilate(calibration.object_mask.astype(np.uint8), np.ones((15, 15), np.uint8)) > 0
    known = near & finite(seen.white)
    pictures = [np.where(known[:, :, None], image, 0).astype(np.float32) for image in (expected, seen.white)]
    inside = _shrunk(known.astype(np.float32), factor) > 0.99
    motion = register(_shrunk(pictures[0], factor), _shrunk(pictures[1], factor), inside.astype(np.float32))
    return motion if factor == 1 else _enlarged(motion, factor)


def _backwards(motion: Motion) -> Motion:
    """How the object's picture moved, from where in the calibration's picture a pixel now looks."""
    if not motion.found:
        return motion
    matrix = np.linalg.inv(motion.matrix)
    x, y = motion.shift_px
    return dataclasses.replace(
        motion, matrix=matrix / matrix[2, 2], shift_px=(-x, -y), rotation_deg=-motion.rotation_deg,
        scale=1 / motion.scale,
    )  # fmt: skip


def _shrunk(image: FloatImage, factor: int) -> FloatImage:
    rows, columns = (length // factor for length in image.shape[:2])
    cropped = image[: rows * factor, : columns * factor]
    return np.asarray(cv2.resize(cropped, (columns, rows), interpolation=cv2.INTER_AREA), np.float32)


def _enlarged(motion: Motion, factor: int) -> Motion:
    """The same motion in the pixels of the camera, whose centres lie elsewhere in a shrunk picture."""
    up = np.array([[factor, 0, (factor - 1) / 2], [0, factor, (factor - 1) / 2], [0, 0, 1.0]])
    return Motion(
        up @ motion.matrix @ np.linalg.inv(up),
        (factor * motion.middle_px[0] + up[0, 2], factor * motion.middle_px[1] + up[1, 2]),
        (factor * motion.shift_px[0], factor * motion.shift_px[1]),
        factor * motion.sigma_px, factor * motion.rms_px, motion.rotation_deg, motion.rotation_sigma_deg,
        motion.scale, motion.scale_sigma, motion.gain, motion.correlation, motion.found,
    )  # fmt: skip


def _ambient(calibration: Calibration, seen: DriftPhotographs) -> tuple[float, float]:
    use = calibration.object_mask & finite(seen.black)
    if not use.any():
        return math.nan, math.nan
    white = sum(float(part.white[use].mean(dtype=np.float64)) for part in calibration.projectors)
    now, then = (float(image[use].mean(dtype=np.float64)) for image in (seen.black, calibration.black))
    return (now - then) / max(white, 1e-30), now / max(then, 1e-30)


def _three(values: Float64) -> tuple[float, float, float]:
    a, b, c = (float(value) for value in values)
    return (a, b, c)


ON_PROJECTOR: Final = ("projector_px", "shown_px")
"""Arrays with positions on the projector: the correspondences, and the phase map of the light transport."""
Arrays = Mapping[str, npt.NDArray[Any]]


def update_positions(arrays: Arrays, matrix: Float64) -> dict[str, npt.NDArray[Any]]:
    """Correspondences and metapixels, as a run keeps them, of a projector whose picture moved by a homography.

    Parameters
    ----------
    arrays : ``ON_PROJECTOR`` (camera rows, columns, 2) are mapped, and whatever is kept by projector pixel (the shape
        of ``centre_px``) is taken from where that pixel's light fell before; the rest stays as it is
    matrix : (3, 3), as ``registration.Motion.matrix``: from where a point lay in the projector's image to where it lies
    """
    rows, columns = arrays["centre_px"].shape[:2]
    back = np.linalg.inv(matrix)
    x, y = np.meshgrid(np.arange(columns, dtype=np.float64), np.arange(rows, dtype=np.float64))
    before = _mapped(np.asarray(back, np.float64), np.stack([x, y], axis=2))
    updated = {}
    for name, array in arrays.items():
        if name in ON_PROJECTOR:
            updated[name] = _mapped(matrix, array.astype(np.float64)).astype(array.dtype)
        elif array.shape[:2] == (rows, columns):
            updated[name] = _taken(array, before, extend=name == "centre_px")
        else:
            updated[name] = array
    if "valid" in updated:
        known = channels.finite(updated["centre_px"])
        updated["valid"] = updated["valid"] & known
    return updated


def _mapped(matrix: Float64, at: Float64) -> Float64:
    below = at @ matrix[2, :2] + matrix[2, 2]
    return np.stack([(at @ matrix[row, :2] + matrix[row, 2]) / below for row in (0, 1)], axis=-1)


def _taken(array: npt.NDArray[Any], at: Float64, *, extend: bool) -> npt.NDArray[Any]:
    """``array`` at places (rows, columns, 2); beyond its border the border's, or its straight continuation."""
    rows, columns = array.shape[:2]
    inside = np.clip(at, 0, [columns - 1, rows - 1])
    if array.dtype == np.bool_:
        column, row = (np.rint(inside[:, :, axis]).astype(np.int64) for axis in (0, 1))
        return np.asarray(array[row, column])
    image = np.asarray(array, np.float32)
    taken = _sampled(image, inside)
    if extend:
        # Slopes two pixels off the border: at it, they may be cut short.
        inner = np.clip(at, 2, [columns - 3, rows - 3])
        for axis, beyond in ((1, at[:, :, 0] - inside[:, :, 0]), (0, at[:, :, 1] - inside[:, :, 1])):
            slope = _sampled(np.asarray(np.gradient(image, axis=axis), np.float32), inner)
            taken += np.where(beyond[:, :, None] != 0, slope * beyond[:, :, None], 0).astype(np.float32)
    return taken.astype(array.dtype)


def _sampled(image: FloatImage, at: Float64) -> FloatImage:
    # OpenCV would round the places to a 32nd of a pixel, which is too coarse for centres.
    from scipy.ndimage import map_coordinates

    places = [at[:, :, 1], at[:, :, 0]]
    channels = [map_coordinates(image[:, :, c], places, order=1, mode="nearest") for c in range(image.shape[2])]
    return np.stack(channels, axis=2).astype(np.float32)


def update_radiometry(radiometry: Radiometry, gain: tuple[float, float, float]) -> Radiometry:
    """The radiometry of a projector whose channels have changed in strength; the white image has to follow.

    White light of camera channel c is now sum_k mixing[c, k] gain[k] times what it was.
    """
    mixing, paint = radiometry.mixing * np.asarray(gain), radiometry.paint
    if paint is not None:
        paint = paint * np.asarray(gain)[:, None]
        # White has changed, too, and paint is determined by it.
        paint = paint @ np.linalg.inv(paint.sum(axis=1))
    return replace(radiometry, mixing=mixing / mixing.sum(axis=1, keepdims=True), paint=paint)


def update_white(white: FloatImage, again: FloatImage, sigma: FloatImage) -> FloatImage:
    """A projector's white image after its light has changed, (rows, columns, 3), NaN where saturated.

    ``white`` is a mean of many photographs, ``again`` one photograph of the changed light; ``sigma``: the standard
    deviation of its noise. Where noise explains the difference from ``white`` with the change around, that is the
    better picture. What has moved, such as shadows and gaps between pixels, is that of ``again``.
    """
    known = (finite(white) & finite(again) & finite(sigma))[:, :, None]
    images = [np.where(known, image, 0).astype(np.float32) for image in (white, again, sigma)]
    around = [cv2.GaussianBlur(image, (0, 0), CHANGE_PX) for image in images[:2]]
    changed = images[0] * np.divide(around[1], around[0], out=np.ones_like(around[0]), where=around[0] > 0)
    apart = images[1] - changed
    off, noise = (cv2.boxFilter(total(one * one), -1, NOISE_AROUND) for one in (apart, images[2]))
    share = 1 - np.divide(noise, off, out=np.ones_like(off), where=off > noise)
    return np.where(known, changed + share[:, :, None] * apart, again).astype(np.float32)
