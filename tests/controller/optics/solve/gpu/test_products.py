"""The light transport on a graphics processor: the products of the processor, to float precision."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.core.arrays import FloatImage
from controller.optics.solve.gpu.device import CHUNK_BYTES, Clear, Device, DeviceRefused
from controller.optics.solve.gpu.transport import DeviceTransport
from controller.optics.transport import LightTransport, build_transport
from controller.optics.transport.windows.profiles import SORTS
from controller.optics.transport.windows.transport import WindowTransport
from tests.controller.optics.solve.conftest import plane_calibration
from tests.controller.optics.solve.gpu.conftest import any_windows, few, stages

SINGLE = 3e-6
"""Of the largest value: sums of hundreds of products in single precision, in two orders."""


def forward(there: DeviceTransport, p: FloatImage) -> FloatImage:
    """T p (3, rows, columns): the residual of no target, with weights of 1."""
    device, source = there.device, there.source
    sensor = device.room(4 * there.sensor_count, "camera samples")
    wanted, weights = (device.room(4 * count * there.rows * there.columns, "pictures") for count in (3, 1))
    device.write(weights, np.ones((there.rows, there.columns), np.float32))
    device.submit([Clear(sensor)])
    for n, M in enumerate(source.mixing):
        device.write(there.shown, M @ p[:, source.span(n)])
        device.submit(there.forward(n, sensor))
    device.submit(there.residual_of(sensor, wanted, weights))
    light = np.zeros((3, *source.camera_shape), np.float32)
    seen = device.read(there.residual, 3 * there.rows * there.columns).reshape(3, there.rows, there.columns)
    light[:, *there.box.window] = seen
    return light


def backward(there: DeviceTransport, r: FloatImage, *, sums: bool = False) -> FloatImage:
    """T' r (3, pixels), or the sums under metapixels."""
    device, source = there.device, there.source
    device.write(there.residual, np.ascontiguousarray(r[:, *there.box.window]))
    device.submit(there.collect())
    parts = []
    for n, (rows, columns) in enumerate(source.sizes):
        out = device.room(12 * rows * columns, "frames")
        device.submit(there.sums(n, out) if sums else there.adjoint(n, out))
        parts.append(device.read(out, 3 * rows * columns).reshape(3, -1))
    return np.concatenate(parts, axis=1)


def numbers(transport: LightTransport, seed: int) -> tuple[FloatImage, FloatImage]:
    """Frames (3, pixels) and a picture (3, rows, columns)."""
    rng = np.random.default_rng(seed)
    r = rng.standard_normal((3, *transport.camera_shape)).astype(np.float32)
    return rng.random((3, transport.pixels), np.float32), r


def near(found: FloatImage, wanted: FloatImage) -> bool:
    return bool(np.abs(found - wanted).max() <= SINGLE * np.abs(wanted).max())


def test_the_stages_of_these_tests_have_windows_of_every_sort() -> None:
    transport = any_windows(1, mosaic=True)
    assert isinstance(transport, WindowTransport)
    assert np.diff(transport.windows.first).reshape(-1, SORTS).sum(axis=0).min() > 20


def test_a_pixel_beside_very_sharp_windows_has_no_infinite_mean() -> None:
    """Its shares are the smallest numbers there are."""
    transport = any_windows(4, mosaic=True)
    assert isinstance(transport, WindowTransport)
    assert np.isfinite(transport.per_sum).all()


@few
@stages
def test_light_and_its_transpose_are_those_of_the_processor(device: Device, seed: int, mosaic: bool) -> None:
    transport = any_windows(seed, mosaic=mosaic)
    there = DeviceTransport(device, transport)
    p, r = numbers(transport, seed)
    light, back = forward(there, p), backward(there, r)
    assert near(light, transport.forward_planes(p))
    assert near(back, transport.adjoint_planes(r))
    # by themselves, too: one is the transpose of the other, and sums go in, sums come out
    inner = np.vdot(light.astype(np.float64), r), np.vdot(p.astype(np.float64), back)
    scale = np.linalg.norm(light.astype(np.float64)) * np.linalg.norm(r.astype(np.float64))
    assert inner[0] == pytest.approx(inner[1], abs=1e-6 * float(scale))
    other = numbers(transport, seed + 1)[0]
    assert near(forward(there, 0.5 * p - 2 * other), 0.5 * light - 2 * forward(there, other))
    there.free()


@few
@given(seed=st.integers(0, 2**20), mosaic=st.booleans())
def test_means_over_projector_pixels_are_those_of_the_processor(device: Device, seed: int, mosaic: bool) -> None:
    transport = any_windows(seed, mosaic=mosaic)
    there = DeviceTransport(device, transport)
    _, r = numbers(transport, seed)
    factors = np.concatenate([there.per_sum(n) for n in range(len(transport.sizes))], axis=1)
    assert near(backward(there, r, sums=True) * factors, transport.gaussian_mean_planes(r))
    there.free()


@pytest.mark.parametrize("rows", [1, 3])
def test_windows_in_bands_for_devices_with_small_buffers_give_the_same(device: Device, rows: int) -> None:
    transport = any_windows(5, mosaic=True)
    whole = DeviceTransport(device, transport)
    per_row = 16 * 22 * 36 // 14
    cut = DeviceTransport(device, transport, band_bytes=rows * per_row)
    p, r = numbers(transport, 5)
    np.testing.assert_array_equal(forward(cut, p), forward(whole, p))
    np.testing.assert_array_equal(backward(cut, r), backward(whole, r))
    assert cut.bands > whole.bands + 3
    whole.free()
    cut.free()


@pytest.mark.parametrize("rows", [3, 2 * CHUNK_BYTES // 9000 + 5])
def test_parts_of_arrays_reach_the_device_and_come_back(device: Device, rows: int) -> None:
    """Of any size: large ones go piece by piece."""
    whole = np.random.default_rng(1).random((rows, 1500, 3), np.float32)
    part = whole[:, 11:1411]
    buffer = device.room(whole.nbytes, "camera pictures")
    device.write(buffer, part, 16)
    np.testing.assert_array_equal(device.read(buffer, part.size + 4)[4:], part.ravel())
    device.write(buffer, whole)
    np.testing.assert_array_equal(device.read(buffer, whole.size), whole.ravel())
    buffer.destroy()


def test_a_buffer_beyond_the_device_s_limit_is_refused_in_words(device: Device) -> None:
    with pytest.raises(DeviceRefused, match=r"has room for \d+ MB in one piece, and the camera pictures need \d+ MB"):
        device.room(device.most_bytes + 1, "camera pictures")


def test_memory_that_was_given_back_is_no_longer_counted(device: Device) -> None:
    before = device.held_bytes
    there = DeviceTransport(device, any_windows(2, mosaic=True))
    assert device.held_bytes > before
    there.free()
    assert device.held_bytes == before


def test_a_calibration_without_phase_maps_is_refused_in_words(device: Device) -> None:
    with pytest.raises(DeviceRefused, match="needs phase maps"):
        DeviceTransport(device, build_transport(plane_calibration()))
