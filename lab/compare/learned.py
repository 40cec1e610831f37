"""Learned methods: from pairs of a projected picture and its photograph, what to project for a wanted photograph.

``regression`` is a small one of our own, to show the interface and as the least that a larger one must beat. It
knows the pairs and nothing else of the stage.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import cv2
import numpy as np

from controller.core.arrays import ByteImage, Float64, FloatImage
from controller.core.errors import WorkError
from lab.compare.api import ComparisonMethod, ComparisonStage, ComparisonTarget, MakeFrames

Pair = tuple[ByteImage, ByteImage]
"""(rows, columns, 3) uint8 each, red first, as a screen shows them: what was projected, what the camera saw."""


class Pairs(Protocol):
    """Pictures to learn from. Iterating may read files: each pass reads them again.

    ``projector_px``, ``camera_px``: (width, height) of all projected pictures, and of all photographs
    """

    @property
    def projector_px(self) -> tuple[int, int]: ...

    @property
    def camera_px(self) -> tuple[int, int]: ...

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[Pair]: ...


Answer = Callable[[ByteImage], ByteImage]
"""Of a wanted photograph, the picture to project."""
LearnedMethod = Callable[[Pairs], Answer]

Curve = Callable[[Float64], Float64]
"""From places in the projected pictures to places in the photographs, both from 0 to 1."""

COARSE_PX: Final = 48
"""Width to which both pictures are made smaller to find where the projector's pixels lie."""
LEAST_LIKE: Final = 0.3
"""Correlation of two pixels that may belong together."""
SEARCH_PX: Final = 3
"""Around a coarse place, in its pixels."""
FINE: Final = 4
"""Times finer, the places are looked for again."""
SMOOTH: Final = 5
"""Degree of the polynomial through the places."""
ROUNDS: Final = 6
FAR_MADS: Final = 4.0
RIDGE: Final = 1e-3
NEAR_PX: Final = 3
"""A pixel's regression learns from those so near to it, too."""
PICTURES: Final = 120
"""Shown and photographed by ``as_method``."""
GAMMA: Final = 2.2
FINEST: Final = 40
"""Blocks across a random picture."""


@dataclass(frozen=True, slots=True)
class KnownPairs:
    """``Pairs`` in memory."""

    pairs: Sequence[Pair]

    @property
    def projector_px(self) -> tuple[int, int]:
        rows, columns = self.pairs[0][0].shape[:2]
        return columns, rows

    @property
    def camera_px(self) -> tuple[int, int]:
        rows, columns = self.pairs[0][1].shape[:2]
        return columns, rows

    def __len__(self) -> int:
        return len(self.pairs)

    def __iter__(self) -> Iterator[Pair]:
        return iter(self.pairs)


def uncorrected(pairs: Pairs) -> Answer:
    """What is wanted, projected as it is: what every method must beat."""
    return lambda wanted: np.asarray(cv2.resize(wanted, pairs.projector_px, interpolation=cv2.INTER_AREA), np.uint8)


def regression(pairs: Pairs) -> Answer:
    """Where each projector pixel lies, by pictures that change alike; then a quadratic for each pixel."""
    places = _places(pairs)
    width, height = pairs.projector_px
    count = 10
    squares = np.zeros((height, width, count, count), np.float32)
    products = np.zeros((height, width, count, 3), np.float32)
    for projected, photographed in pairs:
        seen = _terms(_seen(photographed, places))
        squares += seen[..., :, None] * seen[..., None, :]
        products += seen[..., :, None] * (projected / np.float32(255))[..., None, :]
    side = (2 * NEAR_PX + 1,) * 2
    near = cv2.blur(squares.reshape(height, width, -1), side).reshape(squares.shape) / len(pairs)
    right = cv2.blur(products.reshape(height, width, -1), side).reshape(products.shape) / len(pairs)
    weights = np.linalg.solve(near + RIDGE * np.eye(count, dtype=np.float32), right)

    def answer(wanted: ByteImage) -> ByteImage:
        frame = np.einsum("yxi,yxic->yxc", _terms(_seen(wanted, places)), weights)
        return np.asarray(np.rint(255 * np.clip(frame, 0, 1)), np.uint8)

    return answer


