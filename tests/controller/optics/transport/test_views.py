"""The transport of several views against its rows written out, and a solve of all views against SciPy's."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.optimize import lsq_linear

from controller.core.errors import UsageError
from controller.optics.calibrate.values import Calibration, PhaseMap
from controller.optics.solve.bounded.equations import SolveSettings
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.reach.drive_levels import DriveLevels
from controller.optics.transport import LightTransport, build_transport
from controller.optics.transport.planes import CameraBox, frame_planes
from controller.optics.transport.views import ViewsTransport
from tests.controller.optics.transport.conftest import products, random_calibration, random_frames
from tests.controller.optics.transport.windows.test_transport import mapped

Stage = Callable[..., Calibration]
SIZES = ((5, 6), (3, 4))


def views(mosaic: bool = True) -> list[LightTransport]:
    """Three cameras of different sizes, two with phase maps, one of these with a mosaic."""
    cameras = [random_calibration(n, camera=size, sizes=SIZES) for n, size in enumerate([(20, 30), (17, 22), (12, 31)])]
    made = [mapped(cameras[0], 1), mapped(cameras[1], 2, mosaic=None), cameras[2]]
    return [build_transport(one) for one in made]


def dense(transport: LightTransport) -> np.ndarray:
    box = CameraBox(0, 0, *transport.camera_shape)
    return transport.submatrix(box, np.arange(transport.pixels), (0, 1, 2)).toarray()


def rows_of(joint: ViewsTransport) -> np.ndarray:
    """All rows on the sheet, from those of each view."""
    matrix = np.zeros((3, *joint.camera_shape, 3 * joint.pixels))
    for view, box in zip(joint.views, joint.sheet.boxes(), strict=True):
        matrix[:, *box.window] = dense(view).reshape(3, *view.camera_shape, -1)
    return matrix.reshape(3 * joint.object_mask.size, -1)


def facing(pitch: float, white: float, across: tuple[int, int]) -> Calibration:
    """A camera straight before two projectors' pictures of 20 x 26; ``pitch``: its pixels for one of theirs."""
    rows, columns = 20, 26
    shape = round(rows * pitch), round((across[1] - across[0]) * pitch)
    calibration = random_calibration(0, camera=shape, sizes=((rows, columns),) * 2, masked=False)
    y, x = (np.mgrid[: shape[0], : shape[1]] + 0.5) / pitch - 0.5
    places = PhaseMap(np.stack([x + across[0], y], -1).astype(np.float32), np.full((rows, columns, 3), 0.3, np.float32))
    places.spread_px2[..., 1] = 0
    light = np.full((*shape, 3), white, np.float32)
    parts = [dataclasses.replace(part, phase_map=places, white=light) for part in calibration.projectors]
    return dataclasses.replace(calibration, projectors=tuple(parts), black=np.zeros_like(light))


