"""From projector frames to the light that comes back: radiosity between patches, solved once for all frames.

With irradiance E of the projectors on the patches, albedo R and form factors F, the light that comes back is
I = F R (E + I), so I = (1 - F R)^-1 F R E: every number of bounces.

The form factors, how much of the light that leaves one patch reaches another, are counted from rays that leave each
patch as diffuse light does, so no separate test of visibility is needed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Self

import numba
import numpy as np
import numpy.typing as npt
from scipy import sparse

from hal.runtime.jit import compiled
from plugins.emulated.core.truth import BenchTruth, CameraTruth, ProjectorTruth
from plugins.emulated.optics.indirect.patches import CLEAR_M, Hits, Patches, patches_of
from plugins.emulated.optics.light_cache import sparse_arrays, sparse_matrix
from plugins.emulated.optics.objects import Scene
from plugins.emulated.optics.rays import Progress, directions

RAYS: Final = 512
"""That leave each patch."""
PATCHES_AT_ONCE: Final = 1024


@dataclass(frozen=True, slots=True)
class Scattering:
    """``factors`` (2G, 2G): the share of what each side of a patch sees that is each other."""

    patches: Patches
    factors: sparse.csr_matrix


def scattering_of(scene: Scene, count: int, seed: int, progress: Progress = lambda share: None) -> Scattering:
    """Between about ``count`` patches of a scene."""
    patches = patches_of(scene, count)
    return Scattering(patches, _form_factors(patches, np.random.default_rng([seed, 4]), progress))


def _form_factors(patches: Patches, rng: np.random.Generator, progress: Progress) -> sparse.csr_matrix:
    """Share (2G, 2G) of what a patch sees that is each other patch."""
    from scipy.stats import qmc

    whole = np.concatenate([[0.0], np.cumsum(patches.areas)])
    numbers = qmc.Sobol(5, seed=rng).random(RAYS)
    count = 2 * patches.count
    rows: list[Any] = []
    for first in range(0, count, PATCHES_AT_ONCE):
        sides = np.arange(first, min(first + PATCHES_AT_ONCE, count))
        drawn = (numbers[None] + rng.random((len(sides), 1, 5))) % 1.0
        begin, end = whole[patches.starts[sides // 2]], whole[patches.starts[sides // 2 + 1]]
        place = begin[:, None] + drawn[..., 0] * (end - begin)[:, None]
        face = np.searchsorted(whole, place.ravel(), side="right") - 1
        face = np.clip(
            face.reshape(place.shape), *(patches.starts[sides // 2 + n][:, None] - n for n in (0, 1))
        ).ravel()
        points, rays = _leaving(patches, face, np.repeat(1.0 - 2.0 * (sides % 2), RAYS), drawn[..., 1:].reshape(-1, 4))
        reached = patches.hit(points, rays).patch
        hit = reached >= 0
        row = np.repeat(np.arange(len(sides)), RAYS)[hit]
        block = sparse.coo_matrix((np.full(len(row), 1.0 / RAYS), (row, reached[hit])), shape=(len(sides), count))
        rows.append(block.tocsr())
        progress(min(first + PATCHES_AT_ONCE, count) / count)
    reached = sparse.vstack(rows)
    # Both ways between two patches carry the same, so each is counted twice: areas times factors are symmetric.
    area = np.repeat(np.add.reduceat(patches.areas, patches.starts[:-1]), 2)
    both = sparse.diags(area) @ reached
    return sparse.csr_matrix(sparse.diags(0.5 / area) @ (both + both.T))


def _leaving(patches: Patches, face: Integers, side: Floats, drawn: Floats) -> tuple[Floats, Floats]:
    """Points evenly on faces, and rays from there, as many as the cosine to the normal on that side."""
    root, share = np.sqrt(drawn[:, :1]), drawn[:, 1:2]
    corners = patches.corners[face]
    points = (1.0 - root) * corners[:, 0] + root * (1.0 - share) * corners[:, 1] + root * share * corners[:, 2]
    normals = patches.normals[face] * side[:, None]
    helper = np.where(np.abs(normals[:, :1]) < 0.9, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    first = np.cross(normals, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normals, first)
    turn, sine = 2.0 * np.pi * drawn[:, 2:3], np.sqrt(drawn[:, 3:4])
    rays = sine * (np.cos(turn) * first + np.sin(turn) * second) + np.sqrt(1.0 - drawn[:, 3:4]) * normals
    return points + CLEAR_M * normals, rays


Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
FloatImage = npt.NDArray[np.float32]

PROJECTOR_RAYS: Final = 500_000
NEAREST: Final = 10
"""Patches between which a camera pixel's light is interpolated."""
TURN: Final = 3.0
"""So many sizes of a patch count as far as a turn of the normal by one radian."""
CELLS_ACROSS: Final = 400
"""In larger pictures, neighbouring pixels share their light."""


