"""The light transport from pairs: pictures that projectors showed, and what the camera saw of them.

Data sets of learned methods have such pairs of any pictures, without a code. Each camera pixel sees a small window of
each projector's picture. The windows are found from coarse to fine: first the projectors' pictures have so few blocks
that a ridge regression has several pairs for each; then blocks are halved, and those around the last place are weighed
again, by bounded least squares over all pairs. Colours follow from regressions of each camera pixel, and their mixing
is that of all pixels together. Every fifth pair is left out, and tells what the result is worth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from controller.core.arrays import Float64, FloatImage
from controller.core.errors import UsageError

SIDE: Final = 5
"""Blocks and, at last, pixels of a window."""
LEAST_EXPLAINED: Final = 0.5
"""A camera pixel whose changes in the pairs that were left out are explained less well has no light of projectors."""
RIDGE: Final = 1e-3
SWEEPS: Final = 60
EVERY: Final = 5
AT_ONCE: Final = 64
"""Camera pixels."""
FEWEST_PAIRS: Final = 4
"""For each block of the windows of a camera pixel."""


@dataclass(frozen=True, slots=True)
class PairFit:
    """A transport for each projector n: light = black + sum of whites[n] (shares[n] @ (frame mixing[n]')).

    ``shares``: (camera pixels, projector pixels), rows add up to 1 or are empty; ``whites`` (projectors, camera pixels,
    3) and ``black`` (camera pixels, 3) float32; ``mixing`` (projectors, 3, 3); ``explained`` (camera pixels,): of the
    changes of light in the pairs that were left out, at most 1; ``error``: rms of all lit pixels there, by their light
    """

    shares: tuple[sp.csr_array[np.float32], ...]
    whites: FloatImage
    mixing: Float64
    black: FloatImage
    explained: Float64
    error: float


def fit_pairs(frames: Sequence[FloatImage], light: FloatImage) -> PairFit:
    """Fit a transport to N pairs.

    ``frames``: one (N, rows, columns, 3) a projector, linear light 0 to 1; ``light`` (N, camera pixels, 3), linear

    Raises UsageError("pairs-too-few", "pairs-undetermined").
    """
    count, least = len(light), FEWEST_PAIRS * len(frames) * SIDE * SIDE
    if count < least:
        raise UsageError(
            "pairs-too-few",
            what=f"{count} pairs can't determine the light of {len(frames)} projectors.",
            remedy=f"Take at least {least} pairs of pictures that differ everywhere.",
        )
    judged = np.arange(count) % EVERY == EVERY - 1
    learnt = [frame[~judged] for frame in frames]
    shares = _shares([frame.mean(axis=3) for frame in learnt], light[~judged].mean(axis=2))
    seen = _seen(shares, learnt)
    mean = light[~judged].mean(axis=0)
    parts = _weighed(seen - seen.mean(axis=1, keepdims=True), light[~judged] - mean)
    total = parts.reshape(*parts.shape[:2], len(frames), 3).sum(axis=0)
    mixing = (total / np.maximum(total.sum(axis=2, keepdims=True), 1e-12)).swapaxes(0, 1)
    whites = np.empty((len(frames), *mean.shape), np.float32)
    for c in range(3):
        mixed = _mixed(seen, mixing, c)
        changes = light[~judged][..., c : c + 1] - mean[:, c : c + 1]
        whites[..., c] = _weighed(mixed - mixed.mean(axis=1, keepdims=True), changes)[:, 0].T
        mean[:, c] -= np.einsum("nx,xn->x", whites[..., c], mixed.mean(axis=1))
    others = _seen(shares, [frame[judged] for frame in frames])
    predicted = np.stack([np.einsum("nx,xtn->tx", whites[..., c], _mixed(others, mixing, c)) for c in range(3)], axis=2)
    wanted = light[judged]
    misses = ((predicted + mean - wanted) ** 2).sum(axis=(0, 2), dtype=np.float64)
    explained = 1 - misses / np.maximum(((wanted - wanted.mean(axis=0)) ** 2).sum(axis=(0, 2)), 1e-30)
    lit = explained >= LEAST_EXPLAINED
    if not lit.any():
        raise UsageError(
            "pairs-undetermined",
            what="The photographs do not follow from the projected pictures at any camera pixel.",
            remedy="Check that files of one name belong together, that the camera stood still, and that pictures "
            "differ from pair to pair.",
        )
    error = float(np.sqrt(misses[lit].sum() / (wanted[:, lit].astype(np.float64) ** 2).sum()))
    whites[:, ~lit] = 0
    return PairFit(shares, whites, mixing, np.maximum(mean, 0).astype(np.float32), explained, error)


def _shares(grey: Sequence[FloatImage], light: FloatImage) -> tuple[sp.csr_array[np.float32], ...]:
    """The rows of each projector's shares; ``grey`` (N, rows, columns) each, ``light`` (N, camera pixels)."""
    light = light - light.mean(axis=0)
    level, blocks = 0, list(grey)
    pyramid = [blocks]
    while sum(one[0].size for one in blocks) * 2 > len(light):
        level, blocks = level + 1, [_halved(one) for one in blocks]
        pyramid.append(blocks)
    flat = np.concatenate([one.reshape(len(one), -1) for one in blocks], axis=1).astype(np.float64)
    flat -= flat.mean(axis=0)
    gram = flat.T @ flat
    found = np.linalg.solve(gram + RIDGE * np.trace(gram) * np.eye(len(gram)), flat.T @ light)
    places, start = [], 0
    for one in blocks:
        rows, columns = one.shape[1:]
        best = found[start : start + rows * columns].argmax(axis=0)
        places.append(np.stack(np.divmod(best, columns), axis=1).astype(np.float64))
        start += rows * columns
    for blocks in reversed(pyramid):
        at = [_window(place, one.shape[1:]) for place, one in zip(places, blocks, strict=True)]
        weights = _weighed_windows([_flat(one) for one in blocks], at, light)
        places = [2 * _middle(w, k, one.shape[2]) + 0.5 for w, k, one in zip(weights, at, blocks, strict=True)]
    made: list[Any] = []
    for w, k, one in zip(weights, at, grey, strict=True):
        rows_of = np.repeat(np.arange(len(k)), k.shape[1])
        part = w / np.maximum(w.sum(axis=1, keepdims=True), 1e-12)
        size = len(k), int(one[0].size)
        matrix: Any = sp.coo_array((part.astype(np.float32).ravel(), (rows_of, k.ravel())), shape=size).tocsr()
        matrix.eliminate_zeros()
        made.append(matrix)
    return tuple(made)


def _halved(pictures: FloatImage) -> FloatImage:
    """Means of 2 x 2, the last row and column twice where their number is odd."""
    rows, columns = pictures.shape[1:]
    even = np.pad(pictures, ((0, 0), (0, rows % 2), (0, columns % 2)), mode="edge")
    return np.asarray(even.reshape(len(even), (rows + 1) // 2, 2, (columns + 1) // 2, 2).mean(axis=(2, 4)))


def _flat(pictures: FloatImage) -> FloatImage:
    """(blocks, N), less the mean of each."""
    flat = pictures.reshape(len(pictures), -1).T
    return np.ascontiguousarray(flat - flat.mean(axis=1, keepdims=True), np.float32)


def _window(place: Float64, shape: tuple[int, ...]) -> npt.NDArray[np.int64]:
    """(camera pixels, blocks) indices of the blocks around ``place`` (camera pixels, 2), moved inside the picture."""
    sides = [min(SIDE, size) for size in shape]
    first = [np.clip(np.rint(place[:, k]).astype(np.int64) - sides[k] // 2, 0, shape[k] - sides[k]) for k in (0, 1)]
    row, column = (first[k][:, None] + np.arange(sides[k]) for k in (0, 1))
    return np.asarray((row[:, :, None] * shape[1] + column[:, None]).reshape(len(place), -1))


def _middle(weights: FloatImage, at: npt.NDArray[np.int64], columns: int) -> Float64:
    """(camera pixels, 2): row and column of the weights' centre; of the window's where there is none."""
    part = weights + 1e-9
    where = np.stack(np.divmod(at, columns), axis=2)
    return np.asarray((part[..., None] * where).sum(axis=1) / part.sum(axis=1)[:, None])


def _weighed_windows(
    flat: Sequence[FloatImage], at: Sequence[npt.NDArray[np.int64]], light: FloatImage
) -> list[FloatImage]:
    """(camera pixels, blocks) weights of each projector's blocks ``at``, all projectors together."""
    ends = np.cumsum([k.shape[1] for k in at])[:-1]
    parts = []
    for start in range(0, light.shape[1], AT_ONCE):
        some = slice(start, start + AT_ONCE)
        seen = np.concatenate([one[k[some]] for one, k in zip(flat, at, strict=True)], axis=1).swapaxes(1, 2)
        parts.append(_weighed(seen, light[:, some, None])[:, 0])
    return np.split(np.concatenate(parts), ends, axis=1)


def _weighed(seen: FloatImage, light: FloatImage) -> FloatImage:
    """(X, C, K) weights, at least 0, with which ``seen`` (X, N, K) makes ``light`` (N, X, C); by coordinate descent."""
    seen = seen.astype(np.float32)
    gram = seen.swapaxes(1, 2) @ seen
    diagonal = np.einsum("xkk->xk", gram)
    diagonal += np.maximum(RIDGE * diagonal.mean(axis=1, keepdims=True), 1e-12)
    data = np.ascontiguousarray(light.transpose(1, 2, 0), np.float32) @ seen
    weights = np.zeros_like(data)
    for _ in range(SWEEPS):
        for k in range(data.shape[2]):
            step = data[..., k] - (weights @ gram[:, k, :, None])[..., 0]
            weights[..., k] = np.maximum(weights[..., k] + step / diagonal[:, None, k], 0)
    return weights


def _seen(shares: Sequence[sp.csr_array[np.float32]], frames: Sequence[FloatImage]) -> FloatImage:
    """(camera pixels, N, projectors x 3): the light of each projector's channels in each camera pixel's window."""
    parts = [
        np.stack([share @ frame[..., k].reshape(len(frame), -1).T for k in range(3)], axis=2)
        for share, frame in zip(shares, frames, strict=True)
    ]
    return np.concatenate(parts, axis=2)


def _mixed(seen: FloatImage, mixing: Float64, c: int) -> FloatImage:
    """(camera pixels, N, projectors): the light for camera channel ``c``."""
    parts = seen.reshape(*seen.shape[:2], -1, 3)
    return np.asarray(np.einsum("xtnk,nk->xtn", parts, mixing[:, c]), np.float32)
