"""A light transport with the measured light at depth edges, for any model of a projector pixel.

T p gains W_n (.) E_n (M_n p_n) for each projector. E_n is sparse: measured share less the model's, of the few projector
pixels that fall on two surfaces, at the camera pixels that see them. Its rows sum to 0, so T_n 1 stays the white image.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from controller.core import channels
from controller.core.arrays import FloatImage
from controller.optics.calibrate.metapixels.depth_edges import EdgeShares
from controller.optics.transport.operator import LightTransport
from controller.optics.transport.planes import CameraBox, image_planes

NOISES: Final = 2.0
"""Differences of this many standard deviations of their noise are halved; smaller ones vanish, larger ones stay."""
MOST: Final = 1.0
LEAST_SHARE: Final = 0.03
LEAST_CHANGE: Final = 0.04
"""Share of its light; a camera pixel with smaller changes keeps the model."""


@dataclass(frozen=True, slots=True)
class EdgeTerm:
    """E of one projector.

    ``differences`` (camera pixels that have some, projector's pixels) float32; ``camera`` (n,) their row-major indices;
    ``white`` (3, n) float32
    """

    differences: sp.csr_matrix[np.float32]
    camera: npt.NDArray[np.int64]
    white: FloatImage


@dataclass(frozen=True, eq=False, repr=False)
class EdgedTransport(LightTransport):
    """A light transport, ``model``, with a term at depth edges for each projector."""

    model: LightTransport
    terms: tuple[EdgeTerm, ...]

    def forward_planes(
        self, p: FloatImage, *, projectors: tuple[int, int] | None = None, out: FloatImage | None = None
    ) -> FloatImage:
        """T p on planes, as ``LightTransport.forward_planes``."""
        light = self.model.forward_planes(p, projectors=projectors, out=out)
        flat = light.reshape(3, -1)
        for n in range(*(projectors or (0, len(self.terms)))):
            term = self.terms[n]
            shown = self.mixing[n] @ p[:, self.span(n)]
            for c in range(3):
                flat[c, term.camera] += term.white[c] * (term.differences @ shown[c])
        return light

    def adjoint_planes(
        self, r: FloatImage, *, projectors: tuple[int, int] | None = None, out: FloatImage | None = None
    ) -> FloatImage:
        """T' r on planes, as ``LightTransport.adjoint_planes``."""
        back = self.model.adjoint_planes(r, projectors=projectors, out=out)
        for n in range(*(projectors or (0, len(self.terms)))):
            self._add_term(n, r, back)
        return back

    def _add_term(self, n: int, r: FloatImage, back: FloatImage) -> None:
        term, flat = self.terms[n], r.reshape(3, -1)
        seen = np.stack([term.differences.T @ (term.white[c] * flat[c, term.camera]) for c in range(3)])
        back[:, self.span(n)] += self.mixing[n].T @ seen.astype(np.float32)

    def gaussian_mean_planes(self, image: FloatImage, *, projectors: tuple[int, int] | None = None) -> FloatImage:
        """The model's."""
        return self.model.gaussian_mean_planes(image, projectors=projectors)

    def with_absolute_mixing(self) -> Self:
        """T with magnitudes for its entries; the terms' too."""
        terms = tuple(dataclasses.replace(term, differences=abs(term.differences)) for term in self.terms)
        model = self.model.with_absolute_mixing()
        return dataclasses.replace(self, mixing=model.mixing, model=model, terms=terms)

    def submatrix(
        self, box: CameraBox, pixels: npt.NDArray[np.int64], channels: tuple[int, ...]
    ) -> sp.csr_matrix[np.float64]:
        """The model's part of T plus the measured terms, as ``LightTransport.submatrix``."""
        model = self.model.submatrix(box, pixels, channels)
        return sp.csr_matrix(model + self._term_rows(box, pixels, channels))

    def _term_rows(
        self, box: CameraBox, pixels: npt.NDArray[np.int64], channels: tuple[int, ...]
    ) -> sp.csr_matrix[np.float64]:
        y, x = np.mgrid[box.top : box.bottom, box.left : box.right]
        in_box = (y * self.camera_shape[1] + x).ravel()
        total = sp.csr_matrix((len(channels) * in_box.size, len(channels) * pixels.size))
        for n, term in enumerate(self.terms):
            span = self.span(n)
            mine = np.flatnonzero((pixels >= span.start) & (pixels < span.stop))
            _, row, place = np.intersect1d(in_box, term.camera, assume_unique=True, return_indices=True)
            if not (row.size and mine.size):
                continue
            near = sp.csc_matrix(term.differences[place], dtype=np.float64)[:, pixels[mine] - span.start]
            spread = sp.csr_matrix((np.ones(row.size), (row, np.arange(row.size))), shape=(in_box.size, row.size))
            chosen = sp.csr_matrix((np.ones(mine.size), (np.arange(mine.size), mine)), shape=(mine.size, pixels.size))
            blocks = []
            for c in channels:
                seen = spread @ sp.diags_array(term.white[c, place].astype(np.float64)) @ near @ chosen
                parts = [sp.csr_matrix(seen * float(self.mixing[n, c, d])) for d in channels]
                blocks.append(sp.hstack(parts, format="csr"))
            total = sp.csr_matrix(total + sp.vstack(blocks, format="csr"))
        return total

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """All that the products depend on, by name."""
        of_model = {f"model-{name}": array for name, array in self.model.arrays().items()}
        return {**of_model, **term_arrays(self.terms)}


_PARTS: Final = ("data", "indices", "indptr", "camera", "white")


def term_arrays(terms: Sequence[EdgeTerm]) -> dict[str, npt.NDArray[Any]]:
    """Terms as plain arrays by name."""
    found: dict[str, npt.NDArray[Any]] = {}
    for n, term in enumerate(terms):
        matrix = term.differences
        parts: list[npt.NDArray[Any]] = [matrix.data, matrix.indices, matrix.indptr, term.camera, term.white]
        found |= {f"edges-{n}-{name}": part for name, part in zip(_PARTS, parts, strict=True)}
    return found


def terms_from(
    arrays: Mapping[str, npt.NDArray[Any]], sizes: Sequence[tuple[int, int]], numbers: Sequence[int] | None = None
) -> tuple[EdgeTerm, ...]:
    """Terms from ``term_arrays``; ``sizes`` (rows, columns) of the projectors. Raises KeyError where one is missing.

    ``numbers``: which of the terms that were given to ``term_arrays``, in this order; None: all
    """
    terms = []
    for n, (rows, columns) in zip(range(len(sizes)) if numbers is None else numbers, sizes, strict=True):
        data, indices, indptr, camera, white = (arrays[f"edges-{n}-{name}"] for name in _PARTS)
        matrix = sp.csr_matrix((data, indices, indptr), shape=(len(camera), rows * columns))
        terms.append(EdgeTerm(matrix, camera, white))
    return tuple(terms)


def with_terms(model: LightTransport, terms: tuple[EdgeTerm, ...]) -> EdgedTransport:
    """``model`` with the measurement at depth edges; one term for each projector."""
    return EdgedTransport(
        model.mixing, model.lit, model.per_weight, model.sizes, model, terms, segments=model.segments,
        beside=model.beside,
    )  # fmt: skip


def edge_term(model: LightTransport, n: int, measured: EdgeShares, white: FloatImage) -> EdgeTerm:
    """The term of projector ``n``; it belongs to this very model.

    ``measured``: without measurements the term is empty; ``white`` (rows, columns, 3) its white image, finite
    """
    rows, columns = measured.pattern.shape
    lit = model.lit[n].ravel()[measured.camera]
    camera, projector, share = (part[lit] for part in (measured.camera, measured.projector, measured.share))
    difference = share - _modelled(model, n, measured.pattern, camera, projector, white)
    difference, noise = _shrunk(np.clip(difference, -MOST, MOST))
    # Small differences of small shares only cost time in every product.
    _, row = np.unique(camera, return_inverse=True)
    largest = np.zeros(int(row.max(initial=-1)) + 1, np.float32)
    np.maximum.at(largest, row, np.abs(difference))
    kept = ((np.abs(difference) > noise) | (share > LEAST_SHARE)) & (largest[row] > LEAST_CHANGE)
    camera, projector, share, difference = (part[kept] for part in (camera, projector, share, difference))
    own, row = np.unique(camera, return_inverse=True)
    # The rows' sums are taken back where light was measured, in proportion to it.
    weight = np.maximum(share, 0)
    sums, weights = (np.bincount(row, weights=part, minlength=own.size) for part in (difference, weight))
    back = np.divide(sums, weights, out=np.zeros(own.size), where=weights > 0)
    difference = np.where(weights[row] > 0, difference - back[row] * weight, 0).astype(np.float32)
    matrix = sp.csr_matrix((difference, (row, projector)), shape=(own.size, rows * columns), dtype=np.float32)
    return EdgeTerm(matrix, own.astype(np.int64), image_planes(white).reshape(3, -1)[:, own])


def _modelled(
    transport: LightTransport,
    n: int,
    pattern: npt.NDArray[np.int16],
    camera: npt.NDArray[np.int32],
    projector: npt.NDArray[np.int32],
    white: FloatImage,
) -> npt.NDArray[np.float32]:
    """The model's share for each measurement: its own pictures of the dots, divided by white."""
    found = np.zeros(camera.size, np.float32)
    full = channels.total(white).ravel()
    shown_in = pattern.ravel()[projector]
    for number in range(int(pattern.max(initial=-1)) + 1):
        mine = shown_in == number
        if mine.any():
            lit = np.repeat((pattern == number).astype(np.float32)[..., None], 3, axis=2)
            light = channels.total(transport.forward_part(n, lit)).ravel()
            found[mine] = light[camera[mine]] / full[camera[mine]]
    return found


def _shrunk(difference: npt.NDArray[np.float32]) -> tuple[npt.NDArray[np.float32], float]:
    """Without differences of the size of the noise, which is estimated from the many small differences."""
    if not difference.size:
        return difference, 0.0
    noise = 1.4826 * float(np.median(np.abs(difference)))
    power = difference.astype(np.float64) ** 2
    return np.asarray(difference * power / (power + (NOISES * noise) ** 2 + 1e-12), np.float32), noise
