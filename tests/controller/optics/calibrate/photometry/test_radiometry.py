from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from controller.core.arrays import Float64, FloatImage
from controller.core.errors import CalibrationError
from controller.optics.calibrate.photometry.colour_tiles import KnownIndirect, measure_tiles, tile_code
from controller.optics.calibrate.photometry.radiometry import measure_radiometry
from controller.optics.calibrate.values import Radiometry
from controller.optics.capture.pattern_frames import device_frame
from controller.optics.capture.patterns import PatternKind, plan_patterns
from tests.controller.optics.calibrate.photometry.linearity import check_linearity
from tests.controller.optics.calibrate.simulator import Scene, Stage
from tests.controller.optics.calibrate.spectra import as_tuples, colours

pytestmark = pytest.mark.slow

SIZE_PX = (140, 108)
PLAN = plan_patterns(SIZE_PX)
NEEDED = [pattern for pattern in PLAN if not pattern.needs_response]
X = np.arange(256) / 255


def scene(**changes: float) -> Scene:
    return Scene(camera_px=(320, 248), projector_px=SIZE_PX, scale=2.4, **changes)  # type: ignore[arg-type]


@functools.cache
def before_response(of: Scene) -> Mapping[str, FloatImage]:
    stage = Stage(of)
    return MappingProxyType({p.name: stage.photograph(device_frame(p, SIZE_PX)) for p in NEEDED})


def off(found: Radiometry, of: Scene) -> tuple[float, float]:
    """Largest errors of the responses and of the mixing."""
    response = float(np.max(np.abs(found.response - of.response())))
    return response, float(np.max(np.abs(found.mixing - np.array(of.mixing))))


def test_response_and_mixing_are_found_within_half_a_percent() -> None:
    radiometry, report = measure_radiometry(before_response(scene()), PLAN)
    assert max(off(radiometry, scene())) < 0.005
    assert radiometry.paint is None
    np.testing.assert_allclose(radiometry.mixing.sum(axis=1), 1)
    assert report.scatter < 0.005
    assert report.tiles > 150
    assert np.all(np.diff(radiometry.response, axis=1) >= 0)
    assert np.all(radiometry.response[:, 0] == 0)
    assert np.all(radiometry.response[:, -1] == 1)


@pytest.mark.parametrize("blur_px", [1.0, 1.5])
def test_neighbouring_tiles_do_not_tint_each_other_out_of_focus(blur_px: float) -> None:
    defocused = scene(projector_blur_px=blur_px)
    radiometry, _ = measure_radiometry(before_response(defocused), PLAN)
    assert max(off(radiometry, defocused)) < 0.01


def test_tiles_of_several_cells_are_measured_across_the_borders_of_their_cells() -> None:
    # As at 1400x1050, where a tile is 2x2 cells; in sharp focus the line between two cells is in doubt everywhere.
    plan = replace(
        PLAN, patterns=tuple(replace(p, tile_cells=2) if p.kind is PatternKind.COLOUR_TILES else p for p in PLAN)
    )
    sharp = scene(projector_blur_px=0.1)
    stage = Stage(sharp)
    captures = {p.name: stage.photograph(device_frame(p, SIZE_PX)) for p in plan if not p.needs_response}
    black, white = captures["black"], captures["white"] - captures["black"]
    tiles = measure_tiles(captures, plan, black, white, code=tile_code(captures, plan, black, white))
    assert len(tiles.ratio) >= 60
    light = [sharp.response()[channel][tiles.levels[:, channel]] for channel in range(3)]
    shown = np.stack(light, axis=1) @ np.array(sharp.mixing).T
    assert np.median(np.abs(tiles.ratio - shown)) < 0.02


def test_a_reflection_that_only_some_pixels_see_does_not_bend_the_response() -> None:
    captures = dict(before_response(scene()))
    for pattern in PLAN.of_kind(PatternKind.COLOUR_TILES):
        image = captures[pattern.name].copy()
        image[90:130, 100:180] += 0.2
        captures[pattern.name] = image
    radiometry, _ = measure_radiometry(captures, PLAN)
    assert max(off(radiometry, scene())) < 0.005


