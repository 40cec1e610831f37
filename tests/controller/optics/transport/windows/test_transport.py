"""The light transport by camera samples, against the definition written out and interpolated by plain loops."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numba
import numpy as np
import numpy.typing as npt
import pytest
import scipy.sparse as sp
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from controller.core.errors import UsageError
from controller.optics.calibrate.values import Calibration, PhaseMap
from controller.optics.capture.raw import develop
from controller.optics.transport import build_transport
from controller.optics.transport.gaussians.transport import PatchTransport
from controller.optics.transport.planes import CameraBox
from controller.optics.transport.windows.profiles import SORTS
from controller.optics.transport.windows.transport import WindowTransport
from tests.controller.optics.transport.conftest import products, random_frames
from tests.controller.optics.transport.sparse_shares import phase_map_shares

Stage = Callable[..., Calibration]
Floats = npt.NDArray[np.float32]
RGGB = np.array([[0, 1], [1, 2]])
slow_start = settings(
    max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True
)


def developed(sites: Floats, colours: npt.NDArray[np.int64]) -> Floats:
    """What the controller's development makes of a mosaic of samples in [0, 1]."""
    raw = np.rint(sites * 65535).astype(np.uint16)
    return develop(raw, colours, np.zeros((2, 2)), np.full((2, 2), 65535.0)).image


def mapped(
    calibration: Calibration, seed: int, *, mosaic: npt.NDArray[np.int64] | None = RGGB, ordered: bool = False
) -> Calibration:
    """The stage with phase maps: without any order unless ``ordered``, partly off the frame, partly unknown."""
    rng = np.random.default_rng(seed)
    shape = calibration.object_mask.shape
    parts = []
    for part in calibration.projectors:
        rows, columns = part.metapixels.valid.shape
        if ordered:
            y, x = np.mgrid[0 : shape[0], 0 : shape[1]]
            position = np.stack([x * columns / shape[1] + 0.1 * y - 1, y * rows / shape[0] - 0.5], -1)
        else:
            position = rng.uniform((-3, -3), (columns + 2, rows + 2), (*shape, 2))
            position[rng.random(shape) < 0.1] = np.nan
        xx, yy = rng.uniform(0.05, 3, (2, rows, columns))
        xy = rng.uniform(-0.8, 0.8, (rows, columns)) * np.minimum(xx, yy)
        spread = np.stack([xx, xy, yy], -1)
        if not ordered:
            spread[0, 0] = np.nan
        white = part.white
        if mosaic is not None:
            white = developed(rng.uniform(0.1, 1, shape).astype(np.float32), mosaic)
        phase_map = PhaseMap(position.astype(np.float32), spread.astype(np.float32))
        parts.append(dataclasses.replace(part, phase_map=phase_map, white=white))
    return dataclasses.replace(calibration, projectors=tuple(parts), mosaic=mosaic)


def on_frame(calibration: Calibration) -> Calibration:
    """The same stage with every camera pixel looking at the frame, lit."""
    parts = []
    for part in calibration.projectors:
        assert part.phase_map is not None
        rows, columns = part.metapixels.valid.shape
        inside = np.clip(part.phase_map.projector_px, 0, [columns - 1, rows - 1]).astype(np.float32)
        phase_map = PhaseMap(inside, part.phase_map.spread_px2)
        parts.append(dataclasses.replace(part, phase_map=phase_map, white=np.maximum(part.white, 1e-3)))
    return dataclasses.replace(calibration, projectors=tuple(parts))


def expected(calibration: Calibration, frames: list[Floats]) -> Floats:
    """The model from SciPy's sparse shares and the controller's own development."""
    shape = calibration.object_mask.shape
    total = np.zeros((*shape, 3), np.float64)
    for part, frame in zip(calibration.projectors, frames, strict=True):
        assert part.phase_map is not None
        shares = phase_map_shares(part.phase_map)
        light = np.asarray(shares @ (frame.reshape(-1, 3).astype(np.float64) @ part.radiometry.mixing.T)).reshape(
            *shape, 3
        )
        total += part.white * light
    if calibration.mosaic is None:
        return total.astype(np.float32)
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]]
    sites = np.take_along_axis(total, calibration.mosaic[y & 1, x & 1][..., None], axis=2)[..., 0]
    largest = sites.max()
    return developed((sites / largest).astype(np.float32), calibration.mosaic) * np.float32(largest)


