"""Form factors: how much of the light that leaves one patch reaches another. They depend on the scene alone.

They are counted from rays that leave each patch as diffuse light does, so no separate test of visibility is needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy import sparse

from plugins.emulated.optics.furnished import Scene
from plugins.emulated.optics.indirect.patches import CLEAR_M, Patches, patches_of
from plugins.emulated.optics.rays import Progress

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

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
        found = patches.hit(points, rays).patch
        hit = found >= 0
        row = np.repeat(np.arange(len(sides)), RAYS)[hit]
        block = sparse.coo_matrix((np.full(len(row), 1.0 / RAYS), (row, found[hit])), shape=(len(sides), count))
        rows.append(block.tocsr())
        progress(min(first + PATCHES_AT_ONCE, count) / count)
    found = sparse.vstack(rows)
    # Both ways between two patches carry the same, so each is counted twice: areas times factors are symmetric.
    area = np.repeat(np.add.reduceat(patches.areas, patches.starts[:-1]), 2)
    both = sparse.diags(area) @ found
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