def test_mixing_that_depends_on_the_paint_is_found() -> None:
    """For other paints and other light than those it was found by: against what their spectra say."""
    spectral = scene(spectra=as_tuples(colours()))  # type: ignore[arg-type]
    radiometry, report = measure_radiometry(before_response(spectral), PLAN)
    assert float(np.max(np.abs(radiometry.response - spectral.response()))) < 0.005
    assert report.scatter < 0.006
    assert radiometry.paint is not None
    np.testing.assert_allclose(radiometry.paint.sum(axis=1), np.eye(3), atol=1e-9)
    rng = np.random.default_rng(5)
    paint, shown = rng.uniform(0.1, 1.0, (500, 3)), rng.uniform(0.0, 1.0, (500, 3))
    seen = np.einsum("kjc,tj,tc->tk", colours(), paint, shown)
    white = np.einsum("kjc,tj->tk", colours(), paint)
    with_paint = np.einsum("tj,kcj,tc->tk", white, radiometry.paint, shown)
    alone = white * (shown @ radiometry.mixing.T)
    assert np.sqrt(np.mean((with_paint - seen) ** 2)) < 0.25 * np.sqrt(np.mean((alone - seen) ** 2))


def test_light_that_comes_back_from_the_surroundings_is_told_apart() -> None:
    """A twentieth of a frame's mean light on everything: a room with pale walls."""
    captures = dict(before_response(scene()))
    light = captures["white"] - captures["black"]
    for pattern in (PatternKind.COLOUR_TILES, PatternKind.GRAY):
        for one in PLAN.of_kind(pattern):
            own = captures[one.name] - captures["black"]
            shown = own.mean(axis=(0, 1)) / light.mean(axis=(0, 1))
            captures[one.name] = (captures["black"] + 0.95 * own + 0.05 * shown * light).astype(np.float32)
    radiometry, report = measure_radiometry(captures, PLAN)
    assert max(off(radiometry, scene())) < 0.006
    assert report.stray == pytest.approx(0.05, abs=0.01)


@given(st.lists(st.floats(-0.02, 0.02), min_size=3, max_size=3))
@settings(max_examples=8, deadline=None)
def test_a_lamp_that_flickers_between_the_photographs_bends_no_response(flicker: list[float]) -> None:
    captures = dict(before_response(scene()))
    for pattern, change in zip(PLAN.of_kind(PatternKind.COLOUR_TILES), flicker, strict=True):
        own = captures[pattern.name] - captures["black"]
        captures[pattern.name] = (captures["black"] + np.float32(1 + change) * own).astype(np.float32)
    radiometry, report = measure_radiometry(captures, PLAN)
    assert max(off(radiometry, scene())) < 0.006
    assert report.flicker == pytest.approx(max(abs(change) for change in flicker), abs=0.004)


def in_a_pale_room(flicker: tuple[float, ...]) -> tuple[Radiometry, float]:
    """A third of white comes by way of other surfaces, and is known; what is found, and the flicker that is."""
    captures, truth = dict(before_response(scene())), scene()
    black, white = captures["black"], captures["white"] - captures["black"]
    thrown = (white / 3).astype(np.float32)
    captures["white"] = (black + white + thrown).astype(np.float32)
    for pattern, change in zip(PLAN.of_kind(PatternKind.COLOUR_TILES), flicker, strict=True):
        own = captures[pattern.name] - black
        mean = own.mean(axis=(0, 1)) / white.mean(axis=(0, 1))
        captures[pattern.name] = (black + (1 + change) * (own + thrown * mean)).astype(np.float32)
    for pattern in PLAN.of_kind(PatternKind.GRAY):
        captures[pattern.name] = (captures[pattern.name] + thrown / 2).astype(np.float32)
    known = KnownIndirect(thrown, Radiometry(truth.response(), np.array(truth.mixing)))
    radiometry, report = measure_radiometry(captures, PLAN, indirect=known)
    return radiometry, report.flicker


