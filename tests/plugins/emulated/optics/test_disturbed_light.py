"""What lenses, panels, lamps and sensors do beyond the ideal, in photographs, each against its formula."""

from __future__ import annotations

import dataclasses
import io
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import rawpy
from scipy.ndimage import gaussian_filter

from plugins.emulated.core.shot import ShotSettings
from plugins.emulated.core.truth import BenchTruth, Panels, Pose, Sensor, write_truth
from plugins.emulated.optics.objects import StageObject
from plugins.emulated.optics.rays import cast
from plugins.emulated.optics.render import Renderer, emitted
from plugins.emulated.optics.world import World
from plugins.emulated.projectors.lamp import EmulatedLamp, LampTiming

Image = npt.NDArray[np.float64]
DARK = 128


def screen() -> StageObject:
    """A flat screen that is larger than every picture."""
    vertices = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], np.float32)
    return StageObject(
        vertices=vertices,
        faces=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        normals=np.broadcast_to(np.array([0.0, 0.0, -1.0], np.float32), (2, 3, 3)).copy(),
        paint="corners",
        corner_values=np.full((2, 3, 3), 0.5, np.float32),
        texture=np.zeros(0, np.float32),
        parts=np.zeros(1, np.int32),
    )


@pytest.fixture
def truth(tiny_truth: BenchTruth) -> BenchTruth:
    """One projector straight before the screen; everything else ideal, and light in proportion to values."""
    one = tiny_truth.projectors[0]
    width, height = one.lens.size_px
    lens = dataclasses.replace(one.lens, centre_px=((width - 1) / 2, (height - 1) / 2))
    light = dataclasses.replace(
        one.light, gamma=(1.0, 1.0, 1.0), s_curve=(0.0, 0.0, 0.0), black_level=0.0, fill_factor=1.0, vignetting=0.0
    )
    focus = dataclasses.replace(one.focus, sharpest_px=0.7, slope_px_per_m=0.0)
    pose = Pose((0.0, 0.0, -1.0), (0.0, 0.0, 0.0))
    camera = dataclasses.replace(
        tiny_truth.camera, pose=Pose((0.0, 0.0, -1.2), (0.0, 0.0, 0.0)), psf_sigma_px=0.0, vignetting=0.0
    )
    projector = dataclasses.replace(one, pose=pose, lens=lens, light=light, focus=focus)
    return dataclasses.replace(tiny_truth, camera=camera, projectors=(projector,), ambient=(0.0, 0.0, 0.0))


def picture(truth: BenchTruth, frame: npt.NDArray[np.uint8]) -> Image:
    renderer = Renderer(truth, cast(truth, screen(), lambda share: None))
    return np.asarray(renderer.light([frame], [1.0]), np.float64)


def with_projector(truth: BenchTruth, **changes: Any) -> BenchTruth:
    return dataclasses.replace(truth, projectors=(dataclasses.replace(truth.projectors[0], **changes),))


def with_light(truth: BenchTruth, **changes: Any) -> BenchTruth:
    return with_projector(truth, light=dataclasses.replace(truth.projectors[0].light, **changes))


def with_sensor(truth: BenchTruth, **changes: Any) -> BenchTruth:
    sensor: Sensor = dataclasses.replace(truth.camera.sensor, **changes)
    return dataclasses.replace(truth, camera=dataclasses.replace(truth.camera, sensor=sensor))


def blank(truth: BenchTruth, *value: int) -> npt.NDArray[np.uint8]:
    frame = np.zeros((*truth.projectors[0].lens.size_px[::-1], 3), np.uint8)
    frame[:] = value
    return frame