def apart(calibration: Calibration, seed: int) -> Calibration:
    """The same stage with each projector's colours up to half a pixel beside each other."""
    rng = np.random.default_rng(seed)
    parts = []
    for part in calibration.projectors:
        assert part.phase_map is not None
        phase_map = dataclasses.replace(part.phase_map, colours_px=rng.uniform(-0.5, 0.5, (3, 2)))
        parts.append(dataclasses.replace(part, phase_map=phase_map))
    return dataclasses.replace(calibration, projectors=tuple(parts))


def whites(calibration: Calibration) -> Floats:
    """All projectors' white images together, at the pixels of the object."""
    total: Floats = np.sum([part.white for part in calibration.projectors], axis=0)
    return total[calibration.object_mask]


@pytest.mark.parametrize("mosaic", [None, RGGB, np.array([[1, 2], [0, 1]])], ids=["none", "RGGB", "GBRG"])
def test_a_product_follows_the_definition_of_the_model(stage: Stage, mosaic: npt.NDArray[np.int64] | None) -> None:
    calibration = on_frame(mapped(stage(1, masked=False, sizes=((40, 50), (17, 15))), 1, mosaic=mosaic, ordered=True))
    transport = build_transport(calibration)
    assert isinstance(transport, WindowTransport)
    frames = random_frames(transport)
    got, wanted = transport.forward(frames), expected(calibration, frames)
    # blur is rounded by up to 1 %, places to 1/512 pixel, the cut is square instead of elliptical
    error = np.sqrt(np.mean((got - wanted) ** 2) / np.mean(wanted**2))
    assert error < 0.01


@pytest.mark.parametrize("mosaic", [None, RGGB], ids=["none", "RGGB"])
@pytest.mark.parametrize(("mixed", "limit"), [(False, 0.01), (True, 0.02)], ids=["colours", "mixed, in grey"])
def test_colours_that_lie_apart_follow_windows_of_their_own(
    stage: Stage, mosaic: npt.NDArray[np.int64] | None, mixed: bool, limit: float
) -> None:
    """The oracle has a window for each colour of the projector in each of the camera; the transport joins the three.

    That is exact where the camera does not mix them. Where it does and they show the same, it is right in mean and
    variance of the places; uncorrected, the error is 0.07.
    """
    plain = on_frame(mapped(stage(5, masked=False, sizes=((40, 50), (17, 15))), 5, mosaic=mosaic, ordered=True))
    parts = []
    for part in plain.projectors:
        # samples of the oracle's development can't be negative
        mixing = np.abs(part.radiometry.mixing) if mixed else np.eye(3)
        mixing /= mixing.sum(axis=1, keepdims=True)
        assert part.phase_map is not None
        spread = part.phase_map.spread_px2
        # blur that changes from pixel to pixel, as no lens's does, would differ at the three places
        phase_map = PhaseMap(part.phase_map.projector_px, np.full_like(spread, (0.3, 0.1, 0.4)) if mixed else spread)
        radiometry = dataclasses.replace(part.radiometry, mixing=mixing)
        parts.append(dataclasses.replace(part, radiometry=radiometry, phase_map=phase_map))
    calibration = apart(dataclasses.replace(plain, projectors=tuple(parts)), 5)
    transport = build_transport(calibration)
    frames = random_frames(transport)
    if mixed:
        frames = [np.repeat(frame[..., :1], 3, axis=2) for frame in frames]
    wanted = np.zeros((*transport.camera_shape, 3), np.float32)
    for part, frame in zip(calibration.projectors, frames, strict=True):
        assert part.phase_map is not None
        assert part.phase_map.colours_px is not None
        for d in range(3):
            at = (part.phase_map.projector_px - part.phase_map.colours_px[d]).astype(np.float32)
            moved = dataclasses.replace(part, phase_map=PhaseMap(at, part.phase_map.spread_px2))
            only = np.zeros_like(frame)
            only[..., d] = frame[..., d]
            wanted += expected(dataclasses.replace(calibration, projectors=(moved,)), [only])
    off = (transport.forward(frames) - wanted)[20:-20, 20:-20]
    assert np.sqrt(np.mean(off**2) / np.mean(wanted[20:-20, 20:-20] ** 2)) < limit


