"""How far a picture has moved against another: a homography with its uncertainty, found from the pictures alone.

A projector or camera that turns about its lens changes its picture by a homography, whatever the object's shape.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from controller.core import channels
from controller.core.arrays import Float64, FloatImage

BLURS_PX = (4.0, 1.5, 0.8)
"""The last is smooth enough for linear interpolation; OpenCV's cubic one shifts pictures by up to 0.05 px."""
ROUNDS = 12
SEARCH_SHARE = 0.2
"""The first estimate searches for shifts up to this share of the picture's sides."""
LEAST_CORRELATION = 0.6
"""Below it two pictures do not show the same thing, or are too noisy to measure a motion."""
OUTLIER_SIGMAS = 4.0
BLOCKS = 8
"""The uncertainty is estimated from the differences between this many by this many parts of the picture."""
LEAST_BLOCKS = 4
LEAST_PIXELS = 100
MOST_PIXELS = 120_000
"""More of them would hardly be more precise: the model's error remains."""
MAP_WIDTH = 16_000
"""OpenCV takes maps of limited width only."""


@dataclass(frozen=True, slots=True)
class Motion:
    """``seen(v) = gain * reference(H v)``, fitted over all pixels of some weight.

    ``matrix`` (3, 3) H on (x, y, 1), H[2, 2] = 1; ``middle_px`` where the following hold: the weights' centre
    ``shift_px`` (x, y) of that place, with ``sigma_px``; ``rms_px`` how far pixels moved, in the rms over the picture
    ``rotation_deg`` from x to y, ``scale`` 1 where it kept its size; both at ``middle_px``, with their sigmas
    ``gain`` of each channel; ``correlation`` of the registered pictures; ``found`` False: no motion could be measured
    """

    matrix: Float64
    middle_px: tuple[float, float]
    shift_px: tuple[float, float]
    sigma_px: float
    rms_px: float
    rotation_deg: float
    rotation_sigma_deg: float
    scale: float
    scale_sigma: float
    gain: tuple[float, ...]
    correlation: float
    found: bool

    def moved(self, least_px: float) -> bool:
        """Whether pixels moved by more than ``least_px`` and more than chance explains."""
        return self.found and self.rms_px > max(least_px, 3 * self.sigma_px)


def register(reference: FloatImage, seen: FloatImage, weight: FloatImage) -> Motion:
    """Find the homography by which ``seen`` lies elsewhere than ``reference``.

    Parameters
    ----------
    reference, seen : (rows, columns, channels) float32; where ``weight`` is 0 anything, NaN included
    weight : (rows, columns) float32, >= 0: how well a pixel of both is known

    Returns
    -------
    Motion, with ``found`` False where less than a percent of the picture is known or nothing fits
    """
    known = (weight > 0) & channels.finite(reference) & channels.finite(seen)
    if np.count_nonzero(known) < max(400, weight.size // 100):
        return no_motion(weight.shape, reference.shape[2])
    weight = np.where(known, weight / weight[known].max(), 0).astype(np.float32)
    reference = np.where(known[:, :, None], reference, 0).astype(np.float32)
    seen = np.where(known[:, :, None], seen, 0).astype(np.float32)
    frame = _Frame(weight)
    start = _first_shift(reference, seen, weight)
    parameters = np.zeros(8)
    parameters[[2, 5]] = start / frame.half
    for blur_px in BLURS_PX:
        parameters, fit = _descend(_Blurred(reference, seen, weight, blur_px), frame, parameters)
    return _motion(frame, parameters, fit, reference.shape[2])


def warp(image: FloatImage, matrix: Float64) -> FloatImage:
    """``image(H v)`` at each pixel v; NaN beyond its border. (rows, columns[, channels]) float32."""
    rows, columns = image.shape[:2]
    y, x = np.mgrid[0:rows, 0:columns].astype(np.float64)
    at = _mapped(matrix, x, y)
    return np.asarray(
        cv2.remap(
            np.asarray(image, np.float32), at[0].astype(np.float32), at[1].astype(np.float32), cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT, borderValue=(math.nan,) * 4,
        ),
        np.float32,
    )  # fmt: skip


def _mapped(matrix: Float64, x: Float64, y: Float64) -> Float64:
    """(2, ...): H (x, y, 1)."""
    below = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2]
    above = [matrix[row, 0] * x + matrix[row, 1] * y + matrix[row, 2] for row in (0, 1)]
    return np.stack([above[0] / below, above[1] / below])