@dataclass(frozen=True, slots=True)
class Transfer:
    """``arrive``: for each projector the irradiance (L,) on lit patches of its pixels (K,), one channel;

    ``back`` (3, S, L): light that comes back to patches that the camera sees; ``cells`` (pixels,) int32: the camera's
    cell of each of ``Samples.pixels``; ``blend`` (cells, S): a cell's light from that of patches
    """

    arrive: tuple[sparse.csr_matrix, ...]
    back: FloatImage
    cells: npt.NDArray[np.int32]
    blend: sparse.csr_matrix

    def light(self, sent: Sequence[FloatImage | None]) -> FloatImage:
        """Irradiance (pixels, 3) that comes back for what each projector sends out; None: nothing."""
        direct = np.zeros((self.back.shape[2], 3), dtype=np.float32)
        for index, image in enumerate(sent):
            if image is not None:
                direct += self.direct(index, image)
        return self.returned(direct)

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """See ``transfers.LightTransfer``."""
        arrays = {"projectors": np.array(len(self.arrive)), "back": self.back, "cells": self.cells}
        for n, matrix in enumerate(self.arrive):
            arrays |= sparse_arrays(f"arrive{n}", matrix)
        return arrays | sparse_arrays("blend", self.blend)

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, npt.NDArray[Any]]) -> Self:
        """See ``transfers.LightTransfer``."""
        arrive = tuple(sparse_matrix(arrays, f"arrive{n}") for n in range(int(arrays["projectors"])))
        return cls(arrive, arrays["back"], arrays["cells"], sparse_matrix(arrays, "blend"))

    def direct(self, projector: int, emitted: FloatImage) -> FloatImage:
        """Irradiance (L, 3) on the patches of what a projector's pixels (rows, columns, 3) send out."""
        return np.asarray(self.arrive[projector] @ emitted.reshape(-1, 3), dtype=np.float32)

    def returned(self, direct: FloatImage) -> FloatImage:
        """Irradiance (pixels, 3) that comes back, where each camera pixel looks, for ``direct`` on the patches."""
        light = np.stack([self.back[channel] @ direct[:, channel] for channel in range(3)], axis=1)
        return _taken(np.ascontiguousarray(self.blend @ light, dtype=np.float32), self.cells)


