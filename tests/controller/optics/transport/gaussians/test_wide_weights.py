"""Weights of any extent: the products against the sparse matrix itself."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.core.arrays import Float64
from controller.core.errors import UsageError
from controller.optics.calibrate.values import Calibration, Metapixels, ProjectorCalibration, Radiometry
from controller.optics.transport import LightTransport, build_transport
from controller.optics.transport.gaussians import patches
from controller.optics.transport.gaussians.patches import FULL_WEIGHT, patches_of_weights
from tests.controller.optics.transport.conftest import random_frames

SIZES = ((3, 4), (2, 5))
Weights = list[sp.csr_matrix]


def weights_of(
    shape: tuple[int, int], extents: list[tuple[float, float]], *, dots: int, rng: np.random.Generator
) -> Weights:
    """One matrix a projector: each column has ``dots`` weights in a box of ``extents`` (shares of the image's sides).

    Weights are whole 65535ths, as they are stored, so that nothing is lost by rounding; one column is empty.
    """
    found, boxes = [], iter(extents)
    for rows, columns in SIZES:
        at, pixel, value = [], [], []
        for v in range(1, rows * columns):
            high, wide = (max(1, round(share * side)) for share, side in zip(next(boxes), shape, strict=True))
            top, left = rng.integers(shape[0] - high + 1), rng.integers(shape[1] - wide + 1)
            y, x = rng.integers(high, size=dots), rng.integers(wide, size=dots)
            y[:2], x[:2] = (0, high - 1), (0, wide - 1)
            places = np.unique((top + y) * shape[1] + left + x)
            at.append(places)
            pixel.append(np.full(places.size, v))
            value.append(rng.integers(1, FULL_WEIGHT + 1, places.size) / FULL_WEIGHT)
        entries = (np.concatenate(value), (np.concatenate(at), np.concatenate(pixel)))
        found.append(sp.csr_matrix(entries, shape=(shape[0] * shape[1], rows * columns)))
    return found


def calibration_of(shape: tuple[int, int], rng: np.random.Generator) -> Calibration:
    projectors = []
    for n, size in enumerate(SIZES):
        mixing = np.eye(3) + rng.uniform(0, 0.1, (3, 3))
        nowhere = Metapixels(
            np.zeros((*size, 2), np.float32), np.ones((*size, 3), np.float32), np.zeros(size, np.bool_)
        )
        white = rng.uniform(0.1, 2, (*shape, 3)).astype(np.float32)
        white[rng.random(shape) < 0.1] = 0
        linear = Radiometry(np.tile(np.linspace(0, 1, 256), (3, 1)), mixing)
        projectors.append(ProjectorCalibration(f"projector {n}", nowhere, linear, white))
    mask = rng.random(shape) > 0.05
    return Calibration(tuple(projectors), np.zeros((*shape, 3), np.float32), mask, np.eye(3))


def matrices(calibration: Calibration, weights: Weights) -> list[sp.csr_matrix]:
    """T of each projector, (camera pixels * 3, projector pixels * 3), colours innermost, made of matrices alone."""
    found = []
    for part, own in zip(calibration.projectors, weights, strict=True):
        total = np.asarray(own.sum(axis=1)).ravel()
        lit = calibration.object_mask.ravel() & (total > 0) & (part.white.max(axis=2).ravel() > 0)
        shares = sp.diags_array(np.divide(1.0, total, out=np.zeros_like(total), where=lit)) @ own
        white = sp.diags_array(part.white.reshape(-1).astype(np.float64))
        found.append(sp.csr_matrix(white @ sp.kron(shares, part.radiometry.mixing)))
    return found


def check_against_matrices(transport: LightTransport, truth: list[sp.csr_matrix], seed: int) -> None:
    frames = random_frames(transport, seed)
    wanted: Float64 = np.sum([T @ p.reshape(-1) for T, p in zip(truth, frames, strict=True)], axis=0)
    light = transport.forward(frames)
    np.testing.assert_allclose(light.reshape(-1), wanted, rtol=1e-4, atol=1e-5)
    r = np.random.default_rng(seed).standard_normal((*transport.camera_shape, 3)).astype(np.float32)
    for T, back in zip(truth, transport.adjoint(r), strict=True):
        np.testing.assert_allclose(back.reshape(-1), T.T @ r.reshape(-1).astype(np.float64), rtol=1e-3, atol=1e-3)


share = st.floats(0.0, 1.0)


@settings(max_examples=15, deadline=None)
@given(
    rows=st.integers(20, 600),
    columns=st.integers(20, 700),
    extents=st.lists(st.tuples(share, share), min_size=20, max_size=20),
    dots=st.integers(2, 60),
    seed=st.integers(0, 1000),
)
def test_products_are_those_of_the_matrix_whatever_its_columns_span(
    rows: int, columns: int, extents: list[tuple[float, float]], dots: int, seed: int
) -> None:
    rng, shape = np.random.default_rng(seed), (rows, columns)
    calibration, weights = calibration_of(shape, rng), weights_of(shape, extents, dots=dots, rng=rng)
    transport = build_transport(calibration, patches=patches_of_weights(weights, shape))
    check_against_matrices(transport, matrices(calibration, weights), seed)


@pytest.mark.parametrize(("high", "wide"), [(254, 246), (255, 247), (256, 248), (257, 2041), (40, 2039)])
def test_columns_around_every_limit_of_what_is_stored_are_lit(high: int, wide: int) -> None:
    rng, shape = np.random.default_rng(0), (high + 2, wide + 3)
    extents = [(high / shape[0], wide / shape[1])] * 20
    calibration, weights = calibration_of(shape, rng), weights_of(shape, extents, dots=30, rng=rng)
    patches = patches_of_weights(weights, shape)
    assert (patches.margin[0], patches.margin[1]) == (high, -(-wide // 8) * 8)
    check_against_matrices(build_transport(calibration, patches=patches), matrices(calibration, weights), 0)


def test_narrow_weights_are_stored_as_metapixels_are() -> None:
    rng, shape = np.random.default_rng(2), (400, 400)
    patches = patches_of_weights(weights_of(shape, [(0.1, 0.1)] * 20, dots=9, rng=rng), shape)
    assert patches.rows.dtype == patches.groups.dtype == np.uint8


def test_weights_that_would_take_all_memory_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, shape = np.random.default_rng(3), (300, 300)
    weights = weights_of(shape, [(1.0, 1.0)] * 20, dots=2, rng=rng)
    monkeypatch.setattr(patches, "MOST_BYTES", 1 << 20)
    with pytest.raises(UsageError) as refused:
        patches_of_weights(weights, shape)
    assert refused.value.code == "weights-too-wide"
    assert "300 x 304" in refused.value.what
