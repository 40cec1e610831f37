from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from controller.core.arrays import Float64, FloatImage
from controller.core.errors import CalibrationError
from controller.optics.calibrate.photometry.colour_tiles import KnownIndirect
from controller.optics.calibrate.photometry.radiometry import measure_radiometry
from controller.optics.calibrate.photometry.separation import (
    indirect_figures,
    indirect_share,
    shown_contrast,
    sinusoid_contrast,
)
from controller.optics.calibrate.values import Radiometry
from controller.optics.capture.pattern_frames import device_frame, tile_levels
from controller.optics.capture.patterns import PatternKind, plan_patterns
from tests.controller.optics.calibrate.simulator import Scene, Stage

SHAPE = (150, 200)
PLAN = plan_patterns((140, 108))


@dataclass(frozen=True)
class Room:
    """A painted surface that one projector lights, some of whose light comes by way of others."""

    noise: float = 0.0
    blur_px: float = 0.6
    flicker: float = 0.0
    most: float = 0.4
    gamma_error: float = 1.0
    wall_blur_px: float | None = None
    """Of the right half, where that is out of focus."""

    @property
    def position_px(self) -> FloatImage:
        y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
        return np.stack([4 + 0.63 * x + 0.02 * y, 5 + 0.61 * y - 0.02 * x], axis=2).astype(np.float32)

    @property
    def white(self) -> FloatImage:
        y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
        paint = 0.2 + 0.7 * ((x // 17 + y // 13) % 2)
        return np.stack([paint, 0.8 * paint, 0.5 + 0.3 * paint], axis=2).astype(np.float32)

    @property
    def share(self) -> FloatImage:
        y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]] / np.array(SHAPE)[:, None, None]
        one = self.most * (0.1 + 0.9 * np.exp(-((x - 0.3) ** 2 + (y - 0.6) ** 2) / 0.08))
        return np.stack([one, 0.8 * one, 0.9 * one], axis=2).astype(np.float32)

    def captures(self) -> dict[str, FloatImage]:
        rng = np.random.default_rng(4)
        black = np.full((*SHAPE, 3), 0.01, np.float32)
        found = {"black": black}
        for pattern in PLAN.of_kind(PatternKind.SINUSOID):
            along = self.position_px @ np.array(pattern.frequency)
            blur_px = np.full(SHAPE, self.blur_px)
            blur_px[:, SHAPE[1] // 2 :] = self.blur_px if self.wall_blur_px is None else self.wall_blur_px
            kept = np.exp(-2 * (np.pi * np.hypot(*pattern.frequency) * blur_px) ** 2)
            light = (0.5 + 0.5 * kept * np.cos(2 * np.pi * along - pattern.phase_rad))[..., None] ** self.gamma_error
            mean = np.mean((0.5 + 0.5 * np.cos(np.linspace(0, 2 * np.pi, 999))) ** self.gamma_error)
            lamp = 1 + self.flicker * rng.standard_normal()
            seen = lamp * self.white * ((1 - self.share) * light + self.share * mean)
            found[pattern.name] = (black + seen + self.noise * rng.standard_normal(seen.shape)).astype(np.float32)
        return found

    def found(self, *, white: FloatImage | None = None, linearity: Float64 | None = None) -> FloatImage:
        white = self.white if white is None else white
        return indirect_share(
            sinusoid_contrast(self.captures(), PLAN, white), white, self.position_px, linearity=linearity
        )


@pytest.mark.parametrize("blur_px", [0.2, 0.7, 1.2])
def test_share_is_found_whatever_the_blur(blur_px: float) -> None:
    room = Room(blur_px=blur_px)
    found = room.found()
    np.testing.assert_allclose(found[5:-5, 5:-5], room.share[5:-5, 5:-5], atol=0.004)
    np.testing.assert_allclose(found, room.share, atol=0.01)


@pytest.mark.parametrize("blur_px", [1.8, 2.2, 2.5])
@pytest.mark.parametrize("white_noise", [0.0, 0.004])
def test_far_out_of_focus_blur_does_not_count_as_indirect_light(blur_px: float, white_noise: float) -> None:
    """Of the fine sinusoids less is left there than a pixel's noise, and white's own noise is not theirs."""
    room = Room(noise=0.004, wall_blur_px=blur_px)
    noise = white_noise * np.random.default_rng(9).standard_normal(room.white.shape)
    error = room.found(white=(room.white + noise).astype(np.float32)) - room.share
    wall = error[8:-8, SHAPE[1] // 2 + 12 : -8]
    assert abs(float(wall.mean())) < 0.01
    assert float(np.sqrt((wall**2).mean())) < 0.02


def test_noise_is_averaged_over_neighbours_of_any_paint() -> None:
    room = Room(noise=0.005)
    error = room.found() - room.share
    assert abs(float(error.mean())) < 0.002
    assert float(error.std()) < 0.006


def test_a_lamp_that_flickers_does_not_count_as_indirect_light() -> None:
    room = Room(flicker=0.01)
    np.testing.assert_allclose(room.found()[5:-5, 5:-5], room.share[5:-5, 5:-5], atol=0.006)


def test_a_dark_room_has_none() -> None:
    room = Room(most=0.0, noise=0.003)
    median, p95 = indirect_figures(room.found(), room.white)
    assert median < 0.003
    assert p95 < 0.008


def test_figures_are_of_pixels_that_the_projector_lights() -> None:
    share = np.full((10, 10, 3), 0.1, np.float32)
    white = np.ones((10, 10, 3), np.float32)
    share[:3] = 1.0
    np.testing.assert_allclose(indirect_figures(share, white), 0.1, rtol=1e-5)


def test_figures_are_the_median_and_what_95_percent_of_the_pixels_do_not_exceed() -> None:
    share = np.repeat(np.linspace(0, 0.5, 1001, dtype=np.float32)[None, :, None], 3, axis=2)
    np.testing.assert_allclose(indirect_figures(share, np.ones_like(share)), (0.25, 0.475), atol=1e-4)


def test_what_was_not_measured_is_like_its_surroundings() -> None:
    room = Room(most=0.3)
    white = room.white.copy()
    white[40:60, 50:70] = np.nan
    found = room.found(white=white)
    np.testing.assert_allclose(found[40:60, 50:70], room.share[40:60, 50:70], atol=0.06)


def test_sinusoids_of_a_wrong_response_are_known_by_their_contrast() -> None:
    room = Room(gamma_error=1.1)
    x = np.arange(256) / 255
    true, used = np.stack([x**2.2] * 3), np.stack([x**2.0] * 3)
    contrast = shown_contrast(Radiometry(true, np.eye(3)), used)
    better, worse = (float(np.abs((room.found(linearity=one) - room.share).mean())) for one in (contrast, None))
    assert better < 0.003
    assert worse > 0.01


def test_a_missing_photograph_is_told() -> None:
    captures = Room().captures()
    del captures["phase-y-1"]
    with pytest.raises(CalibrationError) as caught:
        sinusoid_contrast(captures, PLAN, Room().white)
    assert caught.value.code == "capture-missing"


def test_response_is_that_of_direct_light() -> None:
    """Much light that comes back, and more in one half of the picture than in the other."""
    scene = Scene(camera_px=(320, 248), projector_px=(140, 108), scale=2.4)
    stage = Stage(scene)
    plan = plan_patterns((140, 108))
    patterns = [pattern for pattern in plan if not pattern.needs_response]
    captures = {p.name: stage.photograph(device_frame(p, (140, 108))) for p in patterns}
    black, white = captures["black"], captures["white"] - captures["black"]
    share = np.full(white.shape, 0.1, np.float32)
    share[:, 160:] = 0.25
    truth = Radiometry(scene.response(), np.array(scene.mixing))
    for pattern in patterns[2:]:
        if pattern.kind is PatternKind.COLOUR_TILES:
            back = KnownIndirect(share * white, truth).of(tile_levels(pattern, (140, 108)))
            captures[pattern.name] = ((1 - share) * (captures[pattern.name] - black) + back + black).astype(np.float32)
    errors = []
    for known in (None, KnownIndirect(share * white, truth)):
        found, _ = measure_radiometry(captures, plan, indirect=known)
        errors.append(float(np.abs(found.response - scene.response()).max()))
    assert errors[1] < 0.006
    assert errors[0] > 2 * errors[1]
