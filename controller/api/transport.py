"""The light transport of a calibration, or of your own sparse matrices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, as_light
from controller.core.errors import UsageError
from controller.optics.calibrate.values import Calibration, Geometry, Metapixels, ProjectorCalibration, Radiometry
from controller.optics.transport import LightTransport, factory
from controller.optics.transport.gaussians.patches import patches_of_weights
from controller.optics.transport.indirect.fit import fit_indirect
from controller.optics.transport.indirect.indirect_light import IndirectLight
from controller.stage.exchange.pairs import fitted

LINEAR = Radiometry(np.tile(np.linspace(0, 1, 256), (3, 1)), np.eye(3))


def build_transport(calibration: Calibration) -> LightTransport:
    """The light transport T of a calibration: camera picture = black + T p (paper 2.1, eq. 1; 4.2.3).

    For projector n with the picture p_n, T_n p_n = W_n (.) G_n (p_n M_n'): W_n is its white image, M_n its colour
    mixing, and G_n gives the share of each camera pixel's light that comes from each projector pixel.

    Parameters
    ----------
    calibration : of ``calibrate`` or ``read_run``, or made of arrays. If every projector has a phase map, the shares
        come from it, else from the metapixels' Gaussians

    Returns
    -------
    ``LightTransport`` with ``forward(frames)``, the picture T p (camera rows, columns, 3) of one (rows, columns, 3)
    frame a projector; ``adjoint(picture)``, one (rows, columns, 3) image a projector; ``reach()``, the light with every
    projector at white; ``lit`` (projectors, camera rows, columns) bool; ``object_mask`` (camera rows, columns) bool;
    ``sizes``, the (rows, columns) of each projector. All images are float32

    Errors: ``calibration-inconsistent``.
    """
    return factory.build_transport(calibration)


def indirect_light(
    calibration: Calibration, transport: LightTransport, geometry: Geometry | None = None
) -> IndirectLight | None:
    """The light that arrives by way of other surfaces, G: camera picture = black + d + G d, with d = T p.

    Parameters
    ----------
    calibration : of ``calibrate`` with ``indirect=True``, or of ``read_run``
    transport : of ``build_transport`` for this calibration
    geometry : of ``read_run``; with it G follows the shape of the surface, without it only what lies near

    Returns
    -------
    ``IndirectLight`` with ``forward(direct)``, the indirect light G d of a direct picture d, ``adjoint(picture)``, and
    ``direct_target(total)``, the d with d + G d = ``total`` where projectors light the object. All are (camera rows,
    columns, 3) float32, without the black image. It also corrects colours that depend on the paint. None where a
    projector has no ``indirect`` light and no colour depends on the paint
    """
    points_m, normals = (None, None) if geometry is None else (geometry.points_m, geometry.normals)
    return fit_indirect(calibration, transport.object_mask, points_m, normals)


def transport_from_matrices(
    matrices: Sequence[Any],
    camera_px: tuple[int, int],
    projectors_px: Sequence[tuple[int, int]],
    *,
    whites: Sequence[npt.ArrayLike] | None = None,
    mixing: npt.ArrayLike | None = None,
) -> LightTransport:
    """A light transport from your own sparse matrices: T_n p_n = A_n (p_n M_n') in each channel (paper 2.1, eq. 1).

    An entry is stored as a 16-bit share of the largest in its row, so that T differs from A by about 1/131070 of that
    entry. The box of camera pixels that one projector pixel lights is stored whole: light that is spread over much of
    the picture takes much memory and time.

    Parameters
    ----------
    matrices : one ``scipy.sparse`` matrix or array (camera pixels, projector pixels) a projector, finite, at least 0;
        pixels are counted row by row. An entry is the camera's light for a projector pixel at full light. With
        ``whites``, only the ratios within a row count
    camera_px : (width, height) of the camera picture
    projectors_px : (width, height) of each projector
    whites : light of each projector at white, (camera rows, columns, 3) float32, at least 0; without it, the sums of
        the rows, in all three channels
    mixing : (projectors, 3, 3), camera channel by projector channel, each row adds up to 1; without it, each camera
        channel sees its own channel alone

    Returns
    -------
    ``LightTransport``, as ``build_transport``

    Errors: ``weights-wrong``, ``weights-too-wide``, ``calibration-inconsistent``.
    """
    shape = (camera_px[1], camera_px[0])
    rows = [_matrix(matrix, shape, size) for matrix, size in zip(matrices, projectors_px, strict=True)]
    light = [_row_sums(matrix, shape) for matrix in rows] if whites is None else [as_light(white) for white in whites]
    mixed = np.broadcast_to(np.eye(3), (len(rows), 3, 3)) if mixing is None else np.asarray(mixing, np.float64)
    parts = tuple(
        ProjectorCalibration(str(n), _without_metapixels(size), Radiometry(LINEAR.response, mixed[n]), white)
        for n, (size, white) in enumerate(zip(projectors_px, light, strict=True))
    )
    mask = np.any([channels.largest(white) > 0 for white in light], axis=0)
    calibration = Calibration(parts, np.zeros((*shape, 3), np.float32), mask, np.eye(3))
    patches = patches_of_weights([_largest_one(matrix) for matrix in rows], shape)
    return factory.build_transport(calibration, patches=patches)


@dataclass(frozen=True, slots=True)
class PairTransport:
    """``transport_from_pairs``: ``transport``; ``black`` (camera rows, columns, 3) float32, light without projectors.

    ``explained`` (camera rows, columns): share of the changes of light in pairs that were left out, at most 1; pixels
    below 0.5 have no light of projectors. ``error``: rms of the others in these pairs, by their light
    """

    transport: LightTransport
    black: FloatImage
    explained: Float64
    error: float


def transport_from_pairs(projected: Sequence[npt.ArrayLike], photographs: npt.ArrayLike) -> PairTransport:
    """A light transport from N pairs of any pictures that were shown and photographed, without a code.

    Each camera pixel gets a window of 5 x 5 pixels of each projector, found from coarse to fine, and bounded
    least-squares weights in it. On an emulated stage (see Use the solver on your own data) 200 pairs of one projector
    predict a new picture to 2 %, 250 pairs of two projectors to 7 %. Indirect light is not modelled.

    Parameters
    ----------
    projected : for each projector (N, rows, columns, 3) linear light, 0 to 1, of all pairs
    photographs : (N, camera rows, columns, 3) linear light, NaN where saturated

    Returns
    -------
    ``PairTransport``

    Errors: ``pairs-too-few``, ``pairs-undetermined``.
    """
    shown, seen = [as_light(one) for one in projected], as_light(photographs)
    fit = fitted(shown, seen)
    shape = seen.shape[1:]
    transport = transport_from_matrices(
        fit.shares,
        (shape[1], shape[0]),
        [(one.shape[2], one.shape[1]) for one in shown],
        whites=[white.reshape(shape) for white in fit.whites],
        mixing=fit.mixing,
    )
    return PairTransport(transport, fit.black.reshape(shape), fit.explained.reshape(shape[:2]), fit.error)


def _matrix(matrix: Any, camera: tuple[int, int], projector_px: tuple[int, int]) -> sp.csr_matrix[np.float64]:
    found = sp.csr_matrix(matrix, dtype=np.float64)
    wanted = (camera[0] * camera[1], projector_px[0] * projector_px[1])
    if found.shape != wanted or not np.isfinite(found.data).all() or found.data.min(initial=0) < 0:
        raise UsageError(
            "weights-wrong",
            what=f"A matrix is not {wanted[0]} x {wanted[1]} finite numbers of at least 0; it is "
            f"{found.shape[0]} x {found.shape[1]}.",
            remedy="Give one row for each camera pixel and one column for each projector pixel, counted row by row.",
        )
    found.sum_duplicates()
    return found


def _row_sums(matrix: sp.csr_matrix[np.float64], camera: tuple[int, int]) -> FloatImage:
    sums = np.asarray(matrix.sum(axis=1), np.float32).reshape(camera)
    return np.repeat(sums[:, :, None], 3, axis=2)


def _largest_one(matrix: sp.csr_matrix[np.float64]) -> sp.csr_matrix[np.float64]:
    """Each row divided by its largest entry."""
    largest = matrix.max(axis=1).toarray().ravel()
    inverse = np.divide(1, largest, out=np.zeros_like(largest), where=largest > 0)
    scaled = sp.csr_matrix(sp.diags_array(inverse) @ matrix)
    np.minimum(scaled.data, 1, out=scaled.data)  # rounding
    return scaled


def _without_metapixels(projector_px: tuple[int, int]) -> Metapixels:
    """Metapixels with only the projector's size: the shares come from the matrices."""
    shape = (projector_px[1], projector_px[0])
    nothing = np.full((*shape, 3), np.nan, np.float32)
    return Metapixels(nothing[..., :2], nothing, np.zeros(shape, np.bool_))
