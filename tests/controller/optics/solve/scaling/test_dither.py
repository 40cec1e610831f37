"""Eight bits that are right in linear light, on average and every time the same."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.core.errors import UsageError
from controller.optics.calibrate.values import Radiometry
from controller.optics.solve.scaling.dither import Method, blue_noise, to_device, to_light

GAMMA = Radiometry(np.tile(np.linspace(0, 1, 256) ** 2.2, (3, 1)), np.eye(3))
METHODS: tuple[Method, ...] = ("diffusion", "blue-noise", "nearest")


@pytest.mark.parametrize("method", METHODS)
def test_values_the_projector_has_come_back_unchanged(method: Method) -> None:
    values = np.tile(np.arange(256, dtype=np.uint8)[None, :, None], (5, 1, 3))
    np.testing.assert_array_equal(to_device(to_light(values, GAMMA), GAMMA, method=method), values)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(value=st.floats(0, 1), method=st.sampled_from(["diffusion", "blue-noise"]))
def test_the_mean_light_of_a_flat_frame_is_kept(value: float, method: Method) -> None:
    frame = np.full((64, 64, 3), value, np.float32)
    mean = to_light(to_device(frame, GAMMA, method=method), GAMMA).mean(dtype=np.float64)
    assert mean == pytest.approx(value, abs=2e-4)


@pytest.mark.parametrize("method", METHODS)
def test_no_pixel_is_farther_than_one_step_from_what_was_wanted(method: Method) -> None:
    frame = np.random.default_rng(0).random((40, 50, 3), np.float32)
    step = np.diff(GAMMA.response[0]).max()
    farthest = np.abs(to_light(to_device(frame, GAMMA, method=method), GAMMA) - frame).max()
    assert farthest <= step * (2 if method == "diffusion" else 1)


@pytest.mark.parametrize("method", METHODS)
def test_the_same_frame_gives_the_same_bytes_and_what_is_out_of_range_is_clipped(method: Method) -> None:
    frame = np.random.default_rng(1).uniform(-0.5, 1.5, (30, 40, 3)).astype(np.float32)
    first = to_device(frame, GAMMA, method=method)
    np.testing.assert_array_equal(first, to_device(frame, GAMMA, method=method))
    if method != "diffusion":
        assert (first[frame <= 0] == 0).all()
        assert (first[frame >= 1] == 255).all()


def test_blue_noise_holds_each_threshold_once_and_little_low_frequency() -> None:
    noise = blue_noise()
    assert np.unique(noise).size == noise.size
    spectrum = np.abs(np.fft.fft2(noise - noise.mean())) ** 2
    fy, fx = np.meshgrid(np.fft.fftfreq(64), np.fft.fftfreq(64), indexing="ij")
    radius = np.hypot(fx, fy)
    assert spectrum[(radius > 0) & (radius < 0.1)].mean() < 0.1 * spectrum[radius > 0.3].mean()


def test_a_response_that_falls_is_refused() -> None:
    with pytest.raises(UsageError) as refused:
        to_device(np.zeros((2, 2, 3), np.float32), Radiometry(1 - GAMMA.response, np.eye(3)))
    assert refused.value.code == "response-not-rising"


def test_a_response_that_is_flat_at_its_ends_still_works() -> None:
    flat = np.clip(np.linspace(-0.2, 1.2, 256), 0, 1)
    radiometry = Radiometry(np.tile(flat, (3, 1)), np.eye(3))
    frame = np.linspace(0, 1, 300, dtype=np.float32)[None, :, None] * np.ones((4, 1, 3), np.float32)
    light = to_light(to_device(frame, radiometry, method="nearest"), radiometry)
    assert np.abs(light - frame).max() < 0.004