class _Frame:
    """Coordinates about the weights' centre in units of the picture's half diagonal, in which all terms weigh alike."""

    def __init__(self, weight: FloatImage) -> None:
        rows, columns = weight.shape
        self.shape = (rows, columns)
        total = float(weight.sum(dtype=np.float64))
        y, x = np.arange(rows), np.arange(columns)
        self.middle = np.array([float(weight.sum(axis=0) @ x) / total, float(weight.sum(axis=1) @ y) / total])
        self.half = 0.5 * math.hypot(rows, columns)
        self.weight = weight

    def matrix(self, p: Float64) -> Float64:
        """H in pixels."""
        to = np.array([[1 / self.half, 0, -self.middle[0] / self.half], [0, 1 / self.half, -self.middle[1] / self.half],
                       [0, 0, 1]])  # fmt: skip
        scaled = np.linalg.inv(to) @ _small(p) @ to
        return np.asarray(scaled / scaled[2, 2])


def _small(p: Float64) -> Float64:
    return np.array([[1 + p[0], p[1], p[2]], [p[3], 1 + p[4], p[5]], [p[6], p[7], 1.0]])


class _Blurred:
    """Both pictures at one blur, with the reference's gradients."""

    def __init__(self, reference: FloatImage, seen: FloatImage, weight: FloatImage, blur_px: float) -> None:
        self.blur_px = blur_px
        self.reference, self.seen = (_smooth(image, weight, blur_px) for image in (reference, seen))
        self.dx, self.dy = _slope(self.reference, 1, 0), _slope(self.reference, 0, 1)
        inside = cv2.erode((weight > 0).astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0)
        self.inside = np.where(inside > 0, weight, 0).astype(np.float32)


def _slope(image: FloatImage, across: int, down: int) -> FloatImage:
    return np.stack([cv2.Scharr(c, cv2.CV_32F, across, down) / 32 for c in cv2.split(image)], axis=2).astype(np.float32)


def _smooth(image: FloatImage, weight: FloatImage, blur_px: float) -> FloatImage:
    if blur_px == 0:
        return image
    known = (weight > 0).astype(np.float32)
    share = cv2.GaussianBlur(known, (0, 0), blur_px)[:, :, None]
    blurred = cv2.GaussianBlur(image * known[:, :, None], (0, 0), blur_px).reshape(image.shape)
    return np.asarray(blurred / np.maximum(share, 1e-6), np.float32)


@dataclass(slots=True)
class _HomographyFit:
    gain: Float64
    covariance: Float64
    correlation: float


def _descend(pair: _Blurred, frame: _Frame, p: Float64) -> tuple[Float64, _HomographyFit]:
    """Gauss and Newton, with gains solved along and outliers left out."""
    fit = _HomographyFit(np.ones(pair.seen.shape[2]), np.full((8, 8), np.nan), 0.0)
    for _ in range(ROUNDS):
        step, fit = _step(pair, frame, p)
        if not np.isfinite(step).all():
            return p, _HomographyFit(fit.gain, fit.covariance, 0.0)
        p = p + step
        if np.abs(step).max() * frame.half < 2e-3 * max(1.0, 5 * pair.blur_px - 5):
            break
    return p, fit