def test_small_windows_follow_the_definition_whatever_their_skew(stage: Stage) -> None:
    calibration = on_frame(mapped(stage(14, masked=False, sizes=((40, 50), (70, 75))), 14, ordered=True))
    parts, rng = [], np.random.default_rng(14)
    for part in calibration.projectors:
        assert part.phase_map is not None
        xx, yy = rng.uniform(0.15, 0.45, (2, *part.metapixels.valid.shape))
        xy = rng.uniform(-0.6, 0.6, xx.shape) * np.sqrt(xx * yy)
        spread = np.stack([xx, xy, yy], -1).astype(np.float32)
        parts.append(dataclasses.replace(part, phase_map=PhaseMap(part.phase_map.projector_px, spread)))
    calibration = dataclasses.replace(calibration, projectors=tuple(parts))
    transport = build_transport(calibration)
    assert isinstance(transport, WindowTransport)
    upright, skewed, other = np.diff(transport.windows.first).reshape(-1, SORTS).sum(axis=0)
    assert min(upright, skewed) > 100
    assert other < 0.2 * skewed
    frames = random_frames(transport)
    got, wanted = transport.forward(frames), expected(calibration, frames)
    assert np.sqrt(np.mean((got - wanted) ** 2) / np.mean(wanted**2)) < 0.01
    np.testing.assert_allclose(transport.reach()[transport.object_mask], whites(calibration), rtol=2e-5)


@slow_start
@given(seed=st.integers(0, 2**31), masked=st.booleans(), mosaic=st.booleans(), sharp=st.booleans(), aside=st.booleans())
def test_the_adjoint_is_the_transpose_for_any_geometry(
    stage: Stage, seed: int, masked: bool, mosaic: bool, sharp: bool, aside: bool
) -> None:
    calibration = mapped(stage(seed, masked=masked, sizes=((70, 90), (7, 5))), seed, mosaic=RGGB if mosaic else None)
    if sharp:
        parts = [
            dataclasses.replace(
                p, phase_map=PhaseMap(p.phase_map.projector_px, np.float32(0.1) * p.phase_map.spread_px2)
            )
            for p in calibration.projectors
            if p.phase_map is not None
        ]
        calibration = dataclasses.replace(calibration, projectors=tuple(parts))
    transport = build_transport(apart(calibration, seed) if aside else calibration)
    frames = random_frames(transport, seed)
    r = np.random.default_rng(seed + 1).random((*transport.camera_shape, 3), np.float32)
    forward, backward = products(transport, frames, r)
    assert forward == pytest.approx(backward, rel=2e-6)


@slow_start
@given(seed=st.integers(0, 2**31), mosaic=st.booleans())
def test_a_projector_at_white_reproduces_its_white_image_where_lit(stage: Stage, seed: int, mosaic: bool) -> None:
    calibration = mapped(stage(seed, sizes=((9, 12), (70, 75))), seed, mosaic=RGGB if mosaic else None)
    transport = build_transport(calibration)
    for n, projector in enumerate(calibration.projectors):
        light = transport.forward_part(n, np.ones((*transport.sizes[n], 3), np.float32))
        lit = transport.lit[n]
        assert lit.any()
        # where a sample is missing within the tolerance for "lit", so is its light
        assert np.all(light[lit] <= projector.white[lit] * (1 + 1e-4))
        assert np.all(light[lit] >= projector.white[lit] * 0.9979)
        assert not lit[~calibration.object_mask].any()
    whole = sum(transport.forward_part(n, np.ones((*s, 3), np.float32)) for n, s in enumerate(transport.sizes))
    np.testing.assert_allclose(transport.reach(), whole, rtol=1e-5, atol=1e-6)


