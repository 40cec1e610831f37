"""A transport that was corrected at depth edges by what dots say there."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp

from controller.optics.calibrate.metapixels.depth_edges import EdgeShares, edge_patterns
from controller.optics.calibrate.values import Calibration
from controller.optics.transport import build_transport
from controller.optics.transport.edge_terms import (
    EdgedTransport,
    EdgeTerm,
    edge_term,
    term_arrays,
    terms_from,
    with_terms,
)
from tests.controller.optics.transport.conftest import random_calibration
from tests.controller.optics.transport.sparse_shares import gaussian_weights, normalised

CAMERA = (60, 80)


def two_surfaces() -> tuple[Calibration, list[sp.csr_matrix[np.float64]], EdgeShares]:
    """A projector 12x16 on one surface; columns 7 and 8 fall on a second place as well. Shares without noise."""
    calibration = random_calibration(1, camera=CAMERA, sizes=((12, 16),), masked=False)
    part = calibration.projectors[0]
    y, x = np.mgrid[0:12, 0:16].astype(np.float32)
    near = dataclasses.replace(
        part.metapixels,
        centre_px=np.stack([4 * x + 6, 4 * y + 6], axis=-1),
        covariance_px2=np.broadcast_to(np.array([4, 0, 4], np.float32), (12, 16, 3)).copy(),
        valid=np.ones((12, 16), np.bool_),
    )
    far = dataclasses.replace(near, centre_px=near.centre_px + np.array([4, 1], np.float32), valid=(x == 7) | (x == 8))
    truth = normalised(gaussian_weights(near, CAMERA) + 0.6 * gaussian_weights(far, CAMERA))
    white = np.random.default_rng(2).uniform(0.2, 1, (*CAMERA, 3)).astype(np.float32)
    part = dataclasses.replace(part, metapixels=near, white=white)
    pattern = edge_patterns((x > 4) & (x < 12), 6)
    dots = truth.tocoo()
    on_edge = pattern.ravel()[dots.col] >= 0
    measured = EdgeShares(
        dots.row[on_edge].astype(np.int32),
        dots.col[on_edge].astype(np.int32),
        dots.data[on_edge].astype(np.float32),
        pattern,
    )
    return dataclasses.replace(calibration, projectors=(part,)), [truth], measured


def edged_of(calibration: Calibration, measured: EdgeShares) -> EdgedTransport:
    model = build_transport(calibration)
    return with_terms(model, (edge_term(model, 0, measured, calibration.projectors[0].white),))


def test_measured_shares_bring_the_prediction_to_the_truth_at_edges() -> None:
    calibration, (truth,), measured = two_surfaces()
    part = calibration.projectors[0]
    model, edged = build_transport(calibration), edged_of(calibration, measured)
    p = np.random.default_rng(3).random((12, 16, 3)).astype(np.float32)
    lit = model.lit[0]
    light = np.asarray(truth @ (p.reshape(-1, 3) @ part.radiometry.mixing.T))
    real = (part.white * light.reshape(*CAMERA, 3))[lit]
    before, after = (np.sqrt(np.mean((t.forward_part(0, p)[lit] - real) ** 2)) for t in (model, edged))
    assert after < 0.35 * before


def test_white_stays_white() -> None:
    calibration, _, measured = two_surfaces()
    edged = edged_of(calibration, measured)
    lit = edged.lit[0]
    np.testing.assert_allclose(edged.reach()[lit], calibration.projectors[0].white[lit], rtol=1e-5)


def test_the_adjoint_is_the_transpose() -> None:
    calibration, _, measured = two_surfaces()
    edged = edged_of(calibration, measured)
    random = np.random.default_rng(4)
    p = random.random((12, 16, 3)).astype(np.float32)
    r = random.standard_normal((*CAMERA, 3)).astype(np.float32)
    one = float(np.sum(edged.forward([p]).astype(np.float64) * r))
    other = float(np.sum(p.astype(np.float64) * edged.adjoint(r)[0]))
    assert one == pytest.approx(other, rel=1e-4)


def test_one_projectors_part_of_the_transpose_is_its_own_pixels() -> None:
    calibration = random_calibration(8, camera=CAMERA, sizes=((12, 16), (7, 5)))
    model = build_transport(calibration)
    random = np.random.default_rng(8)
    terms = []
    for n, (rows, columns) in enumerate(model.sizes):
        camera = np.flatnonzero(model.lit[n])[:20]
        share = sp.random_array((20, rows * columns), density=0.1, rng=random, dtype=np.float32)
        terms.append(EdgeTerm(sp.csr_matrix(share), camera, random.random((3, 20), np.float32)))
    r = random.standard_normal((3, *CAMERA)).astype(np.float32)
    for transport in (model, with_terms(model, tuple(terms))):
        whole = transport.adjoint_planes(r)
        for n in range(2):
            part = np.full_like(whole, -7)
            transport.adjoint_of_buffer(n, r.reshape(-1), part)
            np.testing.assert_allclose(part[:, transport.span(n)], whole[:, transport.span(n)], rtol=1e-5, atol=1e-5)
            assert (np.delete(part, np.r_[transport.span(n)], axis=1) == -7).all()


def test_magnitudes_bound_every_product() -> None:
    calibration, _, measured = two_surfaces()
    edged = edged_of(calibration, measured)
    bound = edged.with_absolute_mixing()
    p = np.random.default_rng(5).random((12, 16, 3)).astype(np.float32)
    assert (np.abs(edged.forward([p])) <= bound.forward([p]) + 1e-5).all()


def test_nothing_measured_changes_nothing() -> None:
    calibration, _, measured = two_surfaces()
    nothing = EdgeShares(
        np.empty(0, np.int32), np.empty(0, np.int32), np.empty(0, np.float32), np.full_like(measured.pattern, -1)
    )
    p = np.random.default_rng(6).random((12, 16, 3)).astype(np.float32)
    model = build_transport(calibration)
    np.testing.assert_array_equal(edged_of(calibration, nothing).forward_part(0, p), model.forward_part(0, p))


def test_terms_come_back_from_their_arrays(tmp_path: Path) -> None:
    calibration, _, measured = two_surfaces()
    edged = edged_of(calibration, measured)
    terms = terms_from(term_arrays(edged.terms), edged.sizes)
    again = with_terms(edged.model, terms)
    p = np.random.default_rng(7).random((12, 16, 3)).astype(np.float32)
    np.testing.assert_array_equal(again.forward_part(0, p), edged.forward_part(0, p))
    np.testing.assert_array_equal(terms[0].differences.toarray(), edged.terms[0].differences.toarray())