def test_its_products_are_those_of_the_views_rows() -> None:
    joint = ViewsTransport.of(views())
    matrix, random = rows_of(joint), np.random.default_rng(1)
    np.testing.assert_allclose(dense(joint), matrix, atol=1e-6)
    x, y = random.random(joint.shape[1]), random.random(joint.shape[0])
    np.testing.assert_allclose(joint @ x, matrix @ x, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(joint.rmatvec(y), matrix.T @ y, rtol=1e-4, atol=1e-5)
    box, some = CameraBox(3, 2, 40, 25), np.array([1, 4, 33])
    window = np.zeros(joint.camera_shape, np.bool_)
    window[box.window] = True
    part = matrix.reshape(3, window.size, 3, -1)[:2, window.ravel()][:, :, :2][..., some].reshape(2 * window.sum(), -1)
    np.testing.assert_allclose(joint.submatrix(box, some, (0, 1)).toarray(), part, atol=1e-6)


def test_a_projector_alone_leaves_the_others_as_they_are() -> None:
    joint = ViewsTransport.of(views())
    frames, picture = random_frames(joint), joint.reach()
    whole = sum(joint.forward_part(n, frame) for n, frame in enumerate(frames))
    np.testing.assert_allclose(whole, joint.forward(frames), rtol=1e-4, atol=1e-5)
    forward, backward = products(joint, frames, picture)
    assert forward == pytest.approx(backward, rel=1e-5)
    out = np.full((3, joint.pixels), 7, np.float32)
    joint.adjoint_planes(np.moveaxis(picture, 2, 0), projectors=(1, 2), out=out)
    assert (out[:, joint.span(0)] == 7).all()
    np.testing.assert_allclose(out[:, joint.span(1)], frame_planes(joint.adjoint(picture))[:, joint.span(1)], rtol=1e-4)


def test_a_solve_of_all_views_is_scipys() -> None:
    joint = ViewsTransport.of(views())
    random = np.random.default_rng(2)
    target = random.uniform(0, 1, (*joint.camera_shape, 3)).astype(np.float32) * joint.reach()
    given = random.uniform(0.2, 2, joint.camera_shape).astype(np.float32)
    settings = SolveSettings(0.0, given, tolerance=1e-7, most_iterations=5000)
    found = solve_bounded(joint, target, np.zeros_like(target), settings)
    root = np.sqrt(np.tile((joint.counts() * given).ravel(), 3).astype(np.float64))
    rows = sp.csr_matrix(root[:, None] * rows_of(joint))
    right = root * np.moveaxis(target, 2, 0).ravel()
    best = lsq_linear(rows, right, (0, 1), method="trf", tol=1e-12, max_iter=500)
    assert found.objective == pytest.approx(2 * best.cost, rel=1e-4)


def test_what_several_views_see_counts_once_and_more_for_the_nearer_camera() -> None:
    same = [build_transport(facing(2.0, 1.0, (0, 26))) for _ in range(2)]
    np.testing.assert_allclose(ViewsTransport.of(same).counts()[ViewsTransport.of(same).object_mask], 0.5, atol=1e-3)
    joint = ViewsTransport.of([same[0], build_transport(facing(4.0, 1.0, (0, 26)))])
    far, near = (part[part.shape[0] // 2, part.shape[1] // 2] for part in joint.sheet.parts(joint.counts()))
    # a quarter of the samples
    assert far == pytest.approx(0.2, abs=0.02)
    assert near == pytest.approx(0.8, abs=0.02)


def test_what_one_view_sees_alone_counts_as_if_it_were_alone() -> None:
    joint = ViewsTransport.of([build_transport(facing(2.0, 1.0, part)) for part in ((0, 16), (8, 26))])
    left, right = joint.sheet.parts(joint.counts())
    row = left.shape[0] // 2
    assert left[row, 0] == pytest.approx(1, abs=1e-3)
    assert right[row, -1] == pytest.approx(1, abs=1e-3)
    # from one view to the other the shares change slowly
    assert np.abs(np.diff(left[row, 4:])).max() < 0.15
    together = left[row, 16:32] + right[row, :16]
    np.testing.assert_allclose(together[4:-4], 1, atol=0.05)


def test_views_that_contradict_each_other_meet_by_their_shares() -> None:
    joint = ViewsTransport.of([build_transport(facing(2.0, 1.0, (0, 26))), build_transport(facing(4.0, 1.0, (0, 26)))])
    wanted = joint.sheet.joined([np.full((*view.camera_shape, 3), light, np.float32)
                                 for view, light in zip(joint.views, (0.4, 1.4), strict=True)])  # fmt: skip
    found = solve_bounded(joint, wanted, np.zeros_like(wanted))
    for light in joint.sheet.parts(joint.forward(found.frames)):
        # both get the same number of samples times share
        assert np.median(light) == pytest.approx((0.2 * 0.4 + 4 * 0.8 * 1.4) / (0.2 + 4 * 0.8), abs=0.02)


def test_each_views_own_mixing_counts_in_what_can_be_reached() -> None:
    joint = ViewsTransport.of(views())
    drive, white = DriveLevels.of_transport(joint), joint.reach()
    seen = drive.of(white)[joint.object_mask]
    np.testing.assert_allclose(seen[np.isfinite(seen).all(axis=1)], 1, atol=2e-3)


def test_views_of_other_projectors_are_refused() -> None:
    other = build_transport(random_calibration(0, camera=(20, 30), sizes=((5, 7), (3, 4))))
    with pytest.raises(UsageError) as refused:
        ViewsTransport.of([views()[0], other])
    assert refused.value.code == "views-differ"
