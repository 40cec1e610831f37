"""Base times scale: exact for smooth scales, sound where the base is dark, and refused for bad targets."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
import pytest

from controller.core.errors import UsageError
from controller.optics.calibrate.values import Calibration
from controller.optics.solve.appearance import (
    Base,
    BaseKind,
    base_image,
    prepare_base,
    scale_frames,
    solve_base,
)
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.reach.drive_levels import DriveLevels
from controller.optics.solve.reach.feasibility import feasibility
from controller.optics.transport import LightTransport, build_transport

Stage = Callable[..., Calibration]
Image = npt.NDArray[np.float32]


def based(calibration: Calibration, kind: BaseKind = "white") -> tuple[LightTransport, Base]:
    transport = build_transport(calibration)
    return transport, solve_base(transport, base_image(calibration, kind), calibration.black)


def smooth_scale(shape: tuple[int, int]) -> Image:
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]].astype(np.float32)
    return np.stack([0.8 + 0.2 * np.sin(x / 25), 0.7 + 0.1 * np.cos(y / 30), np.full_like(x, 0.9)], -1)


def scaled(base: Base, black: Image, scale: Image) -> Image:
    return np.asarray(black + (base.image - black) * scale, np.float32)


@pytest.mark.parametrize("kind", ["white", "minimum"])
def test_scaling_by_one_gives_the_base_back(stage: Stage, kind: BaseKind) -> None:
    calibration = stage()
    transport, base = based(calibration, kind)
    for frame, expected in zip(
        scale_frames(transport, base, base.image, calibration.black), base.solution.frames, strict=True
    ):
        lit = expected > 1e-3
        np.testing.assert_allclose(frame[lit], expected[lit], atol=2e-4)


def test_scaling_a_uniform_target_is_exact_with_mixed_colours(stage: Stage) -> None:
    calibration = stage(spill=0.2)
    transport, base = based(calibration)
    target = scaled(base, calibration.black, np.full((*transport.camera_shape, 3), 0.6, np.float32))
    light = transport.forward(scale_frames(transport, base, target, calibration.black))
    np.testing.assert_allclose(light, 0.6 * transport.forward(base.solution.frames), atol=1e-3)


def test_a_scale_without_fine_detail_is_as_good_as_the_base(stage: Stage) -> None:
    calibration = stage()
    transport, base = based(calibration)
    scale = smooth_scale(transport.camera_shape)
    target = scaled(base, calibration.black, scale)
    light = transport.forward(scale_frames(transport, base, target, calibration.black))
    mask = transport.object_mask
    difference = np.abs(light - transport.forward(base.solution.frames) * scale)[mask]
    assert np.quantile(difference, 0.99) < 0.01 * target.max()


def test_a_full_solve_keeps_what_the_scale_loses(stage: Stage) -> None:
    calibration = stage()
    transport, base = based(calibration)
    y, x = np.mgrid[0:60, 0:80]
    checks = np.repeat((0.3 + 0.5 * ((x // 2 + y // 2) % 2))[..., None], 3, -1).astype(np.float32)
    target = scaled(base, calibration.black, checks)
    full = solve_bounded(transport, target, calibration.black).frames
    errors = [
        ((transport.forward(frames) + calibration.black - target)[transport.object_mask] ** 2).mean()
        for frames in (full, scale_frames(transport, base, target, calibration.black))
    ]
    assert errors[0] < errors[1]


def test_a_full_solve_keeps_what_clipping_spoils_in_a_scale(stage: Stage) -> None:
    calibration = stage()
    transport, base = based(calibration)

    target = scaled(base, calibration.black, 3 * smooth_scale(transport.camera_shape))
    reachable = feasibility(DriveLevels.of_transport(transport), target, calibration.black).reachable

    def missed(frames: Sequence[Image]) -> float:
        error = np.abs(transport.forward(frames) + calibration.black - target)[reachable]
        return float(np.percentile(error, 95))

    full = solve_bounded(transport, target, calibration.black).frames
    assert missed(full) < 0.8 * missed(scale_frames(transport, base, target, calibration.black))


def test_a_base_that_is_black_in_places_spoils_nothing_around_them(stage: Stage) -> None:
    calibration = stage()
    transport = build_transport(calibration)
    image = base_image(calibration)
    whole = solve_base(transport, image, calibration.black)
    image = image.copy()
    image[20:40, 30:50] = calibration.black[20:40, 30:50]
    image[25, 35] += 1e-7
    base = prepare_base(transport, image, calibration.black, whole.solution)
    frames = scale_frames(transport, base, whole.image, calibration.black)
    light = transport.forward(frames)
    outside = np.ones(transport.camera_shape, np.bool_)
    outside[15:45, 25:55] = False
    np.testing.assert_allclose(light[outside], transport.forward(whole.solution.frames)[outside], atol=1e-3)
    assert all(np.isfinite(frame).all() and frame.min() >= 0 and frame.max() <= 1 for frame in frames)


def test_an_entirely_black_base_gives_dark_frames(stage: Stage) -> None:
    calibration = stage()
    transport = build_transport(calibration)
    base = solve_base(transport, calibration.black, calibration.black)
    frames = scale_frames(transport, base, np.full((60, 80, 3), 0.5, np.float32), calibration.black)
    assert max(float(frame.max()) for frame in frames) < 1e-5


def test_the_minimum_base_is_the_darkest_white_of_those_that_light_a_pixel(stage: Stage) -> None:
    calibration = stage()
    shadow = calibration.projectors[0].white.copy()
    shadow[:10] = 0
    projectors = (dataclasses.replace(calibration.projectors[0], white=shadow), calibration.projectors[1])
    image = base_image(dataclasses.replace(calibration, projectors=projectors), "minimum") - calibration.black
    np.testing.assert_allclose(image[:10], calibration.projectors[1].white[:10], rtol=1e-4)
    both = np.minimum(shadow, calibration.projectors[1].white)
    np.testing.assert_allclose(image[10:], both[10:], rtol=1e-4)


def test_a_target_that_is_not_finite_is_refused(stage: Stage) -> None:
    calibration = stage()
    transport, base = based(calibration)
    with pytest.raises(UsageError) as refused:
        scale_frames(transport, base, np.full((60, 80, 3), np.nan, np.float32), calibration.black)
    assert refused.value.code == "target-not-finite"
