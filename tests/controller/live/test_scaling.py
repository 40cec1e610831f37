"""Live frames against the exact base x scale."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks._synthetic import synthetic_calibration
from controller.arrays import ByteImage
from controller.errors import UsageError
from controller.live.scaling import LiveScaler, fitted
from controller.solve.appearance import BaseKind, base_image, scale_frames, solve_base
from controller.solve.dither import to_device
from controller.solve.feasibility import choose_exposure, target_radiance
from controller.solve.targets_values import srgb_to_linear
from controller.transport import LightTransport

CALIBRATION = synthetic_calibration(projector=(84, 112), camera=(208, 312))


def picture(size: tuple[int, int]) -> ByteImage:
    """Waves, a disc with a sharp edge and a ramp of colours; (width, height)."""
    y, x = np.mgrid[0 : size[1], 0 : size[0]].astype(np.float32)
    u, v = x / size[0], y / size[1]
    disc = (u - 0.5) ** 2 + (v - 0.5) ** 2 < 0.03
    shade = np.where(disc, 0.9, 0.5 + 0.2 * np.sin(14 * u) * np.cos(11 * v))
    return (255 * np.stack([shade * (0.5 + 0.5 * u), shade, shade * (1 - 0.5 * v)], 2)).astype(np.uint8)


@pytest.mark.parametrize("kind", ["minimum", "white"])
def test_live_frames_are_those_of_base_times_scale_within_two_steps_in_the_mean(kind: BaseKind) -> None:
    transport = LightTransport.build(CALIBRATION)
    black = CALIBRATION.black
    base = solve_base(transport, base_image(CALIBRATION, kind), black)
    exposure = choose_exposure(transport, np.ones_like(black), black)
    scaler = LiveScaler(CALIBRATION, transport, base, exposure=exposure)
    whole = picture((312, 208))
    frames = scaler.blank()
    scaler.frames(fitted(whole, scaler.size), frames)
    exact = scale_frames(transport, base, target_radiance(srgb_to_linear(whole), black, exposure), black)
    for n, part in enumerate(CALIBRATION.projectors):
        lit = (transport.per_weight[transport.span(n)] > 0).reshape(transport.sizes[n])
        wanted = to_device(exact[n], part.radiometry, method="nearest")
        error = np.abs(frames[part.name].astype(int) - wanted)[lit]
        assert wanted[lit].std() > 10
        assert error.mean() <= 2
        assert not frames[part.name][~lit].any()


def test_frames_are_reused_and_equal_pictures_give_equal_bytes() -> None:
    transport = LightTransport.build(CALIBRATION)
    base = solve_base(transport, base_image(CALIBRATION), CALIBRATION.black)
    scaler = LiveScaler(CALIBRATION, transport, base, exposure=0.3)
    one, two = scaler.blank(), scaler.blank()
    scaler.frames(picture(scaler.size), one)
    scaler.frames(np.zeros_like(picture(scaler.size)), two)
    assert all(not frame.any() for frame in two.values()), "black is below the black image: no light"
    scaler.frames(picture(scaler.size), two)
    for name, frame in one.items():
        np.testing.assert_array_equal(frame, two[name])


def test_a_picture_of_another_size_is_refused_and_fitted_ones_are_not() -> None:
    transport = LightTransport.build(CALIBRATION)
    base = solve_base(transport, base_image(CALIBRATION), CALIBRATION.black)
    scaler = LiveScaler(CALIBRATION, transport, base, exposure=0.3)
    with pytest.raises(UsageError) as refused:
        scaler.frames(np.zeros((10, 10, 3), np.uint8), scaler.blank())
    assert refused.value.code == "image-wrong-size"
    for size in ((64, 48), (640, 480)):
        assert fitted(picture(size), scaler.size).shape == (104, 156, 3)