def _step(pair: _Blurred, frame: _Frame, p: Float64) -> tuple[Float64, _HomographyFit]:
    rows, columns = frame.shape
    flat = np.flatnonzero(pair.inside.ravel() > 0)
    flat = flat[:: max(1, math.ceil(flat.size / MOST_PIXELS))]
    x, y = (flat % columns).astype(np.float64), (flat // columns).astype(np.float64)
    at = _mapped(frame.matrix(p), x, y)
    w: Float64 = np.asarray(pair.inside.ravel()[flat] * _sampled(pair.inside, at, cv2.INTER_NEAREST)[:, 0], np.float64)
    modelled = _sampled(pair.reference, at, cv2.INTER_LINEAR)
    seen = np.asarray(pair.seen.reshape(-1, pair.seen.shape[2])[flat], np.float64)
    if np.count_nonzero(w) < LEAST_PIXELS:
        return np.full(8, np.nan), _HomographyFit(np.ones(modelled.shape[1]), np.full((8, 8), np.nan), 0.0)
    gx, gy, tangents = _sampled(pair.dx, at, 1), _sampled(pair.dy, at, 1), _tangents(frame, p, x, y)
    # OpenCV rounds places to a 32nd of a pixel: the slopes say what that left out.
    left_out = at - np.rint(at * 32) / 32
    modelled += gx * left_out[0, :, None] + gy * left_out[1, :, None]
    gain: Float64 = (w @ (modelled * seen)) / np.maximum(w @ modelled**2, 1e-30)
    error = seen - gain * modelled
    spread = 1.4826 * np.median(np.abs(error[w > 0])) + 1e-9
    weight = w[:, None] * np.maximum(1 - (error / (OUTLIER_SIGMAS * spread)) ** 2, 0) ** 2
    block = (y * BLOCKS // rows).astype(np.int64) * BLOCKS + (x * BLOCKS // columns).astype(np.int64)
    normal, right = np.zeros((8, 8)), np.zeros((BLOCKS * BLOCKS, 8))
    for c in range(modelled.shape[1]):
        slope = gain[c] * frame.half * (gx[:, c] * tangents[0] + gy[:, c] * tangents[1])
        normal += (slope * weight[:, c]) @ slope.T
        score = slope * (weight[:, c] * error[:, c])
        right += np.stack([np.bincount(block, one, BLOCKS * BLOCKS) for one in score], axis=1)
    inverse: Float64 = np.asarray(np.linalg.pinv(normal, rcond=1e-10, hermitian=True), np.float64)
    return inverse @ right.sum(axis=0), _HomographyFit(
        gain, _disagreement(inverse, right), _correlation(gain * modelled, seen, w)
    )


def _sampled(image: FloatImage, at: Float64, flags: int) -> Float64:
    """(pixels, channels) of an image at (2, pixels) places."""
    here = at.astype(np.float32)
    parts = [
        cv2.remap(image, here[0, None, i : i + MAP_WIDTH], here[1, None, i : i + MAP_WIDTH], flags, borderValue=0)
        for i in range(0, here.shape[1], MAP_WIDTH)
    ]
    return np.asarray(np.concatenate(parts, axis=1)[0].reshape(here.shape[1], -1), np.float64)


def _disagreement(inverse: Float64, scores: Float64) -> Float64:
    """The parameters' covariance, from how the parts of the picture differ in what they ask for.

    ``inverse`` (8, 8) of the normal equations, ``scores`` (parts, 8) their right-hand sides. Unlike the residual's, it
    takes neighbouring pixels, and errors of the model, for what they are.
    """
    used = np.any(scores != 0, axis=1)
    count = int(np.count_nonzero(used))
    if count < LEAST_BLOCKS:
        return np.full((8, 8), np.inf)
    apart = scores[used] - scores[used].mean(axis=0)
    return np.asarray(inverse @ (apart.T @ apart) @ inverse * count / (count - 1))


def _correlation(a: Float64, b: Float64, w: Float64) -> float:
    total = w.sum()
    a, b = a - (w @ a) / total, b - (w @ b) / total
    return float((w @ (a * b)).sum() / math.sqrt(max((w @ a**2).sum() * (w @ b**2).sum(), 1e-30)))


def _tangents(frame: _Frame, p: Float64, x: Float64, y: Float64) -> tuple[Float64, Float64]:
    """(8, pixels) each: how the parameters move x and y, in half diagonals."""
    u, v = (x - frame.middle[0]) / frame.half, (y - frame.middle[1]) / frame.half
    h = _small(p)
    below = h[2, 0] * u + h[2, 1] * v + 1
    to = _mapped(h, u, v)
    zero, one = np.zeros_like(u), np.ones_like(u)
    across = np.stack([u, v, one, zero, zero, zero, -u * to[0], -v * to[0]]) / below
    down = np.stack([zero, zero, zero, u, v, one, -u * to[1], -v * to[1]]) / below
    return across, down


def _first_shift(reference: FloatImage, seen: FloatImage, weight: FloatImage) -> Float64:
    """The whole-pixel shift with the best correlation over the pixels that both then know (Padfield 2012)."""
    rows, columns = weight.shape
    mean = [np.log1p(np.maximum(channels.mean(image), 0)) for image in (reference, seen)]
    known = (weight > 0).astype(np.float32)
    high = [np.where(known > 0, image - _smooth(image[:, :, None], weight, 12.0)[:, :, 0], 0) for image in mean]
    size = (cv2.getOptimalDFTSize(rows + rows // 2), cv2.getOptimalDFTSize(columns + columns // 2))
    (r, s, m, r2, s2) = (np.fft.rfft2(image, size) for image in (high[0], high[1], known, high[0] ** 2, high[1] ** 2))

    def against(a: np.ndarray[tuple[int, ...], np.dtype[np.complex128]],
                b: np.ndarray[tuple[int, ...], np.dtype[np.complex128]]) -> Float64:  # fmt: skip
        return np.asarray(np.fft.irfft2(np.conj(b) * a, size), np.float64)

    overlap = against(m, m)
    score = against(r, s) / np.sqrt(
        np.maximum(against(r2, m) * against(m, s2), 1e-12 * float((high[0] ** 2).sum()) ** 2)
    )
    dy = np.minimum(np.arange(size[0]), size[0] - np.arange(size[0]))[:, None]
    dx = np.minimum(np.arange(size[1]), size[1] - np.arange(size[1]))[None, :]
    possible = (overlap > 0.3 * overlap[0, 0]) & (dy <= SEARCH_SHARE * rows) & (dx <= SEARCH_SHARE * columns)
    best = np.unravel_index(int(np.argmax(np.where(possible, score, -1))), size)
    shift = [int(b) if b <= n // 2 else int(b) - n for b, n in zip(best, size, strict=True)]
    return np.array([shift[1], shift[0]], np.float64)


def _motion(frame: _Frame, p: Float64, fit: _HomographyFit, channels: int) -> Motion:
    if not (fit.correlation > LEAST_CORRELATION and np.isfinite(fit.covariance).all()):
        return no_motion(frame.shape, channels, correlation=fit.correlation)
    rows, columns = np.nonzero(frame.weight)
    matrix = frame.matrix(p)
    some = slice(None, None, max(1, rows.size // 20_000))
    x, y = columns[some].astype(np.float64), rows[some].astype(np.float64)
    to = _mapped(matrix, x, y)
    sigma = np.sqrt(np.maximum(np.diag(fit.covariance), 0))
    return Motion(
        matrix=matrix,
        middle_px=(float(frame.middle[0]), float(frame.middle[1])),
        shift_px=(float(p[2] * frame.half), float(p[5] * frame.half)),
        sigma_px=float(np.hypot(sigma[2], sigma[5]) * frame.half),
        rms_px=float(np.sqrt(np.mean((to[0] - x) ** 2 + (to[1] - y) ** 2))),
        rotation_deg=math.degrees(0.5 * (p[3] - p[1])),
        rotation_sigma_deg=math.degrees(0.5 * math.hypot(sigma[1], sigma[3])),
        scale=float(1 + 0.5 * (p[0] + p[4])),
        scale_sigma=float(0.5 * math.hypot(sigma[0], sigma[4])),
        gain=tuple(float(g) for g in fit.gain),
        correlation=fit.correlation,
        found=True,
    )


def no_motion(shape: tuple[int, ...], channels: int, correlation: float = 0.0) -> Motion:
    """The result for a picture of that shape where no motion could be measured."""
    middle = (0.5 * (shape[1] - 1), 0.5 * (shape[0] - 1))
    nan = math.nan
    return Motion(np.eye(3), middle, (nan, nan), nan, nan, nan, nan, nan, nan, (nan,) * channels, correlation, False)