def left_half(truth: BenchTruth) -> npt.NDArray[np.uint8]:
    frame = blank(truth, 255)
    frame[:, frame.shape[1] // 2 :] = 0
    return frame


def spread(image: Image) -> Image:
    """The veil by its formula, in full resolution."""
    sigma = 0.15 * image.shape[1]
    return np.asarray(gaussian_filter(image, (sigma, sigma, 0.0), mode="constant"))


def test_glare_in_the_camera_is_a_gaussian_veil_over_the_picture(truth: BenchTruth) -> None:
    clear = picture(truth, left_half(truth))
    dull = picture(dataclasses.replace(truth, camera=dataclasses.replace(truth.camera, glare=0.04)), left_half(truth))
    np.testing.assert_allclose(dull, 0.96 * clear + 0.04 * spread(clear), atol=2e-4 * clear.max())
    assert dull[clear.max(axis=2) < 1e-6].max() > 5e-3 * clear.max()


def test_glare_in_a_projector_lights_what_should_be_dark(truth: BenchTruth) -> None:
    frame = left_half(truth)
    dull = picture(with_light(truth, glare=0.05), frame)
    sent = emitted(truth.projectors[0].light, frame).astype(np.float64)
    values = np.rint(255 * spread(sent) / emitted(truth.projectors[0].light, blank(truth, 255))).astype(np.uint8)
    veil = picture(truth, values)
    np.testing.assert_allclose(dull, 0.95 * picture(truth, frame) + 0.05 * veil, atol=5e-4 * dull.max())


def test_a_white_segment_adds_white_and_leaves_colours_alone(truth: BenchTruth) -> None:
    more = with_light(truth, white_segment=0.4)
    white, red = blank(truth, 255), blank(truth, 255, 0, 0)
    np.testing.assert_allclose(picture(more, white), 1.4 * picture(truth, white), rtol=1e-4)
    np.testing.assert_allclose(picture(more, red), picture(truth, red), rtol=1e-4)
    mixed = blank(truth, 255, 102, 51)
    added = picture(more, mixed) - picture(truth, mixed)
    np.testing.assert_allclose(added, 0.4 * 51 / 255 * picture(truth, white), rtol=1e-3, atol=1e-6)


def test_a_shadow_keeps_the_light_of_its_part_of_the_picture_and_ends_softly(truth: BenchTruth) -> None:
    frame = blank(truth, 255)
    plain, dark = (emitted(one.projectors[0].light, frame)[0, :, 1] for one in (truth, with_light(truth, shadow=0.25)))
    width = len(dark)
    assert dark[: round(0.22 * width)].max() == 0
    assert (dark[round(0.28 * width) :] == plain[round(0.28 * width) :]).all()
    assert (np.diff(dark) >= 0).all()


@pytest.mark.parametrize("channel", [0, 1, 2])
def test_panels_shift_and_magnify_the_picture_of_their_colour(truth: BenchTruth, channel: int) -> None:
    """A ramp of light shows by its height where it lies."""
    shift, grown = [(0.0, 0.0)] * 3, [0.0] * 3
    shift[channel], grown[channel] = (0.3, -0.2), 0.005
    panels = Panels((shift[0], shift[1], shift[2]), (grown[0], grown[1], grown[2]))
    width = truth.projectors[0].lens.size_px[0]
    ramp = blank(truth, 0)
    ramp[..., channel] = 3 * np.arange(width)
    aligned, moved = picture(truth, ramp), picture(with_projector(truth, panels=panels), ramp)
    full = blank(truth, 0)
    full[..., channel] = 255
    inside = np.zeros(aligned.shape[:2], bool)
    inside[12:-12, 16:-16] = True
    step = 3 / 255 * picture(truth, full)[inside]
    column = aligned[inside] / step
    centre = truth.projectors[0].lens.centre_px[0]
    np.testing.assert_allclose(moved[inside] / step, (column - 0.3 - centre) / 1.005 + centre, atol=0.02)
    other = blank(truth, 0)
    other[..., (channel + 1) % 3] = ramp[..., channel]
    np.testing.assert_allclose(picture(with_projector(truth, panels=panels), other), picture(truth, other), atol=1e-5)


def test_rough_gloss_is_a_wide_highlight_on_top_of_the_paint(truth: BenchTruth) -> None:
    """Blinn and Phong's, normalised: g (n + 8) / 8 cos^n of the angle between normal and half vector."""
    gloss, exponent = 0.06, 12.0
    glossy = dataclasses.replace(truth, object=dataclasses.replace(truth.object, gloss=gloss, gloss_exponent=exponent))
    white = blank(truth, 255)
    plain, more = picture(truth, white), picture(glossy, white)
    lit = plain.min(axis=2) > 0.5 * plain.max()
    y, x = np.nonzero(lit)
    camera = truth.camera
    # The screen is flat and faces both devices, which stand on one line.
    flat = (np.stack((x, y), axis=1) - camera.lens.centre_px) / camera.lens.focal_px
    radius = 1.2 * np.linalg.norm(flat, axis=1)
    towards = [np.stack((-radius, np.full(len(radius), away)), axis=1) for away in (1.0, 1.2)]
    half = sum(part / np.linalg.norm(part, axis=1, keepdims=True) for part in towards)
    cosine = half[:, 1] / np.linalg.norm(half, axis=1)
    wanted = gloss * (exponent + 8.0) / 8.0 * cosine**exponent
    # Of paint with albedo 0.5, as the lens' small distortion moves pixels by less than one.
    np.testing.assert_allclose(0.5 * (more[lit] / plain[lit] - 1.0).mean(axis=1), wanted, rtol=0.02)


class Lamp:
    def light_level(self) -> float:
        return 1.0


@pytest.fixture
def shots(truth: BenchTruth, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Image]:
    """Raw pictures (N, rows, columns), less black, of a stage that shows white, at the exposures given."""
    monkeypatch.setattr("plugins.emulated.optics.world.object_of", lambda stage, kept: screen())
    monkeypatch.setattr(World, "_frame", lambda self, index, shown: blank(truth, 255))

    def take(of: BenchTruth, *exposures_s: float, lamp: Any = None) -> Image:
        write_truth(tmp_path, of)
        taken = []
        with World(tmp_path, dataclasses.replace(of, time_scale=0.0), [lamp or Lamp()]) as world:
            for exposure_s in exposures_s:
                raw = world.expose(ShotSettings(exposure_s, 100, 8.0, raw=True, jpeg=False)).raw
                with rawpy.imread(io.BytesIO(raw or b"")) as developed:
                    taken.append(developed.raw_image_visible.astype(np.float64) - DARK)
        return np.array(taken)

    return take


@pytest.mark.parametrize("exposure_s", [0.02, 0.3])
def test_a_lamp_flickers_and_less_so_in_long_exposures(
    truth: BenchTruth, shots: Callable[..., Image], exposure_s: float
) -> None:
    lamp = dataclasses.replace(truth.projectors[0].lamp, flicker=0.03)
    dim = with_light(truth, brightness=truth.projectors[0].light.brightness * 0.02 / exposure_s)
    taken = shots(with_projector(dim, lamp=lamp), *[exposure_s] * 150).mean(axis=(1, 2))
    assert taken.std() / taken.mean() == pytest.approx(0.03 / np.sqrt(1 + exposure_s / 0.1), rel=0.2)


def test_a_lamp_drifts_after_it_is_warm(truth: BenchTruth, shots: Callable[..., Image]) -> None:
    now_s = [0.0]
    lamp = EmulatedLamp(LampTiming(2.0, 1.0, drift=0.1, drift_s=60.0), clock=lambda: now_s[0])
    lamp.strike()
    found = []
    for now in (3.0, 63.0, 600.0):
        now_s[0] = now
        found.append(shots(truth, *[0.03] * 4, lamp=lamp).mean())
    wanted = [1.0 + 0.1 * np.exp(-now / 60.0) for now in (3.0, 63.0, 600.0)]
    np.testing.assert_allclose(np.array(found) / found[-1], np.array(wanted) / wanted[-1], rtol=2e-3)


def test_pixels_differ_in_response(truth: BenchTruth, shots: Callable[..., Image]) -> None:
    even, uneven = (
        shots(with_sensor(truth, read_noise_e=0.0, response_spread=spread), *[0.03] * 60).mean(axis=0)
        for spread in (0.0, 0.05)
    )
    lit = even > 0.5 * np.percentile(even, 99)
    ratio = uneven[lit] / even[lit]
    assert ratio.mean() == pytest.approx(1.0, abs=3e-3)
    assert ratio.std() == pytest.approx(0.05, rel=0.1)


def test_hot_pixels_glow_in_proportion_to_the_time(truth: BenchTruth, shots: Callable[..., Image]) -> None:
    dark = with_sensor(with_light(truth, brightness=0.0), hot_pixels=0.05)
    short, long = shots(dark, 0.5, 1.0)
    step = truth.camera.sensor.electrons_per_step
    hot = long > 100.0
    assert hot.mean() == pytest.approx(0.05 * np.exp(-100.0 * step / 2e4), rel=0.2)
    free = hot & (long < 3000.0)
    assert short[free].sum() / long[free].sum() == pytest.approx(0.5, rel=0.02)


def test_exposures_differ_from_what_the_camera_says_the_same_way_each_time(
    truth: BenchTruth, shots: Callable[..., Image]
) -> None:
    wrong = with_sensor(truth, shutter_spread=0.05)
    said = np.linspace(0.02, 0.04, 60)
    error = shots(wrong, *said).mean(axis=(1, 2)) / shots(truth, *said).mean(axis=(1, 2))
    assert np.log(error).std() == pytest.approx(0.05, rel=0.3)
    again = shots(wrong, *said).mean(axis=(1, 2))
    np.testing.assert_allclose(again / shots(truth, *said).mean(axis=(1, 2)), error, rtol=5e-3)


def test_a_picture_lasts_as_long_as_the_camera_needs(truth: BenchTruth, shots: Callable[..., Image]) -> None:
    slow = dataclasses.replace(truth, camera=dataclasses.replace(truth.camera, picture_s=0.4))
    began_s = time.monotonic()
    shots(slow, 0.02, 0.02, 0.02)
    assert time.monotonic() - began_s >= 1.2