def test_with_every_sample_known_white_is_exact_to_rounding(stage: Stage) -> None:
    calibration = mapped(stage(2, masked=False), 2, ordered=True)
    transport = build_transport(on_frame(calibration))
    assert transport.lit.all()
    for n, part in enumerate(calibration.projectors):
        light = transport.forward_part(n, np.ones((*transport.sizes[n], 3), np.float32))
        np.testing.assert_allclose(light, part.white, rtol=2e-5)


def test_a_fold_sees_the_same_projector_pixels_twice(stage: Stage) -> None:
    """The left half of the picture, mirrored, is its right half: both must show the frame, and both must bear on it."""
    calibration = mapped(stage(3, masked=False, sizes=((40, 80),)), 3, mosaic=None, ordered=True)
    part = calibration.projectors[0]
    assert part.phase_map is not None
    half = part.phase_map.projector_px[:, :150]
    folded = np.concatenate([half, half[:, ::-1]], axis=1)
    white = np.ones_like(part.white)
    part = dataclasses.replace(part, phase_map=PhaseMap(folded, part.phase_map.spread_px2), white=white)
    transport = build_transport(dataclasses.replace(calibration, projectors=(part,)))
    light = transport.forward(random_frames(transport))
    np.testing.assert_allclose(light[:, :150], light[:, :149:-1], rtol=1e-5)
    left, right = np.zeros_like(light), np.zeros_like(light)
    left[:, :150], right[:, 150:] = 1, 1
    np.testing.assert_allclose(transport.adjoint(left)[0], transport.adjoint(right)[0], rtol=1e-4, atol=1e-5)


def test_at_an_occlusion_each_side_sees_only_its_own_surface(stage: Stage) -> None:
    calibration = mapped(stage(4, masked=False, sizes=((40, 80),)), 4, mosaic=None, ordered=True)
    part = calibration.projectors[0]
    assert part.phase_map is not None
    position = part.phase_map.projector_px.copy()
    position[:, :150, 0], position[:, 150:, 0] = 15, 65
    part = dataclasses.replace(part, phase_map=PhaseMap(position, 0.1 * part.phase_map.spread_px2))
    transport = build_transport(dataclasses.replace(calibration, projectors=(part,)))
    frame = np.zeros((40, 80, 3), np.float32)
    frame[:, :40] = 1
    light = transport.forward([frame])
    np.testing.assert_allclose(
        light[:, :150][transport.lit[0][:, :150]], transport.reach()[:, :150][transport.lit[0][:, :150]], rtol=1e-5
    )
    assert not light[:, 150:].any()