def as_method(learn: LearnedMethod, pictures: int = PICTURES) -> ComparisonMethod:
    """A learned method for ``velatura compare``: it learns from photographs of the projector that lights the most.

    The other projectors stay black. ``pictures``: shown and photographed, of random blocks and waves
    """

    def method(stage: ComparisonStage) -> MakeFrames:
        def shown(n: int, picture: ByteImage) -> list[ByteImage]:
            frames = [np.zeros((height, width, 3), np.uint8) for width, height in stage.projectors_px]
            frames[n] = picture
            return frames

        whites = [np.full((height, width, 3), 255, np.uint8) for width, height in stage.projectors_px]
        lit = [float(stage.photograph(shown(n, white))[stage.object_mask].mean()) for n, white in enumerate(whites)]
        best = int(np.argmax(lit))
        rng = np.random.default_rng(11)
        rows, columns = whites[best].shape[:2]
        drawn = [_picture(rng, rows, columns) for _ in range(pictures)]
        answer = learn(KnownPairs([(one, _screen(stage.photograph(shown(best, one)), stage.white)) for one in drawn]))

        def frames(target: ComparisonTarget) -> list[ByteImage]:
            return shown(best, np.ascontiguousarray(answer(_screen(target.radiance, stage.white)), np.uint8))

        return frames

    method.__doc__ = learn.__doc__
    return method


def learned_regression(stage: ComparisonStage) -> MakeFrames:
    """One projector, learned: places and a quadratic for each pixel, from 120 photographs of random pictures."""
    return as_method(regression)(stage)


def _screen(light: FloatImage, white: float) -> ByteImage:
    return np.asarray(np.rint(255 * np.clip(light / white, 0, 1) ** (1 / GAMMA)), np.uint8)


