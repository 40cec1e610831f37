"""What makes photographs of several appearances err alike, and how much of each cause there is.

To first order the model's error is a sum of known images, one for each cause, times its unknown amount: a projector
that became darker or whose response changed, light that comes back from the surroundings, light of the room, lost
focus. One appearance can't separate some of them; several can, by least squares. Each photograph leaves its normal
equations, which are few numbers, and those of all are added.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import cv2
import numpy as np

from controller.core.arrays import Float64, FloatImage, Mask
from controller.optics.solve.result.refinement import FLOOR, RefinedStage
from controller.optics.transport import LightTransport

Kind = Literal["brightness", "response", "indirect", "ambient", "focus"]

COLOURS: Final = ("red", "green", "blue")
FOCUS_PX: Final = 1.5
"""Camera pixels by which the image of lost focus is blurred; more loss than that counts as an amount above 1."""
STEP_PX: Final = 2
"""Every so many rows and columns are looked at: neighbours err alike."""
CORRELATED: Final = 25.0
"""Values looked at whose errors count as one: what no cause explains has patterns of its own."""
RIDGE: Final = 1e-6
"""Of a cause's own energy: keeps causes apart that no photograph distinguishes."""
SURE: Final = 4.0
"""Standard errors from which an amount is reported."""
LEAST: Final[dict[Kind, float]] = {
    "brightness": 0.02, "response": 0.015, "indirect": 0.01, "ambient": 0.01, "focus": 0.15,
}  # fmt: skip
"""Amounts from which a cause is reported: below, a calibration is as good as it gets."""
LEAST_SHARE: Final = 0.03
"""Of the squared error: what explains less is left out, since it may stand for something that no cause describes."""
FITS: Final = 0.85
"""Causes that explain this much of what more of them explain are enough: the others mop up what is not quite so."""
HALF: Final = 0.5
"""Of a cause's amount: a photograph that is sure of less denies it."""
MOSTLY: Final = 0.5
"""Of the squared error: where all causes explain less, something else is wrong, and none is named."""


@dataclass(frozen=True, slots=True)
class Cause:
    """One cause and its ``amount`` with ``sigma``, its standard error.

    "brightness": of ``projector`` in ``colour``, relative to the calibrated one; "response": its exponents, likewise;
    "indirect": share of all light that comes back evenly; "ambient": light of the room in ``colour``, of the light of
    all projectors; "focus": times a blur of ``FOCUS_PX``. 0 is as calibrated. ``share`` of the squared error that is
    explained by it and by nothing else
    """

    kind: Kind
    projector: int | None
    colour: str | None
    amount: float
    sigma: float
    share: float


@dataclass(frozen=True, slots=True)
class CommonCauses:
    """The causes that are sure and large enough to matter, and the ``share`` of the squared error that all explain."""

    causes: tuple[Cause, ...]
    share: float


def equations(
    transport: LightTransport, frames: Sequence[FloatImage], error: FloatImage, stage: RefinedStage, trusted: Mask
) -> Float64:
    """What one photograph says: (causes + 1, causes + 1) products of the causes' images and, last, of the ``error``.

    ``frames``: linear, as photographed; ``error`` (rows, columns, 3): the photograph less the prediction
    """
    at = np.zeros(trusted.shape, np.bool_)
    at[::STEP_PX, ::STEP_PX] = trusted[::STEP_PX, ::STEP_PX]
    # Of each image only what is looked at is kept: whole ones of all causes would be the most that a refinement needs.
    own: list[FloatImage] = []
    total: FloatImage | None = None
    for n, frame in enumerate(frames):
        part = transport.forward_part(n, frame)
        own.append(part[at])
        total = part if total is None else np.add(total, part, out=total)
    assert total is not None
    bent = [transport.forward_part(n, frame * np.log(np.maximum(frame, 1e-4)))[at] for n, frame in enumerate(frames)]
    object_light, object_white = (image[transport.object_mask].mean(axis=0) for image in (total, stage.white))
    surface = stage.white[at] / np.maximum(object_white, 1e-12)
    lost = cv2.GaussianBlur(total, (0, 0), FOCUS_PX)[at] - total[at]
    images = [image for part in own for image in _by_colour(part)]
    images += [*bent, surface * object_light, *_by_colour(surface * object_white), lost, error[at]]
    scale = np.maximum(total[at], 0) + FLOOR * stage.white[at] + 1e-6 * float(stage.white.max(initial=0))
    columns = np.stack([(image / scale).ravel() for image in images], axis=1).astype(np.float64)
    return np.asarray(np.vstack([columns.T @ columns, np.full(columns.shape[1], float(len(columns)))]))


def _by_colour(light: FloatImage) -> list[FloatImage]:
    """Light (..., 3) of each colour alone."""
    return [light * np.eye(3, dtype=np.float32)[c] for c in range(3)]


