"""How much light blocks of a surface give each other by its shape alone, by rays through what was reconstructed.

Rays leave each block as light would that falls there comes in, more of them along the normal, and end on the first
surface that they meet. So what is hidden gives nothing, and surfaces that touch give each other all that they should
(Cohen and Wallace 1993, ch. 4.10). Only surfaces that the camera sees are known; light from others is not counted.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.blur import nearest_known
from controller.optics.transport.indirect.blocks import down

Indices = npt.NDArray[Any]
ACROSS: Final = 3
"""Patches along the side of a block, from each of which rays leave."""
RAYS: Final = 256
"""Of each patch."""
FINER: Final = 6
"""Cells along the side of a block, between which there are triangles."""
LEAST_KNOWN: Final = 0.2
"""Share of a cell's pixels with a point, for it to have one."""
GAP_BLOCKS: Final = 1.0
"""So far a surface is continued as a plane where no point is known: borders of shadows, and edges."""
GAP_DEPTH: Final = 0.1
"""Of the depth: a plane that would come so much nearer, or go so much farther, is not continued."""
LARGEST_STEP: Final = 6.0
"""Of a cell's width, between adjacent cells: more is another surface."""
LIFTED: Final = 0.3
"""Of a cell's width: rays begin above the surface, whose points have noise."""
SPREAD: Final = 0.7548776662466927, 0.5698402909980532, 0.6180339887498949
"""Steps of a sequence that fills a square evenly (Roberts 2018), and the golden ratio from patch to patch."""


