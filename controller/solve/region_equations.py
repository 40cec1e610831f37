"""The equations of one region of the camera image, cut out of the whole solve (paper 3.2, eq. 7).

The same T, camera blur and colour mixing included, and the same smoothness as in ``bounded``; what the pixels that are
held fixed contribute stands on the right-hand side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from controller.arrays import Float64, FloatImage
from controller.compiled import compiled
from controller.solve.bounded import Problem
from controller.solve.box_solvers import BoxProblem
from controller.transport import LightTransport
from controller.transport.edge_terms import EdgedTransport
from controller.transport.lanes import LANES
from controller.transport.patch_transport import PatchTransport
from controller.transport.patches import Patches
from controller.transport.window_matrix import box_rows
from controller.transport.window_transport import WindowTransport

Pixels = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Box:
    """Camera pixels from (top, left) up to, not including, (bottom, right)."""

    top: int
    left: int
    bottom: int
    right: int

    def grown(self, by: int, shape: tuple[int, int]) -> Box:
        """Larger by ``by`` on every side, within an image of ``shape``."""
        top, left = max(self.top - by, 0), max(self.left - by, 0)
        return Box(top, left, min(self.bottom + by, shape[0]), min(self.right + by, shape[1]))

    @property
    def window(self) -> tuple[slice, slice]:
        return slice(self.top, self.bottom), slice(self.left, self.right)


def channel_groups(transport: LightTransport) -> list[tuple[int, ...]]:
    """Channels that have to be solved together: all three, or each alone where no projector mixes colours."""
    apart = all(np.count_nonzero(mixing - np.diag(np.diag(mixing))) == 0 for mixing in transport.mixing)
    return [(0,), (1,), (2,)] if apart else [(0, 1, 2)]


def box_problem(
    problem: Problem, box: Box, unknown: Pixels, channels: tuple[int, ...], x: FloatImage, light: FloatImage
) -> BoxProblem:
    """The equations at the camera pixels of ``box`` for some projector pixels.

    Parameters
    ----------
    unknown : (n,) rising indices of pixels of all projectors
    channels : to be solved together; unknowns stand in the order (channel, pixel)
    x, light : (3, pixels) current values, and (3, rows, columns) T x
    """
    weights = np.sqrt(problem.weights[box.window].astype(np.float64)).ravel()
    start = x[list(channels)][:, unknown].astype(np.float64).ravel()
    A = local_transport(problem.transport, box, unknown, channels)
    window = (list(channels), *box.window)
    missing = (problem.wanted[window] - light[window]).astype(np.float64).ravel()
    wanted = missing + A @ start
    scale = np.tile(weights, len(channels))
    rows = np.flatnonzero(scale)
    scale = scale[rows]
    data = sp.diags_array(scale) @ A[rows]
    S, smooth = _smoothness(problem, unknown, channels, x)
    matrix = sp.csr_matrix(sp.vstack([data, S]))
    return BoxProblem(matrix, np.concatenate([scale * wanted[rows], smooth]), start)


def local_transport(
    transport: LightTransport, box: Box, unknown: Pixels, channels: tuple[int, ...]
) -> sp.csr_matrix[np.float64]:
    """Rows (channel, pixel of the box) of T in the columns (channel, unknown pixel)."""
    if isinstance(transport, EdgedTransport):
        model = local_transport(transport.model, box, unknown, channels)
        return sp.csr_matrix(model + _edge_rows(transport, box, unknown, channels))
    if isinstance(transport, WindowTransport):
        return box_rows(transport, (box.top, box.left, box.bottom, box.right), unknown, channels)
    if not isinstance(transport, PatchTransport):
        raise TypeError(f"no equations for a {type(transport).__name__}")
    radius = transport.taps.shape[1] // 2
    wide = box.grown(radius, transport.shape)
    owner = np.searchsorted(transport.patches.start, unknown, side="right") - 1
    shares = _shares(transport.patches, unknown, wide)
    by_projector = [np.flatnonzero(owner == n) for n in np.unique(owner)]
    order = np.argsort(np.concatenate(by_projector), kind="stable")
    blocks = []
    for c in channels:
        parts = []
        for mine in by_projector:
            n = int(owner[mine[0]])
            part = sp.diags_array(transport.gain[n, c][wide.window].ravel().astype(np.float64)) @ shares[:, mine]
            if radius > 0:
                after = transport.after[n, c][box.window].ravel().astype(np.float64)
                part = sp.diags_array(after) @ (_blur(transport.taps[c], box, wide) @ part)
            parts.append(part)
        whole = sp.hstack(parts, format="csc")[:, order]
        mixed = [whole @ sp.diags_array(transport.mixing[owner, c, d].astype(np.float64)) for d in channels]
        blocks.append(sp.hstack(mixed, format="csr"))
    return sp.csr_matrix(sp.vstack(blocks, format="csr"))


def _edge_rows(
    transport: EdgedTransport, box: Box, unknown: Pixels, channels: tuple[int, ...]
) -> sp.csr_matrix[np.float64]:
    """What the measured terms at depth edges add to the rows of ``local_transport``."""
    y, x = np.mgrid[box.top : box.bottom, box.left : box.right]
    pixels = (y * transport.shape[1] + x).ravel()
    total = sp.csr_matrix((len(channels) * pixels.size, len(channels) * unknown.size))
    for n, term in enumerate(transport.terms):
        span = transport.span(n)
        mine = np.flatnonzero((unknown >= span.start) & (unknown < span.stop))
        _, row, place = np.intersect1d(pixels, term.camera, assume_unique=True, return_indices=True)
        if not (row.size and mine.size):
            continue
        near = sp.csc_matrix(term.differences[place], dtype=np.float64)[:, unknown[mine] - span.start]
        spread = sp.csr_matrix((np.ones(row.size), (row, np.arange(row.size))), shape=(pixels.size, row.size))
        chosen = sp.csr_matrix((np.ones(mine.size), (np.arange(mine.size), mine)), shape=(mine.size, unknown.size))
        blocks = []
        for c in channels:
            seen = spread @ sp.diags_array(term.white[c, place].astype(np.float64)) @ near @ chosen
            parts = [sp.csr_matrix(seen * float(transport.mixing[n, c, d])) for d in channels]
            blocks.append(sp.hstack(parts, format="csr"))
        total = sp.csr_matrix(total + sp.vstack(blocks, format="csr"))
    return total


def _shares(patches: Patches, unknown: Pixels, box: Box) -> sp.csc_matrix[np.float64]:
    """(pixels of the box, unknowns): the weights of the metapixels, before gain."""
    size = int((patches.rows[unknown].astype(np.int64) * patches.groups[unknown]).sum()) * LANES
    row, column, value = np.empty(size, np.int32), np.empty(size, np.int32), np.empty(size)
    count = _gather(patches, unknown, (box.top, box.left, box.bottom, box.right), row, column, value)
    shape = ((box.bottom - box.top) * (box.right - box.left), unknown.size)
    return sp.csc_matrix((value[:count], (row[:count], column[:count])), shape=shape)


@compiled()
def _gather(
    patches: Patches,
    unknown: Pixels,
    box: tuple[int, int, int, int],
    row: npt.NDArray[np.int32],
    column: npt.NDArray[np.int32],
    value: Float64,
) -> int:
    top, left, bottom, right = box
    n = 0
    for i in range(unknown.size):
        v = unknown[i]
        k = np.int64(patches.first[v]) * LANES
        for y in range(patches.row[v], patches.row[v] + patches.rows[v]):
            for x in range(patches.column[v], patches.column[v] + patches.groups[v] * LANES):
                if patches.weights[k] > 0 and top <= y < bottom and left <= x < right:
                    row[n], column[n], value[n] = (y - top) * (right - left) + x - left, i, patches.weights[k]
                    n += 1
                k += 1
    return n


def _blur(taps: FloatImage, box: Box, wide: Box) -> sp.csr_matrix[np.float64]:
    """(pixels of ``box``, pixels of ``wide``): the camera's blur, as in ``blur_planes``."""
    down = _taps_between(taps, (box.top, box.bottom), (wide.top, wide.bottom))
    across = _taps_between(taps, (box.left, box.right), (wide.left, wide.right))
    return sp.csr_matrix(sp.kron(sp.csr_matrix(down), sp.csr_matrix(across), format="csr"))


