"""Spread under a surface is found from Gray code, against the point response of diffusion, K0 (SciPy)."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from scipy.signal import fftconvolve
from scipy.special import k0

from controller.core.arrays import Float64, FloatImage
from controller.optics.calibrate.metapixels.blur import blur_of, measure_contrasts
from controller.optics.calibrate.photometry.separation import indirect_share, sinusoid_contrast
from controller.optics.calibrate.photometry.surface_spread import (
    contrast_left,
    measure_spread,
    spreading,
    typical_spread,
)
from controller.optics.calibrate.values import Correspondence, SurfaceSpread
from controller.optics.capture.pattern_frames import frame
from controller.optics.capture.patterns import Code, PatternKind, PatternPlan, plan_patterns

SHAPE = (260, 330)
SIZE = (144, 108)
PLAN = plan_patterns(SIZE)
SCALE = 0.4
"""Projector pixels per camera pixel."""


def diffused(light: FloatImage, distance_px: float) -> FloatImage:
    """Light (rows, columns) that has diffused; mirrored at the borders."""
    kernel = point_response(distance_px)
    wide = np.pad(light, len(kernel) // 2, mode="symmetric")
    return np.asarray(fftconvolve(wide, kernel, mode="valid"), np.float32)


@functools.cache
def point_response(distance_px: float) -> Float64:
    """K0(r / d) / (2 pi d^2), each sample a mean over its pixel."""
    reach, fine = int(np.ceil(9 * distance_px)), 8
    at = (np.arange((2 * reach + 1) * fine) + 0.5) / fine - reach - 0.5
    point = k0(np.maximum(np.hypot(at[:, None], at[None, :]), 1e-3) / distance_px)
    kernel = point.reshape(2 * reach + 1, fine, 2 * reach + 1, fine).mean(axis=(1, 3))
    return np.asarray(kernel / kernel.sum())


@dataclass(frozen=True)
class Marble:
    """A painted surface that one projector lights; ``distance_px`` in the projector's pixels."""

    share: float = 0.0
    distance_px: float = 2.0
    blur_px: float = 0.6
    indirect: float = 0.0
    """Of white, a mean of the whole picture that falls off to one side."""
    glare: float = 0.0
    """Spread by a lens over a fifth of the picture."""
    crease: float = 0.0
    """Of the light of near surfaces, beside a crease at the left edge; it falls off to the right."""
    noise: float = 1e-3

    @property
    def position_px(self) -> FloatImage:
        y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]].astype(np.float32)
        return np.stack([5 + SCALE * x, 2 + SCALE * y], axis=2).astype(np.float32)

    @property
    def paint(self) -> FloatImage:
        y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
        return np.asarray(0.3 + 0.6 * ((x // 19 + y // 23) % 2), np.float32)

    @property
    def correspondence(self) -> Correspondence:
        return Correspondence(self.position_px, np.full(SHAPE, 0.9, np.float32), np.ones(SHAPE, np.bool_))

    def captures(self, plan: PatternPlan = PLAN) -> dict[str, FloatImage]:
        rng = np.random.default_rng(5)
        pictures = {pattern.name: self._seen(np.asarray(frame(pattern, SIZE), np.float32)) for pattern in plan
                    if pattern.kind in (PatternKind.FLAT, PatternKind.GRAY, PatternKind.SINUSOID)}  # fmt: skip
        return {
            name: (np.float32(0.01) + seen + self.noise * rng.standard_normal(seen.shape)).astype(np.float32)
            for name, seen in pictures.items()
        }

    def _seen(self, shown: FloatImage) -> FloatImage:
        light = shown if shown.ndim == 2 else shown.mean(axis=2)
        # Six times as fine, so that neither blur nor pixels are sampled coarsely.
        fine = cv2.GaussianBlur(np.kron(light, np.ones((6, 6), np.float32)), (0, 0), 6 * self.blur_px)
        at = (self.position_px + np.float32(0.5)) * 6 - np.float32(0.5)
        there = cv2.remap(fine, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        falling = np.asarray(there, np.float32)
        if self.share:
            beside = diffused(falling, self.distance_px / SCALE)
            falling = np.asarray(falling + self.share * (beside - falling), np.float32)
        if self.crease:
            near = np.exp(-np.arange(SHAPE[1]) / (SHAPE[1] / 3)).astype(np.float32)
            falling = np.asarray(falling + self.crease * near * diffused(falling, self.distance_px / SCALE), np.float32)
        slope = np.linspace(1.0, 0.4, SHAPE[1], dtype=np.float32)
        veil = cv2.GaussianBlur(falling, (0, 0), SHAPE[1] / 5)
        other = self.indirect * slope * falling.mean()
        seen = self.paint * (falling + other) + self.glare * veil
        return np.repeat(seen[..., None], 3, axis=2).astype(np.float32)

    def spread(self) -> SurfaceSpread | None:
        made = self.captures()
        white = made["white"] - made["black"]
        return measure_spread(made, PLAN, self.position_px, white, blur_px=self.shown_blur(made))

    def shown_blur(self, made: dict[str, FloatImage]) -> float:
        covariance, valid = blur_of(measure_contrasts(made, PLAN, self.correspondence))
        return float(np.sqrt(np.nanmedian(covariance[valid][:, [0, 2]])))


@pytest.mark.parametrize(
    ("share", "distance_px", "blur_px"),
    [(0.3, 0.9, 0.5), (0.3, 2.0, 0.5), (0.15, 3.0, 0.7), (0.5, 4.0, 0.5), (0.3, 6.0, 0.9)],
)
@pytest.mark.parametrize("indirect", [0.0, 0.15])
def test_share_and_distance_are_found(share: float, distance_px: float, blur_px: float, indirect: float) -> None:
    found = Marble(share, distance_px, blur_px, indirect=indirect, glare=0.2 * indirect).spread()
    assert found is not None
    assert found.share == pytest.approx(share, rel=0.2)
    assert found.projector_px == pytest.approx(distance_px, rel=0.15)
    assert found.camera_px == pytest.approx(found.projector_px / SCALE, rel=0.01)
    assert f"{100 * found.share:.0f} %" in str(spreading(found))


@pytest.mark.parametrize("blur_px", [0.3, 0.7, 1.5, 2.5])
@pytest.mark.parametrize(("indirect", "glare"), [(0.0, 0.0), (0.3, 0.0), (0.0, 0.03)])
def test_nothing_spreads_under_other_surfaces(blur_px: float, indirect: float, glare: float) -> None:
    assert Marble(blur_px=blur_px, indirect=indirect, glare=glare).spread() is None


@pytest.mark.parametrize("crease", [0.1, 0.4])
@pytest.mark.parametrize("distance_px", [1.0, 2.0])
def test_light_between_near_surfaces_is_no_spread(crease: float, distance_px: float) -> None:
    assert Marble(crease=crease, distance_px=distance_px).spread() is None


def test_a_code_in_colours_says_nothing() -> None:
    plan = plan_patterns(SIZE, code=Code.COLOURS)
    marble = Marble(0.3)
    made = marble.captures(plan)
    white = made["white"] - made["black"]
    assert measure_spread(made, plan, marble.position_px, white, blur_px=0.6) is None


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_blur_and_indirect_light_are_those_of_a_surface_without_it(share: float) -> None:
    marble = Marble(share, 3.0, 0.6, indirect=0.1, noise=1e-5)
    made = marble.captures()
    known = SurfaceSpread(share, 3.0 / SCALE, 3.0)
    covariance, valid = blur_of(measure_contrasts(made, PLAN, marble.correspondence), known)
    middle = np.s_[20:-20, 20:-20]
    # The pixel's own square is a twelfth of a pixel squared.
    np.testing.assert_allclose(covariance[middle][valid[middle]][:, 0], 0.6**2 + 1 / 12, atol=0.05)
    white = made["white"] - made["black"]
    found = indirect_share(sinusoid_contrast(made, PLAN, white), white, marble.position_px, spread=known)
    wanted = indirect_share(
        sinusoid_contrast(plain := Marble(0.0, 3.0, 0.6, indirect=0.1, noise=1e-5).captures(), PLAN, white),
        plain["white"] - plain["black"], marble.position_px,
    )  # fmt: skip
    np.testing.assert_allclose(found[40:-40, 40:-40], wanted[40:-40, 40:-40], atol=0.02)


def test_the_contrast_that_is_left_is_that_of_a_spread_sinusoid() -> None:
    x = np.arange(400) * 0.1
    wave = np.broadcast_to(0.5 + 0.5 * np.cos(2 * np.pi * x / 8), (240, 400)).astype(np.float32)
    seen = 0.7 * wave + 0.3 * diffused(wave, 25.0)
    kept = (seen[120, 80:320] * np.exp(2j * np.pi * x[80:320] / 8)).mean() / 0.25
    assert abs(kept) == pytest.approx(contrast_left(SurfaceSpread(0.3, 25.0, 2.5), 1 / 8), abs=0.01)
    assert contrast_left(None, 1 / 8) == 1.0


def test_a_surface_is_believed_when_most_projectors_show_it() -> None:
    one, other = SurfaceSpread(0.2, 5.0, 2.0), SurfaceSpread(0.3, 7.0, 3.0)
    assert typical_spread([one, None]) is None
    assert typical_spread([one, None, other]) == SurfaceSpread(0.25, 6.0, 2.5)
    assert typical_spread([]) is None
    assert typical_spread([one, other]) == SurfaceSpread(0.25, 6.0, 2.5)
