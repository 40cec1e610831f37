from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.core.arrays import FloatImage
from controller.core.errors import CalibrationError
from controller.optics.capture.latency import (
    CHANGED_FRAMES,
    RESOLUTION_S,
    Fingerprint,
    blocks,
    changed_share,
    measure_latency,
    same_picture,
    seen_change,
)
from controller.optics.capture.profile import CameraNoise

EXPOSURE_S = 1 / 15
NOISE = CameraNoise()


@dataclass
class Stage:
    """Projectors that are late by ``lags_s`` (left half and right half), a camera that opens ``shutter_s`` late."""

    lags_s: tuple[float, float]
    shutter_s: float = 0.0
    falls_later_s: float = 0.0
    dark: bool = False
    looks: list[tuple[bool, float]] = field(default_factory=list)
    seed: int = 0

    def look(self, white: bool, delay_s: float, *, before_s: float) -> FloatImage:
        self.looks.append((white, delay_s))
        image = np.full((128, 192, 3), 0.004, np.float32)
        for half, lag_s in zip((slice(0, 96), slice(96, 192)), self.lags_s, strict=True):
            rises_s, falls_s = lag_s, lag_s + self.falls_later_s
            came_s, late_s = (falls_s, rises_s) if white else (rises_s, falls_s)
            # What is not shown for long enough before leaves some of the picture before it, which is the new one.
            old = 1.0 if len(self.looks) <= 2 else float(np.clip((before_s - came_s) / EXPOSURE_S, 0, 1))
            new = 1 - old * (1 - float(np.clip((delay_s + self.shutter_s + EXPOSURE_S - late_s) / EXPOSURE_S, 0, 1)))
            light = new if white else 1 - new
            image[:, half] += 0.0 if self.dark else 0.6 * light
        random = np.random.default_rng(len(self.looks) + self.seed)
        noise = np.sqrt(NOISE.shot * image + NOISE.read**2) * random.standard_normal(image.shape)
        flicker = 1 + 0.01 * random.standard_normal()
        return np.asarray(image * flicker + noise, np.float32)


@settings(max_examples=30, deadline=None)
@given(st.floats(0.0, 0.9), st.floats(0.0, 0.9), st.floats(0.0, 0.2), st.integers(0, 1000))
def test_the_delay_is_enough_for_the_latest_projector_and_little_more(
    left_s: float, right_s: float, shutter_s: float, seed: int
) -> None:
    stage = Stage((left_s, right_s), shutter_s, seed=seed)
    found = measure_latency(stage.look)
    needed_s = max(left_s, right_s) - shutter_s
    assert found.wait_s >= needed_s
    assert found.delay_s <= max(needed_s, 0.0) + 5 * RESOLUTION_S
    assert len(stage.looks) <= 16


def test_a_quick_stage_costs_four_photographs() -> None:
    stage = Stage((0.03, 0.03), shutter_s=0.08)
    assert measure_latency(stage.look).delay_s == 0
    assert len(stage.looks) <= 5


@pytest.mark.parametrize(("rises_s", "falls_s"), [(0.1, 0.14), (0.5, 0.3)])
def test_a_panel_that_falls_later_or_earlier_than_it_rises_is_waited_for(rises_s: float, falls_s: float) -> None:
    found = measure_latency(Stage((rises_s, rises_s), falls_later_s=falls_s - rises_s).look)
    assert found.wait_s >= max(rises_s, falls_s)


def test_white_that_never_comes_is_explained() -> None:
    for stage in (Stage((0.1, 0.1), dark=True), Stage((9.0, 9.0))):
        with pytest.raises(CalibrationError) as failed:
            measure_latency(stage.look)
        assert failed.value.code == "picture-not-seen"


def test_the_share_of_the_outputs_that_changes() -> None:
    old = {"P1": np.zeros((40, 50, 3), np.uint8), "P2": np.zeros((40, 50, 3), np.uint8)}
    new = {name: image.copy() for name, image in old.items()}
    assert changed_share(old, new) == 0
    new["P1"][:20] = 255
    assert changed_share(old, new) == 0.25
    assert changed_share(old, {"P1": new["P1"]}) == 1
    dots = np.zeros((40, 50, 3), np.uint8)
    dots[::16, ::16] = 255
    assert changed_share(old, {**old, "P1": dots}) < CHANGED_FRAMES