def _picture(rng: np.random.Generator, rows: int, columns: int) -> ByteImage:
    """Blocks of random colours in three sizes, one above the other."""
    whole = np.zeros((rows, columns, 3), np.float32)
    for across in (4, 12, FINEST):
        blocks = rng.uniform(0, 255, (max(1, across * rows // columns), across, 3)).astype(np.float32)
        whole += (
            cv2.resize(blocks, (columns, rows), interpolation=cv2.INTER_CUBIC if across < 40 else cv2.INTER_NEAREST) / 3
        )
    spread = 127.5 + 1.8 * (whole - 127.5)
    return np.asarray(np.rint(np.clip(spread, 0, 255)), np.uint8)


def _seen(photographed: ByteImage, places: FloatImage) -> FloatImage:
    level, (x, y) = np.asarray(photographed / np.float32(255), np.float32), np.moveaxis(places, -1, 0)
    return np.asarray(cv2.remap(level, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)


def _terms(seen: FloatImage) -> FloatImage:
    """(rows, columns, 10): 1, the three channels, and their products."""
    r, g, b = np.moveaxis(seen, -1, 0)
    return np.stack([np.ones_like(r), r, g, b, r * r, g * g, b * b, r * g, r * b, g * b], axis=-1)


def _places(pairs: Pairs) -> FloatImage:
    """(rows, columns, 2) where each projector pixel lies in the photographs, x and y, on a smooth curve."""
    curve = _curve(*_coarse(pairs))
    curve = _curve(*_fine(pairs, curve))
    width, height = pairs.projector_px
    x, y = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    return np.asarray(curve(np.stack([x, y], axis=-1)) * pairs.camera_px - 0.5, np.float32)


def _coarse(pairs: Pairs) -> tuple[Float64, Float64, Float64]:
    """Places (N, 2) in projected pictures and in photographs, from 0 to 1, and how alike their colours change."""
    shown, seen = _changes(pairs, COARSE_PX)
    like = shown.reshape(len(shown), -1).T @ seen.reshape(len(seen), -1)
    best = like.argmax(axis=1)
    at, there = (_middles(one.shape[1:]).reshape(-1, 2) for one in (shown, seen))
    return at, there[best], like[np.arange(len(best)), best].astype(np.float64)


def _fine(pairs: Pairs, curve: Curve) -> tuple[Float64, Float64, Float64]:
    """As ``_coarse``, between the pixels of larger pictures, near to where ``curve`` has them."""
    shown, seen = _changes(pairs, FINE * COARSE_PX)
    rows, columns = seen.shape[1:]
    at = _middles(shown.shape[1:])[FINE // 2 :: FINE, FINE // 2 :: FINE].reshape(-1, 2)
    own = shown[:, FINE // 2 :: FINE, FINE // 2 :: FINE].reshape(len(shown), -1)
    x, y = np.rint(curve(at) * (columns, rows) - 0.5).astype(np.int64).T
    reach = SEARCH_PX * FINE // 2
    inside = (x > reach) & (x < columns - 1 - reach) & (y > reach) & (y < rows - 1 - reach)
    at, own, x, y = at[inside], own[:, inside], x[inside], y[inside]
    steps = np.arange(-reach, reach + 1)
    like = np.array([[(own * seen[:, y + dy, x + dx]).sum(axis=0) for dx in steps] for dy in steps])
    best = like.reshape(-1, len(x)).argmax(axis=0)
    row, column = np.divmod(best, len(steps))
    amid = (row > 0) & (row < 2 * reach) & (column > 0) & (column < 2 * reach)
    at, x, y, row, column = at[amid], x[amid], y[amid], row[amid], column[amid]
    n = np.flatnonzero(amid)
    most = like[row, column, n]
    right = _summit(like[row, column - 1, n], most, like[row, column + 1, n])
    down = _summit(like[row - 1, column, n], most, like[row + 1, column, n])
    there = np.stack([x + steps[column] + right, y + steps[row] + down], axis=-1)
    return at, (there + 0.5) / (columns, rows), most.astype(np.float64)


def _summit(before: FloatImage, most: FloatImage, after: FloatImage) -> FloatImage:
    """Where a parabola through three values is highest."""
    bend = before - 2 * most + after
    return np.asarray(np.divide(0.5 * (before - after), bend, out=np.zeros_like(most), where=bend < 0), np.float32)


def _changes(pairs: Pairs, width: int) -> tuple[FloatImage, FloatImage]:
    """(values, rows, columns) of both kinds of pictures, smaller; each pixel's without their mean, and of length 1."""

    def small(picture: ByteImage, size_px: tuple[int, int]) -> FloatImage:
        size = (width, max(1, round(width * size_px[1] / size_px[0])))
        return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.float32).transpose(2, 0, 1)

    both = [(small(one, pairs.projector_px), small(other, pairs.camera_px)) for one, other in pairs]
    found = []
    for stack in (np.array([one for one, _ in both]), np.array([other for _, other in both])):
        values = (stack - stack.mean(axis=0)).reshape(-1, *stack.shape[2:])
        found.append(values / np.maximum(np.linalg.norm(values, axis=0), 1e-6))
    return found[0], found[1]


def _middles(shape: tuple[int, ...]) -> Float64:
    """(rows, columns, 2): the middle of each pixel, from 0 to 1, x and y."""
    rows, columns = shape
    return np.stack(np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows), axis=-1)


def _curve(at: Float64, there: Float64, like: Float64) -> Curve:
    """The polynomial through places, without those that lie far from it."""
    powers = [(i, j) for i in range(SMOOTH + 1) for j in range(SMOOTH + 1 - i)]

    def terms(points: Float64) -> Float64:
        return np.stack([(points[..., 0] - 0.5) ** i * (points[..., 1] - 0.5) ** j for i, j in powers], axis=-1)

    use = like > LEAST_LIKE
    if np.count_nonzero(use) < 2 * len(powers):
        raise WorkError(
            "benchmark-pairs-unlike",
            what=f"Only {np.count_nonzero(use)} places of the photographs change as those of projected pictures.",
            remedy="Use more pairs, with more colours, of one projector that lights most of the picture.",
        )
    for _ in range(ROUNDS):
        weights = np.linalg.lstsq(terms(at[use]), there[use], rcond=None)[0]
        off = np.linalg.norm(terms(at) @ weights - there, axis=1)
        use = (like > LEAST_LIKE) & (off <= max(FAR_MADS * float(np.median(off[use])), 1e-4))
    return lambda points: np.asarray(terms(points) @ weights)
