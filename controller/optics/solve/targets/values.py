"""A target picture, and its parts on objects that stand apart."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from controller.core import channels
from controller.core.arrays import FloatImage, Mask
from controller.core.blur import masked_blur, nearest_known
from controller.optics.calibrate.values import Geometry


@dataclass(frozen=True, slots=True)
class Target:
    """An appearance as seen from the camera.

    ``image`` (rows, columns, 3) float32, linear, finite, >= 0: 1 is a white object in uniform light; 0 outside ``mask``
    ``mask`` (rows, columns) bool: valid pixels of the target
    ``softened``: what made it softer than it was asked for, in words; empty where nothing did
    ``exposure``: radiance of its white, where that is asked for; None: as bright as the stage can make it
    """

    image: FloatImage
    mask: Mask
    softened: str = ""
    exposure: float | None = None


CAMERA_FILTER_PX = 0.7
"""Minimum blur of the camera's optics and colour interpolation (``capture.raw.CAMERA_BLUR_PX``)."""


def through_camera(target: Target, *, sigma_px: float = CAMERA_FILTER_PX) -> Target:
    """A computed picture as the camera would see it, so that it asks for no edge that no photograph can show.

    The blur (a Gaussian of ``sigma_px``) is over the mask alone: nothing bleeds in from outside, or out.
    """
    image = np.where(target.mask[..., None], masked_blur(target.image, target.mask, sigma_px), 0)
    return Target(np.asarray(image, np.float32), target.mask, f"by the camera's own blur, {sigma_px:g} px")


LEAST_SHARE = 0.04
"""A part smaller than this share of the whole is not an object of its own, but belongs to the nearest one."""


def pieces(mask: Mask) -> list[Mask]:
    """Split ``mask`` (rows, columns) into objects that do not touch in the image, the largest first.

    Slivers and islands (shadows cut them off) go to the nearest object. The masks are disjoint and cover ``mask``.
    """
    from scipy import ndimage

    labels, count = ndimage.label(mask, structure=np.ones((3, 3)))
    if count == 0:
        return []
    sizes = np.bincount(labels.ravel())[1:]
    order = np.argsort(-sizes, kind="stable") + 1
    large = [int(label) for label in order if sizes[label - 1] >= LEAST_SHARE * mask.sum()] or [int(order[0])]
    owner = labels[nearest_known(np.isin(labels, large))[1]]
    return [mask & (owner == label) for label in large]


CELLS: Final = 40
"""Of the space that all parts take, each way, in which they are compared."""
LEAST_COMMON: Final = 0.02
"""Share of a part's cells that it has in common with another view's part of the same object."""


def connected(parts: Sequence[Mask], points_m: FloatImage) -> list[Mask]:
    """Parts of a picture (rows, columns), joined where they are the same object seen from several places.

    ``points_m`` (rows, columns, 3): where each pixel lies in space, NaN where unknown
    """
    known = [part & channels.finite(points_m) for part in parts]
    every = points_m[np.logical_or.reduce(known)] if parts else np.zeros((0, 3), np.float32)
    if not len(every):
        return list(parts)
    low, high = np.percentile(every, (1, 99), axis=0)
    side = max(float((high - low).max()) / CELLS, 1e-9)
    cells = [{tuple(cell) for cell in np.unique(np.floor((points_m[one] - low) / side), axis=0)} for one in known]
    joined: list[tuple[Mask, set[Any]]] = []
    for part, own in zip(parts, cells, strict=True):
        same = [one for one in joined if len(one[1] & own) > LEAST_COMMON * min(len(own), len(one[1]))]
        joined = [one for one in joined if not any(one is other for other in same)]
        whole = np.logical_or.reduce([part, *(mask for mask, _ in same)])
        joined.append((whole, own.union(*(others for _, others in same))))
    return [mask for mask, _ in joined]


def on_each(mask: Mask, make: Callable[[Mask], Target], objects: Sequence[Mask] | None = None) -> Target:
    """The targets that ``make`` gives for each object of ``mask``, side by side in one.

    ``objects``: None for its ``pieces``
    """
    image: FloatImage = np.zeros((*mask.shape, 3), np.float32)
    said: Mask = np.zeros(mask.shape, np.bool_)
    softened = ""
    for piece in pieces(mask) if objects is None else objects:
        part = make(piece)
        image[piece] = part.image[piece]
        said |= part.mask & piece
        softened = part.softened or softened
    return Target(image, said, softened)


def in_box(geometry: Geometry, mask: Mask, make: Callable[[Geometry, Mask], Target]) -> Target:
    """``make`` for the part of the picture (rows, columns) that ``mask`` has pixels in; it may look at no others.

    An object is a part of a picture, and each of several a small one.
    """
    if not mask.any():
        return make(geometry, mask)
    rows, columns = (slice(int(at[0]), int(at[-1]) + 1) for at in (np.flatnonzero(mask.any(axis=n)) for n in (1, 0)))
    part = replace(geometry, points_m=geometry.points_m[rows, columns], normals=geometry.normals[rows, columns])
    made = make(part, mask[rows, columns])
    image: FloatImage = np.zeros((*mask.shape, 3), np.float32)
    said: Mask = np.zeros(mask.shape, np.bool_)
    image[rows, columns], said[rows, columns] = made.image, made.mask
    return replace(made, image=image, mask=said)