@dataclass(frozen=True, slots=True, eq=False)
class _Cells:
    """A surface on a ``grid`` (rows, columns) of squares of ``side`` camera pixels.

    ``points``, ``normals`` (cells, 3); ``good`` (cells,): these are known
    """

    points: Float64
    normals: Float64
    good: Mask
    grid: tuple[int, int]
    side: int

    def blocks(self, grid: tuple[int, int], side: int) -> Indices:
        """(cells,): the block, of a ``grid`` of blocks of ``side`` camera pixels, in which the middle of each lies."""
        along = [
            np.minimum((np.arange(self.grid[n]) * self.side + self.side // 2) // side, grid[n] - 1) for n in (0, 1)
        ]
        return np.asarray(np.add.outer(along[0] * grid[1], along[1]).ravel(), np.intp)

    def widths(self) -> Float64:
        """(cells,): of what a cell covers, seen from the front; ``nan`` where not known."""
        ray = np.where(self.good[:, None], self.points, np.nan) / channels.length(self.points)[:, None]
        apart = channels.length(np.diff(ray.reshape(*self.grid, 3), axis=1))
        step = float(np.nanmedian(apart)) if np.isfinite(apart).any() else 0.0
        return np.asarray(step * channels.length(self.points))


def form_factors(points_m: FloatImage, normals: FloatImage, grid: tuple[int, int], side: int) -> FloatImage:
    """(blocks, blocks): the share of a block's (row) half-space that another block (column) fills, by cosine.

    A block receives the mean of what its patches receive. One without a shape receives what its nearest neighbour with
    one does, and sends nothing.

    ``points_m``, ``normals`` (rows, columns, 3) in the camera's frame, NaN where unknown; ``grid`` (rows, columns) of
    blocks of ``side`` x ``side`` pixels
    """
    count = grid[0] * grid[1]
    surface = _continued(_cells(points_m, normals, max(1, round(side / FINER))), GAP_BLOCKS * FINER)
    senders = _continued(_cells(points_m, normals, max(1, round(side / ACROSS))), GAP_BLOCKS * ACROSS)
    triangles = _triangles(surface)
    if not len(triangles) or not senders.good.any():
        return np.zeros((count, count), np.float32)
    block = senders.blocks(grid, side)[senders.good]
    out = np.zeros(count * (count + 1), np.int64)
    for met in _met(surface, triangles, senders, np.append(surface.blocks(grid, side), count)):
        out += np.bincount(block * (count + 1) + met, minlength=len(out))
    patches = np.bincount(block, minlength=count)
    shares = out.reshape(count, count + 1)[:, :count] / np.maximum(RAYS * patches, 1)[:, None]
    nearest = nearest_known((patches > 0).reshape(grid))[1]
    return np.asarray(shares[np.ravel_multi_index(nearest, grid).ravel()], np.float32)


def _cells(points_m: FloatImage, normals: FloatImage, side: int) -> _Cells:
    """Means of ``side`` x ``side`` pixels."""
    known = channels.finite(points_m) & channels.finite(normals)
    grid = (-(-known.shape[0] // side), -(-known.shape[1] // side))
    share = down(known[..., None].astype(np.float32), grid, side)[:, 0].astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        point, normal = (
            down(np.where(known[..., None], image, 0).astype(np.float32), grid, side) / share[:, None]
            for image in (points_m, normals)
        )
        normal /= channels.length(normal)[:, None]
    # the camera, at the origin, sees outward normals
    normal = np.where(channels.total(normal * point)[:, None] > 0, -normal, normal)
    good: Mask = (share > LEAST_KNOWN) & channels.finite(point) & channels.finite(normal)
    return _Cells(point, normal, good, grid, side)


def _continued(cells: _Cells, reach: float) -> _Cells:
    """With the plane of the nearest known cell at those which have one within ``reach`` cells."""
    if not cells.good.any():
        return cells
    apart, nearest = nearest_known(cells.good.reshape(cells.grid))
    gaps = np.flatnonzero((apart.ravel() > 0) & (apart.ravel() <= reach))
    source = np.ravel_multi_index(nearest, cells.grid).ravel()[gaps]
    row, column = np.divmod(np.arange(len(cells.points)), cells.grid[1])
    at = np.stack([column, row, np.ones_like(row)], axis=1).astype(np.float64)
    known = cells.points[cells.good]
    rays = at[gaps] @ np.linalg.lstsq(at[cells.good], known / known[:, 2:], rcond=None)[0]
    normal, point = cells.normals[source], cells.points[source]
    with np.errstate(divide="ignore", invalid="ignore"):
        found = rays * (channels.total(normal * point) / channels.total(normal * rays))[:, None]
        near = np.abs(found[:, 2] / point[:, 2] - 1) < GAP_DEPTH
    points, normals, good = cells.points.copy(), cells.normals.copy(), cells.good.copy()
    points[gaps[near]], normals[gaps[near]], good[gaps[near]] = found[near], normal[near], True
    return _Cells(points, normals, good, cells.grid, cells.side)


def _triangles(cells: _Cells) -> Indices:
    """(triangles, 3): cells that are known, and adjacent on the same surface."""
    at = np.arange(len(cells.points)).reshape(cells.grid)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]))
    width = cells.widths()

    def adjacent(one: Indices, other: Indices) -> Mask:
        apart = channels.length(cells.points[one] - cells.points[other])
        near = apart < LARGEST_STEP * np.maximum(width[one], width[other])
        return np.asarray(near & cells.good[one] & cells.good[other])

    parts = [np.stack(part, axis=1) for part in ((a, b, c), (b, d, c))]
    return np.concatenate(
        [part[adjacent(*part.T[:2]) & adjacent(*part.T[1:]) & adjacent(*part.T[::2])] for part in parts]
    )


def _met(surface: _Cells, triangles: Indices, senders: _Cells, block: Indices) -> Iterator[Indices]:
    """For each of the rays of a patch, (patches,): the ``block`` (cells + 1,) that it meets; the last where none is."""
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    points, normals = senders.points[senders.good], senders.normals[senders.good]
    first = _across(normals)
    second = np.cross(normals, first)
    origin = (points + LIFTED * senders.widths()[senders.good, None] / (FINER / ACROSS) * normals).astype(np.float32)
    scene: Any = rtcore_scene.EmbreeScene(robust=True)
    vertices = np.where(surface.good[:, None], surface.points, 0).astype(np.float32)
    mesh: Any = TriangleMesh(scene, vertices, triangles.astype(np.int32))
    patch = np.arange(len(points))
    for ray in range(RAYS):
        turn = 2 * np.pi * ((patch * SPREAD[2] + ray * SPREAD[0]) % 1)
        away = ((ray + 0.5) / RAYS + patch * SPREAD[1]) % 1
        along = np.sqrt(away) * np.stack([np.cos(turn), np.sin(turn)])
        direction = along[0, :, None] * first + along[1, :, None] * second + np.sqrt(1 - away)[:, None] * normals
        met = scene.run(origin, direction.astype(np.float32), output=1)
        hit = np.flatnonzero(met["primID"] >= 0)
        u, v = met["u"][hit], met["v"][hit]
        cell = triangles[met["primID"][hit], np.argmax(np.stack([1 - u - v, u, v]), axis=0)]
        front = channels.total(direction[hit] * surface.normals[cell]) < 0
        at = np.full(len(points), len(surface.points))
        at[hit[front]] = cell[front]
        yield block[at]
    del mesh


def _across(normals: Float64) -> Float64:
    """Unit vectors (N, 3) at right angles to each of the ``normals``."""
    other = np.where(np.abs(normals[:, :1]) < 0.9, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    found = np.cross(normals, other)
    return np.asarray(found / channels.length(found)[:, None])