def _taps_between(taps: FloatImage, to: tuple[int, int], since: tuple[int, int]) -> Float64:
    k = np.arange(*since)[None, :] - np.arange(*to)[:, None] + taps.size // 2
    return np.where((k >= 0) & (k < taps.size), taps[np.clip(k, 0, taps.size - 1)], 0).astype(np.float64)


def _smoothness(
    problem: Problem, unknown: Pixels, channels: tuple[int, ...], x: FloatImage
) -> tuple[sp.csr_matrix[np.float64], Float64]:
    """One row alpha (p_i - p_j) for each pair of which at least one pixel is unknown (paper 2.4, eq. 3)."""
    sizes = problem.transport.sizes
    start = np.cumsum([0, *(rows * columns for rows, columns in sizes)])
    owner = np.searchsorted(start, unknown, side="right") - 1
    width = np.array([size[1] for size in problem.transport.sizes], np.int64)[owner]
    rows, columns, values, wanted, count = [], [], [], [], 0
    for ties, step in ((problem.across, np.ones_like(width)), (problem.down, width)):
        before = unknown - step >= start[owner]
        pairs = np.concatenate([np.stack([unknown, unknown + step]), np.stack([unknown - step, unknown])[:, before]], 1)
        pairs = np.unique(pairs, axis=1)
        for index, c in enumerate(channels):
            here = pairs[:, ties[c, pairs[0]] > 0]
            alpha = np.sqrt(ties[c, here[0]].astype(np.float64))
            known = np.zeros(alpha.size)
            for pixel, sign in ((here[0], 1.0), (here[1], -1.0)):
                at = np.minimum(np.searchsorted(unknown, pixel), unknown.size - 1)
                found = unknown[at] == pixel
                rows.append(count + np.flatnonzero(found))
                columns.append(index * unknown.size + at[found])
                values.append(sign * alpha[found])
                known[~found] -= sign * alpha[~found] * x[c, pixel[~found]]
            wanted.append(known)
            count += alpha.size
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sp.csr_matrix(entries, shape=(count, unknown.size * len(channels))), np.concatenate(wanted)
