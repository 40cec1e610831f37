from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.core.errors import UsageError
from controller.optics.capture.encoding import encode_frame
from controller.optics.capture.pattern_frames import device_frame, frame, tile_levels
from controller.optics.capture.patterns import CELL_PX, PERIOD_PX, PatternKind, plan_patterns

RESPONSE = np.stack([(np.arange(256) / 255) ** gamma for gamma in (2.2, 2.0, 1.8)])


@pytest.mark.parametrize(
    ("size_px", "most"), [((280, 210), 31), ((700, 526), 32), ((1400, 1050), 34), ((1920, 1080), 35)]
)
def test_a_plan_is_short_at_every_resolution_and_waits_with_what_needs_the_response(
    size_px: tuple[int, int], most: int
) -> None:
    plan = plan_patterns(size_px)
    assert len(plan) <= most
    needs = [pattern.needs_response for pattern in plan]
    assert needs == sorted(needs)
    assert len({pattern.name for pattern in plan}) == len(plan)


@settings(max_examples=25, deadline=None)
@given(st.integers(24, 900), st.integers(24, 900))
def test_gray_code_and_phase_together_name_every_pixel_even_one_cell_off(width: int, height: int) -> None:
    plan = plan_patterns((width, height))
    for axis, pixels in enumerate((width, height)):
        bits = [frame(pattern, plan.size_px) for pattern in plan.gray(axis)]
        lines = [image[0] if axis == 0 else image[:, 0] for image in bits]
        cell = np.zeros(pixels, int)
        bit = np.zeros(pixels, int)
        for line in lines:
            bit ^= line.astype(int)
            cell = 2 * cell + bit
        x = np.arange(pixels)
        np.testing.assert_array_equal(cell, x // CELL_PX)
        steps = [frame(p, plan.size_px) for p in plan.sinusoids(("phase-x", "phase-y")[axis])]
        steps = [image[0] if axis == 0 else image[:, 0] for image in steps]
        turns = np.exp(2j * np.pi * np.arange(len(steps)) / len(steps))
        within = np.angle(np.tensordot(turns, steps, axes=1)) * PERIOD_PX / (2 * np.pi)
        border = ((x % CELL_PX == CELL_PX - 1).astype(int)) - (x % CELL_PX == 0)
        for misread in (cell, cell + border):
            middle = misread * CELL_PX + (CELL_PX - 1) / 2
            position = within + PERIOD_PX * np.round((middle - within) / PERIOD_PX)
            np.testing.assert_allclose(position, x, atol=1e-3)


def test_adjacent_cells_differ_in_one_bit() -> None:
    plan = plan_patterns((1400, 1050))
    lines = np.stack([frame(pattern, plan.size_px)[0] for pattern in plan.gray(0)])[:, ::CELL_PX]
    np.testing.assert_array_equal(np.sum(lines[:, 1:] != lines[:, :-1], axis=0), 1)


def test_every_frame_is_finite_light_between_black_and_white() -> None:
    plan = plan_patterns((61, 47))
    for pattern in plan:
        if pattern.kind is PatternKind.COLOUR_TILES:
            assert device_frame(pattern, plan.size_px).shape == (47, 61, 3)
            continue
        image = frame(pattern, plan.size_px)
        assert image.dtype == np.float32
        assert image.shape[:2] == (47, 61)
        assert image.min() >= 0
        assert image.max() <= 1
        assert device_frame(pattern, plan.size_px, RESPONSE).shape == (47, 61, 3)


@pytest.mark.parametrize("size_px", [(280, 210), (1400, 1050)])
def test_a_mosaic_shows_every_level_in_every_channel_and_no_channel_tells_of_another(size_px: tuple[int, int]) -> None:
    mosaics = plan_patterns(size_px).of_kind(PatternKind.COLOUR_TILES)
    levels = np.concatenate([tile_levels(pattern, size_px).reshape(-1, 3) for pattern in mosaics]).astype(float)
    for channel in range(3):
        shown = np.unique(levels[:, channel])
        assert shown[0] == 0
        assert shown[-1] == 255
        assert np.max(np.diff(shown)) <= 2
    assert np.max(np.abs(np.corrcoef(levels.T) - np.eye(3))) < 0.1


@pytest.mark.parametrize("size_px", [(61, 47), (1400, 1050)])
def test_a_mosaics_tiles_lie_on_the_gray_codes_cells(size_px: tuple[int, int]) -> None:
    pattern = plan_patterns(size_px).of_kind(PatternKind.COLOUR_TILES)[-1]
    image = device_frame(pattern, size_px)
    y, x = np.mgrid[0 : size_px[1], 0 : size_px[0]] // CELL_PX
    np.testing.assert_array_equal(image, tile_levels(pattern, size_px)[y, x])


def test_the_random_pattern_is_the_same_every_time_and_differs_by_seed() -> None:
    plan = plan_patterns((64, 48))
    (first,) = plan.of_kind(PatternKind.RANDOM)
    second = replace(first, seed=1)
    np.testing.assert_array_equal(frame(first, plan.size_px), frame(first, plan.size_px))
    assert np.abs(frame(first, plan.size_px) - frame(second, plan.size_px)).mean() > 0.05
    assert frame(first, plan.size_px).std(axis=(0, 1)).min() > 0.1


def test_patterns_between_black_and_white_need_the_response() -> None:
    plan = plan_patterns((64, 48))
    with pytest.raises(UsageError) as caught:
        device_frame(plan.sinusoids("phase-x")[0], plan.size_px)
    assert caught.value.code == "response-missing"
    with pytest.raises(UsageError, match="device values"):
        frame(plan.of_kind(PatternKind.COLOUR_TILES)[0], plan.size_px)


def test_a_projector_of_a_few_pixels_is_refused() -> None:
    with pytest.raises(UsageError) as caught:
        plan_patterns((23, 400))
    assert caught.value.code == "projector-too-small"


@given(st.floats(0, 1), st.floats(0, 1), st.floats(0, 1))
def test_without_dither_the_nearest_light_is_chosen(red: float, green: float, blue: float) -> None:
    light = np.broadcast_to(np.array([red, green, blue], np.float32), (2, 3, 3)).copy()
    device = encode_frame(light, RESPONSE, dither=False)
    for channel in range(3):
        table = RESPONSE[channel].astype(np.float32)
        shown = table[device[0, 0, channel]]
        assert abs(shown - light[0, 0, channel]) <= np.min(np.abs(table - light[0, 0, channel])) + 1e-6


def test_dither_keeps_the_mean_light_between_levels_and_is_repeatable() -> None:
    ramp = np.linspace(0.2, 0.8, 160, dtype=np.float32)
    light = np.broadcast_to(ramp[None, :, None], (120, 160, 3)).copy()
    device = encode_frame(light, RESPONSE)
    shown = np.stack([RESPONSE[c][device[:, :, c]] for c in range(3)], axis=-1)
    assert (
        np.max(
            np.abs(shown.reshape(6, 20, 8, 20, 3).mean(axis=(1, 3)) - light.reshape(6, 20, 8, 20, 3).mean(axis=(1, 3)))
        )
        < 5e-4
    )
    np.testing.assert_array_equal(device, encode_frame(light, RESPONSE))


def test_levels_round_trip_and_what_is_out_of_range_or_not_a_number_is_clipped() -> None:
    device = np.tile(np.arange(256, dtype=np.uint8)[None, :, None], (1, 1, 3))
    light = np.stack([RESPONSE[c][device[:, :, c]] for c in range(3)], axis=-1).astype(np.float32)
    np.testing.assert_array_equal(encode_frame(light, RESPONSE, dither=False), device)
    odd = np.array([[[-1.0, 2.0, np.nan]]], np.float32)
    np.testing.assert_array_equal(encode_frame(odd, RESPONSE), [[[0, 255, 0]]])


def test_a_response_that_falls_and_a_frame_without_colour_are_refused() -> None:
    with pytest.raises(UsageError) as caught:
        encode_frame(np.zeros((4, 4, 3), np.float32), RESPONSE[:, ::-1])
    assert caught.value.code == "response-not-rising"
    with pytest.raises(UsageError) as caught:
        encode_frame(np.zeros((4, 4), np.float32), RESPONSE)
    assert caught.value.code == "frame-shape-wrong"
