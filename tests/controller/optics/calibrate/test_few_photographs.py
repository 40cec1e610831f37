"""A calibration from few photographs: computed opposites, code in colours, a map from before instead of a code."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.core.arrays import Float64, FloatImage
from controller.core.errors import CalibrationError
from controller.optics.calibrate.correspondence.captures import completed
from controller.optics.calibrate.correspondence.decode import decode
from controller.optics.calibrate.correspondence.gray_code import decode_cells, decode_colours
from controller.optics.calibrate.correspondence.known_map import check_map
from controller.optics.calibrate.metapixels.blur import blur_of, measure_contrasts
from controller.optics.calibrate.photometry.radiometry import measure_radiometry
from controller.optics.calibrate.photometry.separation import indirect_share, sinusoid_contrast
from controller.optics.calibrate.values import Correspondence, Radiometry
from controller.optics.capture.pattern_frames import device_frame, frame
from controller.optics.capture.patterns import CELL_PX, Code, PatternKind, PatternPlan, plan_patterns
from controller.optics.capture.profile import CameraNoise
from tests.controller.optics.calibrate.simulator import Scene, Stage, positions

pytestmark = pytest.mark.slow

NOISE = CameraNoise(1 / 30_000, 6 / 30_000)
"""The simulator's."""
SCENE = Scene()
MIXED = ((0.60, 0.30, 0.10), (0.25, 0.50, 0.25), (0.05, 0.30, 0.65))
"""Colours that the camera separates badly."""


def plan_of(scene: Scene, code: Code = Code.COLOURS, *, few: bool = True) -> PatternPlan:
    return plan_patterns(scene.projector_px, few=few, code=code)


@functools.cache
def photographed(scene: Scene, code: Code = Code.COLOURS) -> Mapping[str, FloatImage]:
    return MappingProxyType(Stage(scene).captures(plan_of(scene, code)))


def decoded(
    scene: Scene, captures: Mapping[str, FloatImage] | None = None, known_px: FloatImage | None = None
) -> Correspondence:
    plan = plan_of(scene, Code.COLOURS if known_px is None else Code.KNOWN)
    taken = completed(photographed(scene) if captures is None else captures, plan)
    return decode(taken, plan, noise=NOISE, known_px=known_px)


def rms(errors: Float64 | FloatImage) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


def truth(scene: Scene) -> Radiometry:
    return Radiometry(scene.response(), np.array(scene.mixing))


# -- the plan


@pytest.mark.parametrize(
    ("code", "shown", "with_whites"), [(Code.COLOURS, 16, 19.67), (Code.KNOWN, 11, 14.67), (Code.GRAY, 25, 28.67)]
)
def test_a_projector_of_the_papers_size_is_shown_few_pictures(code: Code, shown: int, with_whites: float) -> None:
    plan = plan_patterns((1400, 1050), few=True, code=code)
    alone = [pattern for pattern in plan if pattern.name not in ("black", "white")]
    assert len(alone) == shown
    # three exposures of white, and two of black for three projectors together
    assert len(alone) + 3 + 2 / 3 == pytest.approx(with_whites, abs=0.01)