def print_of(light: FloatImage, exposure_s: float, seed: int) -> Fingerprint:
    signal = light * exposure_s
    noisy = signal + np.sqrt(NOISE.shot * signal + NOISE.read**2) * np.random.default_rng(seed).standard_normal(
        signal.shape
    )
    return Fingerprint((np.clip(noisy, -0.01, 1) / exposure_s).astype(np.float32), 1 / exposure_s)


def gray(phase: int, low: float = 0.02, high: float = 8.0) -> FloatImage:
    return np.where((np.arange(96) // 8 + phase) % 2 == 0, low, high)[None, :].repeat(64, axis=0).astype(np.float32)


@pytest.mark.parametrize(("first_s", "second_s"), [(0.1, 0.1), (0.1, 0.4), (0.4, 0.05)])
def test_the_same_picture_is_known_whatever_its_exposure_and_another_one_is_told_apart(
    first_s: float, second_s: float
) -> None:
    assert same_picture(print_of(gray(0), first_s, 1), print_of(1.01 * gray(0), second_s, 2))
    assert not same_picture(print_of(gray(0), first_s, 1), print_of(gray(1), second_s, 2))


def test_a_sinusoid_with_a_tenth_of_its_contrast_left_is_told_from_its_next_phase() -> None:
    x = np.arange(96, dtype=np.float32)[None, :].repeat(64, axis=0)
    steps = [(4 + 0.4 * np.cos(x - 2.1 * n)).astype(np.float32) for n in range(2)]
    assert not same_picture(print_of(steps[0], 0.1, 1), print_of(steps[1], 0.1, 2))
    assert same_picture(print_of(steps[0], 0.1, 1), print_of(steps[0], 0.1, 2))


def test_two_dark_pictures_and_two_blown_ones_are_the_same() -> None:
    for light in (0.0, 100.0):
        flat = np.full((64, 96), light, np.float32)
        assert same_picture(print_of(flat, 0.1, 1), print_of(flat, 0.1, 2))
    assert not same_picture(print_of(gray(0, high=100), 0.1, 1), print_of(gray(1, high=100), 0.1, 2))
    assert not same_picture(Fingerprint(gray(0), 10.0), Fingerprint(gray(0)[:5], 10.0))


@pytest.mark.parametrize("to_lit", [True, False])
@pytest.mark.parametrize(
    ("late_s", "readout_s"), [((0.0, 0.0), 0.0), ((0.008, 0.0), 0.02), ((0.0, 0.021), 0.03), ((0.0, -0.021), -0.01)]
)
def test_outputs_that_overlap_are_found_to_change_when_they_did(
    late_s: tuple[float, float], readout_s: float, to_lit: bool
) -> None:
    """Two outputs on 160 columns each of 256, of which 64 have both; a shutter that opens row by row."""
    rows, columns, exposure_s, random = np.arange(160)[:, None], np.arange(256), 0.15, np.random.default_rng(3)
    parts = (60, columns < 160), (200, columns > 96)
    whites = [(0.2 + 0.6 * np.exp(-(((columns - at) / 60) ** 2))) * lit + 0 * rows for at, lit in parts]
    lamps = (0.9, 1.1)  # since the calibration
    # The change comes in the middle of the exposure of the middle row.
    ends_s = exposure_s / 2 + readout_s * (rows / 159 - 0.5)
    shares = [np.clip((ends_s - late) / exposure_s, 0, 1) for late in late_s]
    if not to_lit:
        shares = [1 - share for share in shares]

    def taken(*lit: float | np.ndarray) -> np.ndarray:
        light = np.full((160, 256), 0.004)
        for lamp, one, white in zip(lamps, lit, whites, strict=True):
            light += lamp * one * white / 3
        noise = np.sqrt(NOISE.shot * light + NOISE.read**2) * random.standard_normal(light.shape)
        return blocks((light + noise).astype(np.float32))

    black, full, seen = taken(0.0, 0.0), taken(1.0, 1.0), taken(*shares)
    before, after = (black, full) if to_lit else (full, black)
    each = np.stack([blocks(white.astype(np.float32)) for white in whites])
    *found, rise = seen_change(seen, before, after, each)
    np.testing.assert_allclose((0.5 - np.array(found)) * exposure_s, late_s, atol=2e-4)
    assert rise * exposure_s == pytest.approx(readout_s, abs=6e-4)
