"""A picture painted on a sheet, the surface of an object unfolded: from the sheet to the object, and back.

A place on a sheet is u to the right and v upwards, both 0 to 1 (UV). Sheets are (rows, columns, 4) float32: linear
light, and alpha, with which the light is not multiplied.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Final, TypeAlias

import cv2
import numpy as np

from controller.core.arrays import Float64, FloatImage, Mask, strips
from controller.core.blur import nearest_known
from controller.optics.calibrate.mesh_alignment import Pose, SolidMesh, rays_of
from controller.optics.calibrate.values import Pinhole
from controller.optics.solve.targets.values import Target, through_camera
from controller.optics.solve.targets.wrap import sampled
from controller.optics.transport import LightTransport

Places: TypeAlias = Callable[[Float64], tuple[Float64, Float64]]
"""Of camera pixels (N, 2): their places on the sheet (N, 2), NaN where it does not cover the object, and by how much
these change (N, 2, 2) one camera pixel to the right, and one down."""

_SUBPIXELS: Final = 4
_BESIDE_PX: Final = 8
"""Pixels of a sheet around its parts that get their colours, so that a soft brush and a filter find no black there."""


def as_it_is(transport: LightTransport, matt: FloatImage | None = None) -> FloatImage:
    """The object under white light (rows, columns, 3), scaled so that its brightest parts are 1.

    ``matt``: as of ``own_reflectance``
    """
    light = transport.reach() if matt is None else transport.reach() * matt
    brightest = np.percentile(light[transport.object_mask], 99)
    return np.asarray(np.clip(light / brightest, 0, 1), np.float32)


def mesh_places(mesh: SolidMesh, uv: FloatImage, pose: Pose, camera: Pinhole) -> Places:
    """The sheet of a mesh; ``uv`` (faces, 3, 2): the places of each face's corners."""

    def places(px: Float64) -> tuple[Float64, Float64]:
        rays = rays_of(camera, *px.T)
        face = mesh.met_by(rays, pose).face

        def on_sheet(rays: Float64) -> Float64:
            return np.asarray(np.einsum("nc,nck->nk", mesh.weights(rays, pose, face), uv[np.maximum(face, 0)]))

        at = on_sheet(rays)
        # on the plane of the same face, so that no seam of the sheet lies between
        steps = np.stack([on_sheet(rays_of(camera, *(px + step).T)) - at for step in ((1.0, 0.0), (0.0, 1.0))], axis=1)
        at[face < 0] = np.nan
        return at, np.nan_to_num(steps, posinf=1.0, neginf=-1.0)

    return places


def on_sheet(views: Sequence[Places], tops: Sequence[int]) -> Places:
    """Of the pixels of several views whose pictures lie below each other, from the rows ``tops`` on."""

    def places(px: Float64) -> tuple[Float64, Float64]:
        at, steps = np.full(px.shape, np.nan), np.zeros((*px.shape, 2))
        view = np.searchsorted(tops, px[:, 1], side="right") - 1
        for v, (own, top) in enumerate(zip(views, tops, strict=True)):
            mine = view == v
            if mine.any():
                at[mine], steps[mine] = own(px[mine] - (0, top))
        return at, steps

    return places


def texture(sheet: FloatImage, places: Places | None, own: FloatImage, mask: Mask) -> Target:
    """The object with a sheet on it.

    ``places``: None for a sheet that is the camera's picture; ``own`` (rows, columns, 3): the object as it is, where
    the sheet is transparent or ends
    """
    light = _times_alpha(sheet)
    if places is None:
        way = cv2.INTER_AREA if sheet.shape[0] > mask.shape[0] else cv2.INTER_LINEAR
        image = np.asarray(cv2.resize(light, mask.shape[::-1], interpolation=way), np.float32)
    else:
        image = _painted(light, places, mask)
    painted = through_camera(Target(image, mask))
    mixed = painted.image[..., :3] + (1 - painted.image[..., 3:]) * own
    return replace(painted, image=np.where(mask[..., None], mixed, 0).astype(np.float32))


def paint_at(sheet: FloatImage, places: Places, mask: Mask) -> FloatImage:
    """(rows, columns, 3): a sheet's colours in ``mask``, NaN where it is clear or does not cover the object."""
    found = _painted(_times_alpha(sheet), places, mask)
    return np.where(found[..., 3:] > 0.5, found[..., :3] / np.maximum(found[..., 3:], 0.5), np.float32(np.nan))