@given(st.tuples(st.integers(24, 300), st.integers(24, 300)))
@settings(max_examples=20, deadline=None)
def test_the_code_in_colours_shows_the_bits_of_the_grey_one(size_px: tuple[int, int]) -> None:
    grey, colours = plan_patterns(size_px, few=True), plan_patterns(size_px, few=True, code=Code.COLOURS)
    bits = [frame(pattern, size_px) for pattern in grey.of_kind(PatternKind.GRAY)]
    pictures = [device_frame(pattern, size_px) for pattern in colours.of_kind(PatternKind.COLOUR_GRAY)]
    assert len(pictures) == -(-len(bits) // 3)
    shown = [picture[..., channel] for picture in pictures for channel in range(3)]
    for bit, channel in zip(bits, shown, strict=False):
        np.testing.assert_array_equal(channel, 255 * bit)
    assert not any(channel.any() for channel in shown[len(bits) :])


@given(st.tuples(st.integers(24, 300), st.integers(24, 300)))
@settings(max_examples=20, deadline=None)
def test_a_sinusoid_and_its_opposite_are_white_together(size_px: tuple[int, int]) -> None:
    plan = plan_patterns(size_px, few=True, code=Code.COLOURS)
    shown = {pattern.name: pattern for pattern in plan}
    assert len(plan.computed) == 9
    for pattern in plan.computed:
        assert pattern.name not in shown
        both = frame(pattern, size_px) + frame(shown[pattern.opposite], size_px)
        np.testing.assert_allclose(both, 1, atol=1e-6)


# -- positions


@pytest.mark.parametrize(
    ("scene", "limit_px"),
    [
        (SCENE, 0.02),
        (replace(SCENE, projector_blur_px=1.5), 0.025),
        (replace(SCENE, projector_blur_px=0.0, camera_blur_px=0.4), 0.03),
        (replace(SCENE, scale=1.5, seed=5), 0.02),
        (replace(SCENE, flicker=0.01), 0.02),
        (replace(SCENE, mixing=MIXED), 0.02),
        (replace(SCENE, indirect=0.3), 0.025),
        (replace(SCENE, white_segment=0.3), 0.02),
    ],
    ids=["in focus", "defocused", "razor-sharp", "small pixels", "flicker", "mixed colours", "indirect", "segment"],
)
def test_few_photographs_find_positions_to_a_few_hundredths_of_a_pixel(scene: Scene, limit_px: float) -> None:
    found = decoded(scene)
    error = (found.projector_px - positions(scene))[found.valid]
    assert rms(error) < limit_px
    assert np.abs(error).max() < 1
    assert np.mean(found.valid) > 0.34


@given(
    seed=st.integers(0, 2**20),
    electrons=st.floats(3_000, 60_000),
    indirect=st.floats(0, 0.4),
    flicker=st.floats(0, 0.012),
    own=st.floats(0.55, 0.95),
)
@settings(max_examples=6, deadline=None)
def test_no_noise_or_indirect_light_makes_a_wrong_fringe(
    seed: int, electrons: float, indirect: float, flicker: float, own: float
) -> None:
    side = (1 - own) / 2
    mixing = ((own, side, side), (side, own, side), (side, side, own))
    scene = Scene(
        camera_px=(120, 96), projector_px=(52, 44), seed=seed, electrons=electrons, read_electrons=electrons / 5000,
        indirect=indirect, flicker=flicker, mixing=mixing,
    )  # fmt: skip
    plan = plan_of(scene)
    noise = CameraNoise(1 / electrons, 1 / 5000)
    found = decode(completed(Stage(scene).captures(plan), plan), plan, noise=noise)
    error = np.abs(found.projector_px - positions(scene))[found.valid]
    assert np.mean(found.valid) > 0.2
    assert np.mean(error > 1) < 1e-3


@pytest.mark.parametrize(
    "swapped",
    [("phase-x-0", "phase-x-1"), ("blur-x-0", "blur-x-1"), ("gray-rgb-0", "gray-rgb-1"), ("phase-y-0", "white")],
)
def test_few_captures_in_the_wrong_order_are_refused(swapped: tuple[str, str]) -> None:
    captures = dict(photographed(SCENE))
    captures[swapped[0]], captures[swapped[1]] = captures[swapped[1]], captures[swapped[0]]
    with pytest.raises(CalibrationError) as caught:
        decoded(SCENE, captures)
    assert caught.value.code == "captures-inconsistent"


@pytest.mark.parametrize("name", ["white", "gray-rgb-1", "phase-y-1", "blur-x-0"])
def test_a_missing_capture_of_few_is_named(name: str) -> None:
    captures = dict(photographed(SCENE))
    del captures[name]
    with pytest.raises((CalibrationError, KeyError), match=name):
        decoded(SCENE, captures)


# -- the lamp, the blur, indirect light, the response


def test_a_lamp_that_flickers_is_told_from_the_two_steps_of_a_sinusoid() -> None:
    scene = replace(SCENE, noisy=False)
    plan, captures = plan_of(scene), dict(photographed(replace(SCENE, noisy=False)))
    brighter = {"phase-x-0": 1.012, "phase-x-1": 0.99, "blur-y-1": 1.02}
    for name, strength in brighter.items():
        captures[name] = captures["black"] + np.float32(strength) * (captures[name] - captures["black"])
    steady, flickering = completed(photographed(scene), plan), completed(captures, plan)
    for pattern in plan.computed:
        for name in (pattern.opposite, pattern.name):
            lit = steady[name] > 0.1
            assert np.median(np.abs(flickering[name] / steady[name] - 1)[lit]) < 0.002, name


def test_blur_is_measured_as_with_all_photographs() -> None:
    scene = replace(SCENE, projector_blur_px=0.8)
    full = plan_patterns(scene.projector_px)
    all_of_them = Stage(scene).captures(full)
    few, plan = completed(photographed(scene), plan_of(scene)), plan_of(scene)
    wanted, there = blur_of(measure_contrasts(all_of_them, full, decode(all_of_them, full)))
    found, here = blur_of(measure_contrasts(few, plan, decoded(scene)))
    both = there & here
    assert both.sum() > 0.95 * there.sum()
    assert np.median(np.abs(found - wanted)[both]) < 0.02
    assert np.abs(np.median((found - wanted)[both], axis=0)).max() < 0.02


@pytest.mark.parametrize("indirect", [0.05, 0.3])
def test_indirect_light_is_told_from_direct(indirect: float) -> None:
    scene = Scene(camera_px=(320, 248), projector_px=(140, 108), indirect=indirect)
    plan, captures = plan_of(scene), completed(photographed(scene), plan_of(scene))
    found = decode(captures, plan, noise=NOISE)
    white = captures["white"] - captures["black"]
    share = indirect_share(sinusoid_contrast(captures, plan, white, noise=NOISE), white, found.projector_px)
    inside = found.valid
    assert np.abs(np.median(share[inside], axis=0) - indirect).max() < 0.012
    assert np.std(share[inside]) < 0.02


def test_response_and_mixing_are_found_with_one_mosaic_less() -> None:
    scene = Scene(camera_px=(320, 248), projector_px=(140, 108))
    found, _ = measure_radiometry(photographed(scene), plan_of(scene), noise=NOISE)
    assert np.abs(found.response - scene.response()).max() < 0.007
    assert np.abs(found.mixing - np.array(scene.mixing)).max() < 0.005


# -- the code in colours


def test_the_code_in_colours_tells_the_same_cells_as_the_grey_one() -> None:
    grey_plan = plan_patterns(SCENE.projector_px)
    grey = Stage(SCENE).captures(grey_plan)
    black = grey["black"].sum(axis=2)
    half = (grey["white"].sum(axis=2) - black) / 2
    in_colours = decode_colours(photographed(SCENE), plan_of(SCENE), NOISE)
    for axis in range(2):
        wanted = decode_cells(grey, grey_plan, axis, black + half, half)
        clear = (wanted.weak == 0) & (in_colours[axis].weak == 0)
        assert clear.mean() > 0.3
        assert np.mean(wanted.cell[clear] != in_colours[axis].cell[clear]) < 1e-4


def test_paint_that_is_dark_in_one_colour_makes_the_code_unsure_and_not_wrong() -> None:
    """A patch that throws back no blue: its bits in blue are noise, and hardly a pixel of it may be taken for sure."""
    patch = np.s_[50:110, 60:150]
    captures = {name: image.copy() for name, image in photographed(SCENE).items()}
    random = np.random.default_rng(3)
    for image in captures.values():
        dark = 0.003 + 0.0006 * random.standard_normal(image[patch].shape[:2])
        image[patch][..., 2] = dark
    cells = decode_colours(captures, plan_of(SCENE), NOISE)
    assert (cells[0].sure & cells[1].sure)[patch].mean() < 0.01
    whole = decode_colours(photographed(SCENE), plan_of(SCENE), NOISE)
    assert (whole[0].sure & whole[1].sure)[patch].mean() > 0.9


# -- a map from before


def known_map(scene: Scene, shift_px: tuple[float, float] = (0.0, 0.0)) -> FloatImage:
    at = positions(scene) + np.array(shift_px)
    at[np.any((at < -0.5) | (at > np.array(scene.projector_px) - 0.5), axis=2)] = np.nan
    return np.asarray(at, np.float32)


@pytest.mark.parametrize("shift_px", [(0.0, 0.0), (1.0, -2.0), (-5.0, 4.0)])
def test_a_map_that_is_off_by_some_pixels_still_finds_the_fringe(shift_px: tuple[float, float]) -> None:
    found = decoded(SCENE, known_px=known_map(SCENE, shift_px))
    error = (found.projector_px - positions(SCENE))[found.valid]
    assert rms(error) < 0.02
    assert np.abs(error).max() < 1
    assert np.mean(found.valid) > 0.3


LARGE = Scene(camera_px=(320, 248), projector_px=(140, 108))


@given(st.floats(0, 2 * np.pi), st.floats(0, 0.8))
@settings(max_examples=10, deadline=None)
def test_a_map_of_a_stage_that_did_not_move_holds(direction: float, moved_px: float) -> None:
    shift = (moved_px * np.cos(direction), moved_px * np.sin(direction))
    check = check_map(photographed(LARGE), plan_of(LARGE), known_map(LARGE, shift), truth(LARGE))
    assert check.holds, check


@given(st.floats(0, 2 * np.pi), st.floats(5, 40))
@settings(max_examples=20, deadline=None)
def test_a_map_of_a_stage_that_moved_does_not_hold(direction: float, moved_px: float) -> None:
    shift = (moved_px * np.cos(direction), moved_px * np.sin(direction))
    check = check_map(photographed(LARGE), plan_of(LARGE), known_map(LARGE, shift), truth(LARGE))
    assert not check.holds, check


def test_a_small_part_that_moved_is_enough() -> None:
    known = known_map(LARGE)
    known[100:140, 120:160] += 24
    check = check_map(photographed(LARGE), plan_of(LARGE), known, truth(LARGE))
    assert check.agreeing > 0.95
    assert not check.holds


def test_a_map_that_knows_too_little_does_not_hold() -> None:
    known = known_map(LARGE)
    known[:, 130:150] = np.nan
    check = check_map(photographed(LARGE), plan_of(LARGE), known, truth(LARGE))
    assert check.covered < 0.95
    assert not check.holds


def test_the_cells_of_a_map_are_those_of_its_positions() -> None:
    known = known_map(LARGE)
    radiometry, _ = measure_radiometry(
        photographed(LARGE), plan_of(LARGE, Code.KNOWN), known_px=known, noise=NOISE
    )  # fmt: skip
    assert np.abs(radiometry.response - LARGE.response()).max() < 0.007
    assert CELL_PX == 12


def test_a_plan_without_code_needs_a_map() -> None:
    plan = plan_of(SCENE, Code.KNOWN)
    with pytest.raises(CalibrationError) as caught:
        decode(completed(photographed(SCENE), plan), plan)
    assert caught.value.code == "map-missing"
