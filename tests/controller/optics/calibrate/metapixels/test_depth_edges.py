"""Depth edges: which projector pixels, in how few pictures, and what each camera pixel saw of them."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.optics.calibrate.correspondence.decode import decode
from controller.optics.calibrate.metapixels.depth_edges import edge_frame, edge_patterns, edge_pixels, measure_shares
from controller.optics.calibrate.metapixels.from_dots import initial_metapixels
from controller.optics.capture.patterns import plan_patterns
from tests.controller.optics.calibrate.simulator import Scene, Stage, photographed

STEP = Scene(camera_px=(120, 96), projector_px=(64, 40), step_px=9.0)
PLAIN = Scene(camera_px=(120, 96), projector_px=(48, 40))


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 1000), share=st.floats(0.0, 1.0), spacing=st.integers(2, 9))
def test_pixels_of_one_picture_keep_their_distance_and_a_whole_grid_is_never_exceeded(
    seed: int, share: float, spacing: int
) -> None:
    lit = np.random.default_rng(seed).random((23, 31)) < share
    pattern = edge_patterns(lit, spacing)
    np.testing.assert_array_equal(pattern >= 0, lit)
    assert pattern.max(initial=-1) < spacing**2
    for number in range(int(pattern.max(initial=-1)) + 1):
        at = np.argwhere(pattern == number)
        assert len(at) > 0
        apart = np.abs(at[:, None] - at[None]).max(axis=2) + spacing * np.eye(len(at), dtype=int)
        assert apart.min() >= spacing


def test_a_thin_edge_needs_far_fewer_pictures_than_a_grid() -> None:
    lit = np.zeros((100, 100), np.bool_)
    lit[:, 48:52] = True
    assert edge_patterns(lit, 16).max() + 1 == 4 * 16


def test_pixels_at_a_step_are_found_and_few_others() -> None:
    correspondence = decode(photographed(STEP), plan_patterns(STEP.projector_px))
    found = edge_pixels(initial_metapixels(correspondence, STEP.projector_px), correspondence)
    at = correspondence.projector_px[correspondence.valid]
    edge = 0.6 * (STEP.camera_px[0] - 1)
    left, right = (correspondence.projector_px[30:66, int(edge + d)][..., 0] for d in (-3, 4))
    rows = correspondence.projector_px[30:66, int(edge - 3)][..., 1]
    for x, y in zip(np.concatenate([left, right]), np.concatenate([rows, rows]), strict=True):
        if np.isfinite(x) and np.isfinite(y):
            assert found[round(float(y)), round(float(x))]
    middle = np.zeros_like(found)
    middle[12:28, 12:22] = True
    assert at.size > 0
    assert not found[middle].any()


def test_measured_shares_are_those_of_the_scene() -> None:
    stage = Stage(PLAIN)
    shape = (*PLAIN.projector_px[::-1], 3)
    black = stage.photograph(np.zeros(shape, np.uint8))
    white = np.mean([stage.photograph(np.full(shape, 255, np.uint8)) for _ in range(3)], axis=0) - black
    lit = np.zeros(shape[:2], np.bool_)
    lit[10::9, 12::9] = True
    frame = edge_frame(np.where(lit, 0, -1).astype(np.int16), 0)
    position = decode(photographed(PLAIN), plan_patterns(PLAIN.projector_px)).projector_px
    camera, projector, share = measure_shares(
        stage.photograph(frame), black, white.astype(np.float32), position, lit, 4
    )
    full = stage.light(np.ones(shape, np.float32)).sum(axis=2).ravel()
    dots = stage.light(np.repeat(lit[..., None], 3, axis=2).astype(np.float32)).sum(axis=2).ravel()
    true = np.divide(dots, full, out=np.zeros_like(dots), where=full > 0)
    bright = full[camera] > 0.3 * full.max()
    assert bright.sum() > 1000
    assert np.sqrt(np.mean((share - true[camera])[bright] ** 2)) < 0.01
    assert set(np.unique(projector)) <= set(np.flatnonzero(lit.ravel()))