@pytest.mark.parametrize("flicker", [(0.03, 0.03, 0.03), (-0.03, -0.03, -0.03), (-0.04, -0.03, -0.04)])
def test_a_lamp_that_flickers_throws_more_light_at_other_surfaces_too(flicker: tuple[float, ...]) -> None:
    steady, _ = in_a_pale_room((0.0, 0.0, 0.0))
    found, seen = in_a_pale_room(flicker)
    at = 64
    np.testing.assert_allclose(found.response[:, at], steady.response[:, at], rtol=0.01)
    assert seen == pytest.approx(max(abs(change) for change in flicker), abs=0.01)


def thrown_back(share: float, spread_px: float, *, segment: float = 0.0) -> tuple[dict[str, FloatImage], KnownIndirect]:
    """A scene of which ``share`` comes by way of other surfaces: from around, as a Gaussian of ``spread_px``."""
    truth = scene(white_segment=segment)
    captures = dict(before_response(truth))
    black, white = captures["black"], captures["white"] - captures["black"]
    for pattern in PLAN.of_kind(PatternKind.COLOUR_TILES):
        own = captures[pattern.name] - black
        lit = cv2.GaussianBlur(white, (0, 0), spread_px)
        around = cv2.GaussianBlur(own, (0, 0), spread_px) / np.maximum(lit, 1e-6)
        captures[pattern.name] = (black + (1 - share) * own + share * white * around).astype(np.float32)
    for pattern in PLAN.of_kind(PatternKind.GRAY):
        own = captures[pattern.name] - black
        captures[pattern.name] = (black + (1 - share) * own + share / 2 * white).astype(np.float32)
    known = Radiometry(truth.response(), np.array(truth.mixing), segment)
    return captures, KnownIndirect((share * white).astype(np.float32), known)


def test_tiles_that_do_not_fit_tell_no_flicker() -> None:
    """A lamp in the room shines on a part of the object in one photograph alone."""
    captures, known = thrown_back(0.05, 80.0)
    image = captures["mosaic-1"].copy()
    image[60:130, 100:200] *= 1.5
    captures["mosaic-1"] = image
    radiometry, report = measure_radiometry(captures, PLAN, indirect=known)
    assert report.flicker < 0.004
    assert max(off(radiometry, scene())) < 0.005


@pytest.mark.parametrize("spread_px", [50.0, 80.0])
def test_light_that_comes_back_from_nearby_tiles_bends_no_response(spread_px: float) -> None:
    """Known is the picture's mean alone; tiles around are brighter or darker than it."""
    captures, known = thrown_back(0.15, spread_px)
    radiometry, _ = measure_radiometry(captures, PLAN, indirect=known)
    off_64 = radiometry.response[:, 64] / scene().response()[:, 64] - 1
    assert np.abs(off_64).max() < 0.02


@dataclass(frozen=True)
class Curved(Scene):
    """A scene whose projector has one of the usual curves in all channels."""

    curve: str = "linear"

    def response(self) -> Float64:
        return np.stack([CURVES[self.curve](X)] * 3)


CURVES: dict[str, Callable[[Float64], Float64]] = {
    "gamma 1.8": lambda x: x**1.8,
    "gamma 2.6": lambda x: x**2.6,
    "sRGB": lambda x: np.where(x < 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4),
    "S": lambda x: 3 * x**2 - 2 * x**3,
    "linear": lambda x: x,
}


@pytest.mark.parametrize("curve", CURVES)
def test_usual_curves_are_found_within_half_a_percent(curve: str) -> None:
    curved = Curved(camera_px=(320, 248), projector_px=SIZE_PX, curve=curve)
    radiometry, _ = measure_radiometry(before_response(curved), PLAN)
    assert max(off(radiometry, curved)) < 0.005


@pytest.mark.parametrize("name", ["black", "white", "gray-x-1", "mosaic-1"])
def test_a_missing_photograph_is_named(name: str) -> None:
    captures = {key: image for key, image in before_response(scene()).items() if key != name}
    with pytest.raises(CalibrationError, match=name) as caught:
        measure_radiometry(captures, PLAN)
    assert caught.value.code == "capture-missing"