def _times_alpha(sheet: FloatImage) -> FloatImage:
    return np.dstack([sheet[..., :3] * sheet[..., 3:], sheet[..., 3]]).astype(np.float32)


def _painted(sheet: FloatImage, places: Places, mask: Mask) -> FloatImage:
    """(rows, columns, 4) of a sheet of light times alpha, and alpha: the mean over each pixel's area on the sheet."""
    levels = [sheet]
    while min(levels[-1].shape[:2]) > 1:
        rows, columns = levels[-1].shape[:2]
        half_px = max(1, columns // 2), max(1, rows // 2)
        levels.append(np.asarray(cv2.resize(levels[-1], half_px, interpolation=cv2.INTER_AREA), np.float32))
    image: FloatImage = np.zeros((*mask.shape, 4), np.float32)
    size = np.array([sheet.shape[1], sheet.shape[0]])
    for rows_at in strips(len(mask)):
        y, x = np.nonzero(mask[rows_at])
        if not len(y):
            continue
        y += rows_at.start
        at, steps = places(np.stack([x, y], axis=1).astype(np.float64))
        on = np.isfinite(at[:, 0])
        y, x, at, steps = y[on], x[on], at[on], steps[on]
        # positions farther apart than a pixel of the sheet would alias: means of its pixels instead
        apart_px = np.linalg.norm(steps * size, axis=2).max(axis=1, initial=0.0) / _SUBPIXELS
        level = np.clip(np.ceil(np.log2(np.maximum(apart_px, 1e-9))), 0, len(levels) - 1).astype(np.int64)
        for one in np.unique(level):
            use = level == one
            image[y[use], x[use]] = _mean(levels[one], at[use], steps[use])
    return image


def _mean(sheet: FloatImage, at: Float64, steps: Float64) -> FloatImage:
    """(N, 4): of 4 x 4 positions in each pixel."""
    rows, columns = sheet.shape[:2]
    total = np.zeros((len(at), 4), np.float32)
    for *_, u, v in _positions(at, steps):
        x, y = (u % 1) * columns - 0.5, ((1 - v) % 1) * rows - 0.5
        total += sampled(sheet, x.astype(np.float32), y.astype(np.float32), border=cv2.BORDER_WRAP)
    return total / np.float32(_SUBPIXELS**2)


def _positions(at: Float64, steps: Float64) -> Iterator[tuple[float, float, Float64, Float64]]:
    """4 x 4 positions in each camera pixel: to the right and down from its middle, and u, v; beyond 1 it repeats."""
    offsets = (np.arange(_SUBPIXELS) + 0.5) / _SUBPIXELS - 0.5
    for down in offsets:
        for right in offsets:
            u, v = (at + right * steps[:, 0] + down * steps[:, 1]).T
            yield right, down, u, v


def photographed(picture: FloatImage, places: Places, mask: Mask, side: int) -> FloatImage:
    """The sheet (side, side, 4) with ``picture`` (rows, columns, 3) of the object in ``mask``, clear elsewhere."""
    total = np.zeros((side * side, 4))
    for rows in strips(len(mask)):
        y, x = np.nonzero(mask[rows])
        at, steps = places(np.stack([x, y + rows.start], axis=1).astype(np.float64))
        on = np.isfinite(at[:, 0])
        for right, down, u, v in _positions(at[on], steps[on]):
            texel = (((1 - v) % 1) * side).astype(np.int64) * side + ((u % 1) * side).astype(np.int64)
            px_x, px_y = (x[on] + right).astype(np.float32), (y[on] + rows.start + down).astype(np.float32)
            colours = sampled(picture, px_x, px_y)
            for channel, values in enumerate([*colours.T, np.ones(len(texel))]):
                total[:, channel] += np.bincount(texel, values, side * side)
    sheet = (total / np.maximum(total[:, 3:], 1)).astype(np.float32).reshape(side, side, 4)
    far, nearest = nearest_known(sheet[..., 3] > 0)
    return np.where((far <= _BESIDE_PX)[..., None], sheet[nearest], sheet)
