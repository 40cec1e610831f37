"""Parts of T over patches as plain sparse matrices, for solvers that need explicit equations."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from controller.core.arrays import Float64, FloatImage
from controller.core.jit import compiled
from controller.optics.transport.camera_box import CameraBox
from controller.optics.transport.gaussians.patches import Patches
from controller.optics.transport.simd.gaussians import LANES

Pixels = npt.NDArray[np.int64]


def patch_rows(
    patches: Patches,
    gain: FloatImage,
    after: FloatImage,
    taps: FloatImage,
    mixing: FloatImage,
    box: CameraBox,
    pixels: Pixels,
    channels: tuple[int, ...],
) -> sp.csr_matrix[np.float64]:
    """``LightTransport.submatrix`` of patches; the arrays are those of ``PatchTransport``."""
    radius = taps.shape[1] // 2
    wide = box.grown(radius, (int(patches.camera_shape[0]), int(patches.camera_shape[1])))
    owner = np.searchsorted(patches.start, pixels, side="right") - 1
    shares = _shares(patches, pixels, wide)
    by_projector = [np.flatnonzero(owner == n) for n in np.unique(owner)]
    order = np.argsort(np.concatenate(by_projector), kind="stable")
    blocks = []
    for c in channels:
        parts = []
        for mine in by_projector:
            n = int(owner[mine[0]])
            part = sp.diags_array(gain[n, c][wide.window].ravel().astype(np.float64)) @ shares[:, mine]
            if radius > 0:
                factor = after[n, c][box.window].ravel().astype(np.float64)
                part = sp.diags_array(factor) @ (_blur(taps[c], box, wide) @ part)
            parts.append(part)
        whole = sp.hstack(parts, format="csc")[:, order]
        mixed = [whole @ sp.diags_array(mixing[owner, c, d].astype(np.float64)) for d in channels]
        blocks.append(sp.hstack(mixed, format="csr"))
    return sp.csr_matrix(sp.vstack(blocks, format="csr"))


def _shares(patches: Patches, pixels: Pixels, box: CameraBox) -> sp.csc_matrix[np.float64]:
    """(camera pixels of the box, projector pixels): the weights of the metapixels, before gain."""
    size = int((patches.rows[pixels].astype(np.int64) * patches.groups[pixels]).sum()) * LANES
    row, column, value = np.empty(size, np.int32), np.empty(size, np.int32), np.empty(size)
    count = _gather(patches, pixels, box, row, column, value)
    shape = ((box.bottom - box.top) * (box.right - box.left), pixels.size)
    return sp.csc_matrix((value[:count], (row[:count], column[:count])), shape=shape)


@compiled()
def _gather(
    patches: Patches,
    pixels: Pixels,
    box: CameraBox,
    row: npt.NDArray[np.int32],
    column: npt.NDArray[np.int32],
    value: Float64,
) -> int:
    top, left, bottom, right = box
    n = 0
    for i in range(pixels.size):
        v = pixels[i]
        k = np.int64(patches.first[v]) * LANES
        for y in range(patches.row[v], patches.row[v] + patches.rows[v]):
            for x in range(patches.column[v], patches.column[v] + patches.groups[v] * LANES):
                if patches.weights[k] > 0 and top <= y < bottom and left <= x < right:
                    row[n], column[n], value[n] = (y - top) * (right - left) + x - left, i, patches.weights[k]
                    n += 1
                k += 1
    return n


def _blur(taps: FloatImage, box: CameraBox, wide: CameraBox) -> sp.csr_matrix[np.float64]:
    """(pixels of ``box``, pixels of ``wide``): the camera's blur, as in ``blur_planes``."""
    down = _taps_between(taps, (box.top, box.bottom), (wide.top, wide.bottom))
    across = _taps_between(taps, (box.left, box.right), (wide.left, wide.right))
    return sp.csr_matrix(sp.kron(sp.csr_matrix(down), sp.csr_matrix(across), format="csr"))


def _taps_between(taps: FloatImage, to: tuple[int, int], since: tuple[int, int]) -> Float64:
    k = np.arange(*since)[None, :] - np.arange(*to)[:, None] + taps.size // 2
    return np.where((k >= 0) & (k < taps.size), taps[np.clip(k, 0, taps.size - 1)], 0).astype(np.float64)