def transfer_of(truth: BenchTruth, scattering: Scattering, pixels: npt.NDArray[np.int32]) -> Transfer:
    """Work everything out; ``pixels``: ``Samples.pixels``."""
    patches, factors = scattering.patches, scattering.factors
    arrive = sparse.vstack([_arriving(projector, patches) for projector in truth.projectors]).tocsr()
    cells, seen = _seen(truth.camera, patches, pixels)
    total = np.asarray(arrive.sum(axis=1)).reshape(len(truth.projectors), -1).sum(axis=0)
    kept = _reached(factors, total > 0.0, seen.patch)
    blend = _blended(patches, kept, seen)
    lit, used = np.flatnonzero(total[kept] > 0.0), np.flatnonzero(blend.getnnz(axis=0))
    factors, albedo = factors[kept][:, kept], patches.albedo[kept // 2]
    back = [_all_bounces(factors, albedo[:, channel], lit)[used] for channel in range(3)]
    first = 2 * patches.count * np.arange(len(truth.projectors))
    return Transfer(
        arrive=tuple(arrive[n + kept[lit]].astype(np.float32) for n in first),
        back=np.ascontiguousarray(back),
        cells=cells,
        blend=blend[:, used].tocsr(),
    )


def _all_bounces(factors: sparse.csr_matrix, albedo: Floats, lit: Integers) -> FloatImage:
    once = (factors @ sparse.diags(albedo)).toarray().astype(np.float32)
    return np.asarray(np.linalg.solve(np.eye(len(once), dtype=np.float32) - once, once[:, lit]), dtype=np.float32)


def _arriving(projector: ProjectorTruth, patches: Patches) -> sparse.csr_matrix:
    """Irradiance (2G, K) on the patches of each pixel of a projector: its power goes where rays through it go.

    The power of a pixel follows from ``rays``: the light on a surface times the area that the pixel covers there.
    """
    lens, light = projector.lens, projector.light
    width, height = lens.size_px
    pixel = np.arange(width * height)
    parts = int(np.clip(np.ceil(np.sqrt(PROJECTOR_RAYS / len(pixel))), 1, 16))
    area = np.add.reduceat(patches.areas, patches.starts[:-1])
    total = sparse.csr_matrix((2 * patches.count, len(pixel)))
    for n in range(parts * parts):
        x = np.asarray(pixel % width + (n % parts + 0.5) / parts - 0.5, np.float64)
        y = np.asarray(pixel // width + (n // parts + 0.5) / parts - 0.5, np.float64)
        rays = directions(projector.pose, lens, x, y)
        patch = patches.hit(np.broadcast_to(np.asarray(projector.pose.position_m), rays.shape), rays).patch
        corner = ((x - 0.5 * (width - 1)) / (0.5 * width)) ** 2 + ((y - 0.5 * (height - 1)) / (0.5 * height)) ** 2
        power = light.brightness * light.reference_m**2 * np.maximum(1.0 - light.vignetting * corner / 2.0, 0.0)
        power *= _solid(projector, x, y) / parts**2
        hit = np.flatnonzero(patch >= 0)
        shares = power[hit] / area[patch[hit] // 2]
        total = total + sparse.csr_matrix((shares, (patch[hit], hit)), shape=total.shape)
    return total


def _solid(projector: ProjectorTruth, x: Floats, y: Floats) -> Floats:
    """Area of each pixel on the plane at distance 1, where a lens with distortion has drawn it."""

    def flat(x: Floats, y: Floats) -> Floats:
        local = directions(projector.pose, projector.lens, x, y) @ projector.pose.rotation.T
        return np.asarray(local[:, :2] / local[:, 2:])

    if not any(projector.lens.distortion):
        return np.full(len(x), projector.lens.focal_px**-2.0)
    across, down = flat(x + 0.5, y) - flat(x - 0.5, y), flat(x, y + 0.5) - flat(x, y - 0.5)
    return np.abs(across[:, 0] * down[:, 1] - across[:, 1] * down[:, 0])


def _seen(camera: CameraTruth, patches: Patches, pixels: npt.NDArray[np.int32]) -> tuple[npt.NDArray[np.int32], Hits]:
    """The cell (pixels,) of each pixel, and what cells see: neighbouring pixels that see the same patch are one."""
    width = camera.lens.size_px[0]
    row, column = np.divmod(pixels.astype(np.int64), width)
    seen = _hit_by_pixels(camera, patches, row, column)
    step = max(1, round(width / CELLS_ACROSS))
    block = (row // step) * width + column // step
    places, cells = np.unique(block * (2 * patches.count + 1) + seen.patch + 1, return_inverse=True)
    cells, counts = cells.reshape(-1), np.bincount(cells.reshape(-1))

    def mean(values: Floats) -> Floats:
        return np.stack([np.bincount(cells, weights=values[:, axis]) / counts for axis in range(3)], axis=1)

    hits = Hits(places % (2 * patches.count + 1) - 1, mean(seen.points), mean(seen.normals))
    return cells.astype(np.int32), hits


def _hit_by_pixels(camera: CameraTruth, patches: Patches, row: Integers, column: Integers) -> Hits:
    """What the middle of each pixel sees; where that is nothing, another place in it."""
    eye = np.asarray(camera.pose.position_m)
    seen = Hits(np.full(len(row), -1), np.zeros((len(row), 3)), np.zeros((len(row), 3)))
    for dx, dy in ((0.0, 0.0), (-0.4, -0.4), (0.4, 0.4), (-0.4, 0.4), (0.4, -0.4)):
        missed = np.flatnonzero(seen.patch < 0)
        x, y = np.asarray(column[missed] + dx, np.float64), np.asarray(row[missed] + dy, np.float64)
        rays = directions(camera.pose, camera.lens, x, y)
        hits = patches.hit(np.broadcast_to(eye, rays.shape), rays)
        for part, of_all in ((hits.patch, seen.patch), (hits.points, seen.points), (hits.normals, seen.normals)):
            of_all[missed] = part
    return seen


def _reached(factors: sparse.csr_matrix, lit: npt.NDArray[np.bool_], seen: Integers) -> Integers:
    """The patches that light can reach, or that the camera sees; the others (insides) need no room."""
    while True:
        more = lit | (factors @ lit.astype(np.float64) > 0.0)
        if (more == lit).all():
            break
        lit = more
    lit[seen[seen >= 0]] = True
    return np.flatnonzero(lit)


def _blended(patches: Patches, kept: Integers, seen: Hits) -> sparse.csr_matrix:
    """Weights (cells, P) of the patches near each cell's point that face as it does: smooth, and 1 in sum."""
    from scipy.spatial import cKDTree

    group = kept // 2
    facing = patches.directions[group] * (1.0 - 2.0 * (kept % 2))[:, None]
    body = np.where(seen.patch >= 0, patches.body[seen.patch // 2], -1)
    blend = sparse.csr_matrix((len(body), len(kept)))
    for number in np.unique(body[body >= 0]):
        near, mine = np.flatnonzero(patches.body[group] == number), np.flatnonzero(body == number)
        turn = TURN * patches.size_m[group[near[0]]]
        tree = cKDTree(np.concatenate([patches.centres[group[near]], turn * facing[near]], axis=1))
        places = np.concatenate([seen.points[mine], turn * seen.normals[mine]], axis=1)
        nearest = tree.query(places, k=np.arange(1, min(NEAREST, len(near)) + 1), workers=-1)
        away, nearest_patch = np.asarray(nearest[0], np.float64), np.asarray(nearest[1], np.int64)
        reach = 1.001 * away[:, -1:]
        weight = (1.0 - (away / reach) ** 2) ** 2
        weight /= weight.sum(axis=1, keepdims=True)
        rows = np.repeat(mine, nearest_patch.shape[1])
        blend = blend + sparse.csr_matrix((weight.ravel(), (rows, near[nearest_patch].ravel())), shape=blend.shape)
    return blend.astype(np.float32)


@compiled(parallel=True)
def _taken(light: FloatImage, cells: npt.NDArray[np.int32]) -> FloatImage:
    """The light (pixels, 3) of each pixel's cell: as numpy.take, on all cores."""
    out = np.empty((len(cells), 3), dtype=np.float32)
    for pixel in numba.prange(len(cells)):
        for c in range(3):
            out[pixel, c] = light[cells[pixel], c]
    return out