@pytest.mark.parametrize("mosaic", [None, RGGB], ids=["none", "RGGB"])
def test_products_are_the_same_to_the_bit_for_any_number_of_threads(
    stage: Stage, mosaic: npt.NDArray[np.int64] | None
) -> None:
    transport = build_transport(mapped(stage(5, camera=(150, 600), sizes=((200, 170), (50, 70))), 5, mosaic=mosaic))
    frames = random_frames(transport, 5)
    r = np.random.default_rng(5).random((*transport.camera_shape, 3), np.float32)

    def products() -> tuple[Floats, list[Floats], Floats]:
        return transport.forward(frames), transport.adjoint(r), transport.gaussian_mean(r, 0)

    several = products()
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        one = products()
    finally:
        numba.set_num_threads(threads)
    np.testing.assert_array_equal(several[0], one[0])
    np.testing.assert_array_equal(several[2], one[2])
    for a, b in zip(several[1], one[1], strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_mean_over_a_projector_pixel_uses_its_normalised_shares(stage: Stage) -> None:
    calibration = mapped(stage(6, masked=False), 6, mosaic=None)
    transport = build_transport(calibration)
    image = np.random.default_rng(0).random((*transport.camera_shape, 3), np.float32)
    phase_map = calibration.projectors[0].phase_map
    assert phase_map is not None
    bright = calibration.projectors[0].white.max(axis=2) > 0
    shares = phase_map_shares(phase_map)
    shares = sp.csr_matrix(sp.diags_array(bright.ravel().astype(np.float64)) @ shares)
    wanted = (
        np.asarray(shares.T @ image.reshape(-1, 3)) / np.maximum(np.asarray(shares.sum(axis=0)).ravel(), 1e-9)[:, None]
    )
    means = transport.gaussian_mean(image, 0).reshape(-1, 3)
    np.testing.assert_allclose(means, wanted, atol=0.02)
    np.testing.assert_allclose(transport.gaussian_mean(np.ones_like(image), 0), 1, rtol=1e-5)


@pytest.mark.parametrize("mosaic", [None, RGGB], ids=["none", "RGGB"])
def test_a_part_written_out_as_a_matrix_is_the_same_transport(
    stage: Stage, mosaic: npt.NDArray[np.int64] | None
) -> None:
    transport = build_transport(apart(mapped(stage(7), 7, mosaic=mosaic), 7))
    everything = np.arange(transport.pixels)
    p = np.random.default_rng(7).random((3, transport.pixels), np.float32)
    light = transport.forward_planes(p)
    for box in ((0, 0, 12, 9), (30, 100, 41, 117), (60, 290, 70, 300)):
        rows = transport.submatrix(CameraBox(*box), everything, (0, 1, 2))
        got = np.asarray(rows @ p.astype(np.float64).ravel()).reshape(3, box[2] - box[0], box[3] - box[1])
        np.testing.assert_allclose(got, light[:, box[0] : box[2], box[1] : box[3]], rtol=1e-4, atol=1e-5)


def test_one_camera_pixel_and_one_projector_pixel_are_a_stage(stage: Stage) -> None:
    calibration = mapped(stage(10, camera=(1, 1), sizes=((1, 1),), masked=False), 10, mosaic=None)
    phase_map = PhaseMap(np.zeros((1, 1, 2), np.float32), np.array([[[0.2, 0, 0.2]]], np.float32))
    white = np.full((1, 1, 3), 0.5, np.float32)
    part = dataclasses.replace(calibration.projectors[0], phase_map=phase_map, white=white)
    for mosaic in (None, RGGB):
        transport = build_transport(dataclasses.replace(calibration, projectors=(part,), mosaic=mosaic))
        frame = np.full((1, 1, 3), 0.25, np.float32)
        np.testing.assert_allclose(transport.forward([frame]), 0.125, rtol=1e-5)
        np.testing.assert_allclose(transport.adjoint([frame][0])[0].sum(), 3 * 0.125, rtol=1e-5)


@pytest.mark.parametrize("away", [10_000.0, np.nan], ids=["elsewhere", "unknown"])
def test_a_projector_that_misses_the_object_lights_nothing(stage: Stage, away: float) -> None:
    calibration = mapped(stage(11), 11)
    first, second = calibration.projectors
    assert first.phase_map is not None
    missing = PhaseMap(first.phase_map.projector_px + np.float32(away), first.phase_map.spread_px2)
    projectors = (dataclasses.replace(first, phase_map=missing), second)
    transport = build_transport(dataclasses.replace(calibration, projectors=projectors))
    assert not transport.lit[0].any()
    assert not transport.adjoint(np.ones((*transport.camera_shape, 3), np.float32))[0].any()
    assert not transport.gaussian_mean(np.ones((*transport.camera_shape, 3), np.float32), 0).any()
    assert transport.reach().any()


def test_a_projector_without_a_phase_map_falls_back_to_metapixels(stage: Stage) -> None:
    calibration = mapped(stage(12), 12)
    first, second = calibration.projectors
    mixed = dataclasses.replace(calibration, projectors=(dataclasses.replace(first, phase_map=None), second))
    assert isinstance(build_transport(mixed), PatchTransport)


def test_a_phase_map_of_another_size_is_refused(stage: Stage) -> None:
    calibration = mapped(stage(13), 13)
    first, second = calibration.projectors
    assert first.phase_map is not None
    wrong = dataclasses.replace(first, phase_map=PhaseMap(first.phase_map.projector_px[1:], first.phase_map.spread_px2))
    with pytest.raises(UsageError) as refused:
        build_transport(dataclasses.replace(calibration, projectors=(wrong, second)))
    assert refused.value.code == "calibration-inconsistent"
