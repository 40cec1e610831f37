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
from controller.optics.calibrate.photometry.colour_tiles import KnownIndirect
from controller.optics.calibrate.photometry.radiometry import measure_radiometry
from controller.optics.calibrate.photometry.waveform import Wave, coarse_waves, held_to
from controller.optics.calibrate.values import PhaseMap, Radiometry
from controller.optics.capture.pattern_frames import device_frame
from controller.optics.capture.patterns import plan_patterns
from tests.controller.optics.calibrate.simulator import ENLARGED, Scene, Stage, positions

pytestmark = pytest.mark.slow

SIZE_PX, CAMERA_PX = (140, 108), (320, 248)
PLAN = plan_patterns(SIZE_PX)
MUCH = 0.3
"""Indirect light with which tiles are believed little."""


def scene(**changes: object) -> Scene:
    return Scene(camera_px=CAMERA_PX, projector_px=SIZE_PX, scale=2.4, **changes)  # type: ignore[arg-type]


USED: Float64 = scene().response() ** np.array([[1.06], [0.95], [1.04]])
"""By which the sinusoids are shown: no sinusoids in light."""


@functools.cache
def place(of: Scene) -> PhaseMap:
    """Where the camera truly looks, and how far a projector's pixel truly spreads."""
    box = (of.lit_share_of_pixel / ENLARGED) ** 2 / 12
    variance = box + of.projector_blur_px**2 + (of.camera_blur_px**2 + 1 / 12) / of.scale**2
    spread = np.tile(np.array([variance, 0, variance], np.float32), (SIZE_PX[1], SIZE_PX[0], 1))
    return PhaseMap(positions(of).astype(np.float32), spread)


@functools.cache
def seen(of: Scene) -> Mapping[str, FloatImage]:
    stage = Stage(of)
    wanted = [p for p in PLAN if p.name in ("black", "white") or p.name.startswith("phase-")]
    return MappingProxyType({p.name: stage.photograph(device_frame(p, SIZE_PX, USED)) for p in wanted})


def waves(of: Scene, captures: Mapping[str, FloatImage], at: PhaseMap | None = None) -> tuple[Wave, ...]:
    white = captures["white"] - captures["black"]
    return coarse_waves(captures, PLAN, white, at or place(of), np.ones(white.shape[:2], np.bool_), USED)


def held(
    of: Scene,
    captures: Mapping[str, FloatImage],
    known: Radiometry,
    share: float = MUCH,
    at: PhaseMap | None = None,
    near: Float64 | None = None,
) -> Radiometry:
    white = captures["white"] - captures["black"]
    return held_to(waves(of, captures, at), known, USED, np.full(white.shape, share, np.float32), white, near)


def wrong(of: Scene) -> Radiometry:
    """As the sinusoids were shown, with the true mixing."""
    return Radiometry(USED, np.array(of.mixing), of.white_segment)


def error(found: Radiometry, of: Scene) -> float:
    return float(np.abs(found.response - of.response()).max())


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"indirect": 0.3},
        {"indirect": 0.3, "flicker": 0.01},
        {"indirect": 0.2, "projector_blur_px": 0.7},
        {"indirect": 0.2, "white_segment": 0.2},
        {"indirect": 0.2, "apart_px": ((0.3, 0.1), (0.0, 0.0), (-0.2, 0.3))},
    ],
    ids=["dark", "indirect", "flicker", "blur", "segment", "colours apart"],
)
def test_sinusoids_tell_the_response_whatever_light_is_indirect(changes: dict[str, object]) -> None:
    of = scene(**changes)
    assert error(wrong(of), of) > 0.02
    assert error(held(of, seen(of), wrong(of)), of) < 0.0025


def test_a_true_response_stays_as_it_is() -> None:
    """Whole lines of the sinusoids are up to 0.001 brighter or darker than asked for."""
    of = scene(indirect=0.3)
    true = replace(wrong(of), response=of.response())
    assert error(held(of, seen(of), true), of) < 0.001


def test_what_was_found_before_brings_the_response_nearer() -> None:
    of = scene(indirect=0.3)
    first = held(of, seen(of), wrong(of))
    second = held(of, seen(of), wrong(of), near=first.response)
    assert error(second, of) < 0.8 * error(first, of)