@pytest.mark.parametrize(("value", "noise"), [(0.0, 0.0), (1.0, 0.0), (np.nan, 0.0), (0.01, 0.001)])
def test_a_dead_projector_is_named_as_dark(value: float, noise: float) -> None:
    rng = np.random.default_rng(1)
    shot = {key: rng.normal(value, noise, image.shape) for key, image in before_response(scene()).items()}
    captures = {key: image.astype(np.float32) for key, image in shot.items()}
    with pytest.raises(CalibrationError) as caught:
        measure_radiometry(captures, PLAN)
    assert caught.value.code == "projector-dark"


def test_tiles_with_saturated_pixels_are_left_out() -> None:
    captures = dict(before_response(scene()))
    image = captures["mosaic-0"].copy()
    image[100:140, 120:200] = np.nan
    captures["mosaic-0"] = image
    radiometry, report = measure_radiometry(captures, PLAN)
    assert max(off(radiometry, scene())) < 0.006
    assert report.tiles < measure_radiometry(before_response(scene()), PLAN)[1].tiles


@pytest.mark.parametrize("share", [0.06, 0.35])
def test_a_white_segment_in_the_colour_wheel_is_measured(share: float) -> None:
    wheel = scene(white_segment=share)
    radiometry, report = measure_radiometry(before_response(wheel), PLAN)
    assert radiometry.segment == pytest.approx(share, abs=0.01)
    assert report.segment == radiometry.segment
    assert max(off(radiometry, wheel)) < 0.01


@pytest.mark.parametrize("share", [0.06, 0.15])
def test_light_of_other_tiles_is_no_smaller_segment_and_no_weaker_lamp(share: float) -> None:
    captures, known = thrown_back(share, 50.0, segment=0.2)
    for indirect in (None, known):
        radiometry, report = measure_radiometry(captures, PLAN, indirect=indirect)
        assert radiometry.segment == pytest.approx(0.2, abs=0.01)
        assert report.flicker < 0.01
    off_64 = radiometry.response[:, 64] / scene().response()[:, 64] - 1
    assert np.abs(off_64).max() < 0.03


def test_colours_that_add_have_no_segment() -> None:
    assert measure_radiometry(before_response(scene()), PLAN)[0].segment == 0


@given(arrays(np.float64, (20, 3), elements=st.floats(0, 1)), st.floats(0, 0.6))
def test_what_a_segment_adds_is_taken_off_again(light: Float64, segment: float) -> None:
    radiometry = Radiometry(np.tile(X, (3, 1)), np.eye(3), segment)
    np.testing.assert_allclose(radiometry.channels(radiometry.emitted(light)), light, atol=1e-12)


def test_white_that_is_brighter_than_any_segment_makes_it_is_refused() -> None:
    captures = dict(before_response(scene()))
    captures["white"] = captures["black"] + 1.3 * (captures["white"] - captures["black"])
    with pytest.raises(CalibrationError) as caught:
        measure_radiometry(captures, PLAN)
    assert caught.value.code == "colours-do-not-add"


def test_photographs_in_the_wrong_order_are_refused() -> None:
    captures = dict(before_response(scene()))
    captures["mosaic-0"], captures["mosaic-1"] = captures["mosaic-1"], captures["mosaic-0"]
    with pytest.raises(CalibrationError) as caught:
        measure_radiometry(captures, PLAN)
    assert caught.value.code in ("colours-do-not-add", "colours-alike")


def test_a_linear_camera_is_told_from_a_bent_one() -> None:
    random = np.random.default_rng(3)
    light = random.uniform(0, 0.3, (100, 120, 3)).astype(np.float32)
    long = 3.2 * light
    measured = check_linearity(light, np.where(long < 0.98, long, np.nan).astype(np.float32), 3.0)
    assert measured.ratio == pytest.approx(3.2, rel=1e-4)
    assert measured.worst < 1e-3
    assert check_linearity(light, (long**1.1).astype(np.float32), 3.0).worst > 0.03