def common_causes(photographs: Sequence[Float64], projectors: int) -> CommonCauses:
    """What ``equations`` of several photographs say together.

    The fewest causes: the one that explains most is added until none explains ``LEAST_SHARE`` more, and what the others
    have made needless is taken out again, and so is what came after a few that fit. Each photograph by itself has to
    say that of a cause, too: darker, or brighter, and about as much.
    """
    summed = np.sum(photographs, axis=0)
    products, values = summed[:-1], float(summed[-1, 0])
    energy = max(float(products[-1, -1]), 1e-30)
    left = {group: _left(products, (group,), projectors) for group in _groups(projectors)}
    chosen: list[_Group] = []
    now = energy
    while left:
        best = min(left, key=lambda group: left[group])
        if now - left[best] < LEAST_SHARE * energy:
            break
        chosen.append(best)
        now = left[best]
        left = {group: _left(products, (*chosen, group), projectors) for group in left if group != best}
    explained = energy - now
    enough = (n for n in range(1, len(chosen)) if energy - _left(products, chosen[:n], projectors) > FITS * explained)
    del chosen[next(enough, len(chosen)) :]
    now = _left(products, chosen, projectors)
    for group in tuple(chosen):
        if _without(products, chosen, group, projectors) - now < LEAST_SHARE * energy:
            chosen.remove(group)
            now = _left(products, chosen, projectors)
    if now > (1 - MOSTLY) * energy:
        return CommonCauses((), 1 - now / energy)
    each = [one[:-1] for one in photographs]
    found = []
    for group in chosen:
        share = (_without(products, chosen, group, projectors) - now) / energy
        amounts = _amounts(products, chosen, group, values, projectors)
        alone = [_amounts(one, chosen, group, values, projectors) for one in each]
        for cause, *single in zip(amounts, *alone, strict=True):
            sure = abs(cause.amount) > max(LEAST[cause.kind], SURE * cause.sigma)
            if sure and all(_agree(one, cause) for one in single):
                found.append(replace(cause, share=share))
    return CommonCauses(tuple(found), 1 - now / energy)


def _agree(one: Cause, together: Cause) -> bool:
    """Whether one photograph's cause may be that of all: as sure as it is, and of the same sign."""
    near = abs(one.amount - together.amount) < SURE * one.sigma
    return one.amount * together.amount > 0 and (near or abs(one.amount) > HALF * abs(together.amount))


_Group = tuple[Kind, int | None]


def _groups(projectors: int) -> list[_Group]:
    """Causes that are reported together: the colours of one, in the order of ``equations``."""
    groups: list[_Group] = [("brightness", n) for n in range(projectors)]
    groups += [("response", n) for n in range(projectors)]
    return [*groups, ("indirect", None), ("ambient", None), ("focus", None)]


def _columns(group: _Group, projectors: int) -> list[int]:
    start = 0
    for other in _groups(projectors):
        count = 3 if other[0] in ("brightness", "ambient") else 1
        if other == group:
            return list(range(start, start + count))
        start += count
    raise ValueError(f"{group} is not a cause")


def _system(products: Float64, groups: Sequence[_Group], projectors: int) -> tuple[Float64, Float64, Float64]:
    """Normal matrix, its regularised form, and right-hand side of some causes."""
    columns = [column for group in groups for column in _columns(group, projectors)]
    normal = products[np.ix_(columns, columns)]
    return normal, normal + np.diag(RIDGE * np.diag(normal) + 1e-30), products[columns, -1]


def _left(products: Float64, groups: Sequence[_Group], projectors: int) -> float:
    """The squared error that these causes do not explain."""
    if not groups:
        return float(products[-1, -1])
    normal, regular, moment = _system(products, groups, projectors)
    amounts = np.linalg.solve(regular, moment)
    return max(float(products[-1, -1] - 2 * amounts @ moment + amounts @ normal @ amounts), 0.0)


def _without(products: Float64, groups: Sequence[_Group], group: _Group, projectors: int) -> float:
    return _left(products, [other for other in groups if other != group], projectors)


def _amounts(products: Float64, groups: Sequence[_Group], group: _Group, values: float, projectors: int) -> list[Cause]:
    _, regular, moment = _system(products, groups, projectors)
    amounts, inverse = np.linalg.solve(regular, moment), np.linalg.inv(regular)
    variance = _left(products, groups, projectors) / max(values / CORRELATED, 1.0)
    order = [column for each in groups for column in _columns(each, projectors)]
    found = []
    for colour, column in enumerate(columns := _columns(group, projectors)):
        at = order.index(column)
        sigma = float(np.sqrt(max(inverse[at, at], 0.0) * variance))
        name = COLOURS[colour] if len(columns) > 1 else None
        found.append(Cause(*group, name, float(amounts[at]), sigma, 0.0))
    return found
