"""Frames made on the clock against the reference that takes every sample with its own share."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from controller.bundle.live_maps import compensate
from controller.core.errors import UsageError
from controller.optics.calibrate.values import Calibration
from controller.optics.solve.appearance import Base, base_image, scale_frames, solve_base
from controller.optics.solve.bounded.equations import SolveSettings
from controller.optics.solve.scaling.dither import to_light
from controller.optics.solve.scaling.interactive import Interactive, interactive
from controller.optics.transport import LightTransport, build_transport

Stage = Callable[..., Calibration]
Image = npt.NDArray[np.float32]


def prepared(calibration: Calibration) -> tuple[LightTransport, Base, Interactive]:
    transport = build_transport(calibration)
    base = solve_base(transport, base_image(calibration, "white"), calibration.black, SolveSettings(tolerance=1e-4))
    made = interactive(transport, base, calibration.black, [p.radiometry for p in calibration.projectors])
    return transport, base, made


def smooth_target(calibration: Calibration, base: Base) -> Image:
    y, x = np.mgrid[0 : base.image.shape[0], 0 : base.image.shape[1]].astype(np.float32)
    scale = np.stack([0.6 + 0.2 * np.sin(x / 25), 0.5 + 0.1 * np.cos(y / 30), np.full_like(x, 0.7)], -1)
    return np.asarray(calibration.black + (base.image - calibration.black) * scale, np.float32)


@pytest.mark.parametrize("camera", [(60, 80), (95, 131)], ids=["pixels", "blocks"])
def test_the_light_of_the_frames_is_that_of_the_reference(stage: Stage, camera: tuple[int, int]) -> None:
    calibration = stage(camera=camera)
    transport, base, made = prepared(calibration)
    target = smooth_target(calibration, base)
    exact = scale_frames(transport, base, target, calibration.black)
    shown = [
        to_light(frame, part.radiometry)
        for frame, part in zip(made.frames(target), calibration.projectors, strict=True)
    ]
    wanted, got = transport.forward(exact), transport.forward(shown)
    inside = transport.object_mask.copy()
    inside[:8], inside[-8:], inside[:, :8], inside[:, -8:] = False, False, False, False
    error = np.sqrt(((got - wanted)[inside] ** 2).mean() / (wanted[inside] ** 2).mean())
    # dithering alone is about 1 % here
    assert error < 0.02
    assert got[inside].mean() == pytest.approx(wanted[inside].mean(), rel=2e-3)


@pytest.mark.parametrize("camera", [(60, 80), (190, 262)], ids=["pixels", "blocks"])
def test_pixels_that_see_base_light_with_their_edge_alone_are_scaled_as_by_the_reference(
    stage: Stage, camera: tuple[int, int]
) -> None:
    _, _, made = prepared(stage(camera=camera))
    whole = made.maps
    shadow = np.s_[:, whole.target_px[0] // 2 :]
    present, gain = whole.present.copy(), whole.gain.copy()
    present[shadow], gain[shadow] = 0, 0
    wide = [dataclasses.replace(o, shape=wider(o.shape)) for o in whole.outputs]
    maps = dataclasses.replace(whole, present=present, gain=gain, outputs=tuple(wide))
    picture = np.full((*present.shape, 3), 150, np.uint8)
    fast = Interactive(maps)
    frames = fast.blank()
    fast.show_picture(picture, maps.unit, frames)
    for got, wanted in zip(frames, compensate(maps, picture, maps.unit), strict=True):
        lit = wanted.max(-1) > 8
        assert lit.any()
        assert (got[lit].max(-1) > 0).all()
        assert np.abs(got[lit].astype(int) - wanted[lit]).mean() < 2


def wider(shape: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Every Gaussian three times as wide along the rows: more than the blocks of its window."""
    found = shape.copy()
    found[..., 0] = np.where(shape[..., 0] > 0, np.minimum(shape[..., 0].astype(int) + 51, 200), 0)
    return found


def test_equal_targets_give_equal_bytes(stage: Stage) -> None:
    calibration = stage()
    _, base, made = prepared(calibration)
    target = smooth_target(calibration, base)
    first = made.frames(target)
    made.frames(target * 0.5)
    for a, b in zip(first, made.frames(target), strict=True):
        np.testing.assert_array_equal(a, b)


def test_black_gives_black_and_more_than_white_gives_white(stage: Stage) -> None:
    calibration = stage()
    transport, _, made = prepared(calibration)
    assert not any(frame.any() for frame in made.frames(calibration.black))
    bright = made.frames(np.full_like(calibration.black, 1e3))
    for n, frame in enumerate(bright):
        lit = transport.per_weight[transport.span(n)].reshape(transport.sizes[n]) > 0
        assert np.median(frame[lit]) == 255


def test_a_dead_projector_stays_dark(stage: Stage) -> None:
    calibration = stage()
    dead = dataclasses.replace(calibration.projectors[0], white=np.zeros_like(calibration.projectors[0].white))
    calibration = dataclasses.replace(calibration, projectors=(dead, calibration.projectors[1]))
    _, base, made = prepared(calibration)
    frames = made.frames(smooth_target(calibration, base))
    assert not frames[0].any()
    assert frames[1].any()


@pytest.mark.parametrize("camera", [(60, 80), (41, 53)], ids=["blocks", "pixels"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_target_that_is_not_finite_is_refused(stage: Stage, bad: float, camera: tuple[int, int]) -> None:
    calibration = stage(camera=camera)
    _, _, made = prepared(calibration)
    target = np.full((*camera, 3), 0.1, np.float32)
    target[11, 7, 2] = bad
    with pytest.raises(UsageError) as refused:
        made.frames(target)
    assert refused.value.code == "target-not-finite"


def test_a_target_of_another_size_is_refused(stage: Stage) -> None:
    _, _, made = prepared(stage())
    with pytest.raises(UsageError) as refused:
        made.frames(np.zeros((5, 5, 3), np.float32))
    assert refused.value.code == "image-wrong-size"