@pytest.mark.parametrize("off_px2", [-0.05, 0.05])
def test_a_blur_that_is_measured_only_nearly_changes_the_response_little(off_px2: float) -> None:
    of = scene(indirect=0.3)
    true = replace(wrong(of), response=of.response())
    at = place(of)
    nearly = replace(at, spread_px2=at.spread_px2 + np.array([off_px2, 0, off_px2], np.float32))
    found = held(of, seen(of), true, at=nearly).response - held(of, seen(of), true).response
    assert float(np.abs(found).max()) < 0.0003


@settings(max_examples=6, deadline=None)
@given(
    veil=st.floats(0, 0.5),
    near=st.floats(0, 0.1),
    turned=st.floats(0, 2 * np.pi),
    lamps=st.lists(st.floats(0.98, 1.02), min_size=6, max_size=6),
)
def test_neither_veils_nor_near_surfaces_nor_lamps_change_what_is_found(
    veil: float, near: float, turned: float, lamps: list[float]
) -> None:
    """A near surface throws back some of a sinusoid of the same period, in any phase."""
    of = scene()
    captures = dict(seen(of))
    white, black = captures["white"] - captures["black"], captures["black"]
    at = positions(of)
    names = [name for name in captures if name.startswith("phase-")]
    for lamp, name in zip(lamps, names, strict=True):
        step = next(p for p in PLAN if p.name == name)
        wave = np.cos(2 * np.pi * at @ np.array(step.frequency) - step.phase_rad + turned)[..., None]
        more = white * (veil + near * (0.5 + 0.5 * wave))
        captures[name] = (black + lamp * (captures[name] - black + more)).astype(np.float32)
    without, found = (held(of, one, wrong(of)).response for one in (seen(of), captures))
    assert float(np.abs(found - without).max()) < 0.003


def test_a_response_from_tiles_is_nearer_to_the_truth_in_much_indirect_light() -> None:
    of = scene(indirect=0.3, flicker=0.01)
    stage = Stage(of)
    captures = {p.name: stage.photograph(device_frame(p, SIZE_PX)) for p in PLAN if not p.needs_response}
    white = captures["white"] - captures["black"]
    share = np.full(white.shape, 0.3, np.float32)
    share[:, 160:] = 0.33
    tiles, _ = measure_radiometry(captures, PLAN, indirect=KnownIndirect(share * white, wrong(of)))
    found = held_to(waves(of, seen(of)), tiles, USED, share, white)
    assert error(found, of) < 0.6 * error(tiles, of)
    np.testing.assert_array_equal(found.mixing, tiles.mixing)


def test_tiles_are_believed_where_no_light_is_indirect() -> None:
    of = scene()
    little, much = (held(of, seen(of), wrong(of), share).response - USED for share in (0.0, MUCH))
    middle = np.abs(much) > 0.008
    assert middle.any()
    assert np.all(np.abs(little[middle]) < 0.6 * np.abs(much[middle]))


def test_responses_still_rise_from_black_to_white() -> None:
    of = scene(indirect=0.3)
    found = held(of, seen(of), wrong(of)).response
    assert np.all(np.diff(found, axis=1) >= 0)
    np.testing.assert_array_equal(found[:, [0, -1]], [[0, 1]] * 3)


def test_too_few_pixels_change_nothing() -> None:
    of = scene()
    captures = seen(of)
    white = captures["white"] - captures["black"]
    some = np.zeros(white.shape[:2], np.bool_)
    some[100:140, 100:160] = True
    known = wrong(of)
    found = coarse_waves(captures, PLAN, white, place(of), some, USED)
    assert found == ()
    assert held_to(found, known, USED, np.zeros_like(white), white) is known


def test_computed_opposites_say_nothing() -> None:
    plan = plan_patterns(SIZE_PX, few=True)
    nothing = np.zeros((*CAMERA_PX[::-1], 3), np.float32)
    assert coarse_waves({}, plan, nothing, place(scene()), np.ones(nothing.shape[:2], np.bool_), USED) == ()


def test_a_missing_photograph_is_told() -> None:
    captures = dict(seen(scene()))
    del captures["phase-y-1"]
    with pytest.raises(CalibrationError) as caught:
        waves(scene(), captures)
    assert caught.value.code == "capture-missing"
