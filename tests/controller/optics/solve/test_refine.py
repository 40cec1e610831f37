"""Corrections by photographs: they find the model's errors, nothing else, and never make a result worse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from controller.core.arrays import FloatImage, Mask
from controller.core.blur import masked_blur
from controller.optics.calibrate.values import Calibration
from controller.optics.solve.appearance import StageLight
from controller.optics.solve.bounded.engine import ALONE
from controller.optics.solve.bounded.equations import APPEARANCE_TOLERANCE, SolveSettings
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.result.refinement import (
    EDGE_PX,
    LEAST_GAIN,
    MARGIN_PX,
    ModelError,
    RefinedStage,
    ResultPhotograph,
    corrected_target,
    gain,
    model_error,
    photographed_error,
    refusal,
    solve_again,
    trusted_pixels,
    without_flicker,
    without_noise,
)
from controller.optics.transport import LightTransport, build_transport
from tests.controller.optics.solve.conftest import plane_calibration

CAMERA = (90, 120)
EXPOSURE = 0.35
Spoil = Callable[[FloatImage], FloatImage]


def as_it_is(light: FloatImage) -> FloatImage:
    return light


@dataclass
class Result:
    """Frames on a stage whose true light, ``light`` of the true transport, is not what its calibration says."""

    calibration: Calibration
    true: LightTransport
    light: Spoil
    noise: float = 0.001
    seed: int = 0

    def __post_init__(self) -> None:
        self.transport = build_transport(self.calibration)
        self.stage = RefinedStage(
            self.calibration.black, np.sum([part.white for part in self.calibration.projectors], axis=0)
        )
        rows, columns = CAMERA
        y, x = np.mgrid[0:rows, 0:columns].astype(np.float32)
        wave = 0.45 + 0.3 * np.sin(x / 9) * np.sin(y / 11)
        self.target = (EXPOSURE * wave[..., None] * np.array([1.0, 0.9, 0.8])).astype(np.float32)
        self.mask: Mask = np.zeros(CAMERA, np.bool_)
        self.mask[6:-6, 6:-6] = True
        first = SolveSettings(tolerance=APPEARANCE_TOLERANCE)
        self.frames = solve_bounded(self.transport, self.target, self.calibration.black, first).frames

    def seen(self, frames: tuple[FloatImage, ...]) -> FloatImage:
        return np.asarray(self.light(self.true.forward(frames)) + self.calibration.black, np.float32)

    def photograph(self, frames: tuple[FloatImage, ...], spoil: Spoil = as_it_is) -> ResultPhotograph:
        self.seed += 1
        rng = np.random.default_rng(self.seed)
        light = spoil(self.seen(frames))
        first, last, merged = (light + rng.normal(0, self.noise, light.shape).astype(np.float32) for _ in range(3))
        return ResultPhotograph(merged, np.full_like(merged, self.noise), first, last)

    def flickering(self, frames: tuple[FloatImage, ...], by: float, dimmed: float = 1.0) -> ResultPhotograph:
        """Each lamp has another strength in each exposure, ``by`` (standard deviation) off; the first is ``dimmed``."""
        self.seed += 1
        rng = np.random.default_rng(self.seed)
        parts = [self.true.forward_part(n, frame) for n, frame in enumerate(frames)]
        images = []
        for _ in range(3):
            strengths = rng.normal(1, by, len(parts)) * np.array([dimmed, *[1.0] * (len(parts) - 1)])
            light = np.sum([np.float32(one) * part for one, part in zip(strengths, parts, strict=True)], axis=0)
            noise = rng.normal(0, self.noise, light.shape)
            images.append(np.asarray(light + self.calibration.black + noise, np.float32))
        return ResultPhotograph(images[2], np.full_like(images[2], self.noise), images[0], images[1])

    def steady(
        self, frames: tuple[FloatImage, ...], photograph: ResultPhotograph, known: float = 0.0
    ) -> ResultPhotograph:
        parts = [self.transport.forward_part(n, frame) for n, frame in enumerate(frames)]
        return without_flicker(photograph, self.predicted(frames), parts, self.stage, self.mask, [known] * len(parts))

    def predicted(self, frames: tuple[FloatImage, ...]) -> FloatImage:
        return np.asarray(self.transport.forward(frames) + self.calibration.black, np.float32)

    def corrected(self, frames: tuple[FloatImage, ...], photograph: ResultPhotograph) -> tuple[FloatImage, ...]:
        """As the steps do it: the new frames, if they are expected to be worth it."""
        predicted = self.predicted(frames)
        trusted = trusted_pixels(photograph, predicted, self.stage, self.mask)
        assert refusal(photograph, predicted, self.stage, self.mask, trusted) is None
        aimed = corrected_target(self.target, model_error(photograph, predicted, trusted), self.stage)
        new = solve_again(
            StageLight(self.transport, self.calibration.black),
            self.target,
            aimed,
            SolveSettings(start=frames, tolerance=APPEARANCE_TOLERANCE),
            ALONE,
            exposure=EXPOSURE,
        )
        expected = photograph.radiance + self.predicted(new) - predicted
        change = gain(self.error(photograph.radiance, trusted), self.error(expected, trusted))
        return new if change.worth_it else frames

    def error(self, radiance: FloatImage, mask: Mask | None = None) -> FloatImage:
        mask = self.mask if mask is None else mask
        return photographed_error(radiance, self.target, self.calibration.camera_to_xyz, EXPOSURE, mask).map

    def mean_error(self, frames: tuple[FloatImage, ...]) -> float:
        return float(np.nanmean(self.error(self.seen(frames))))


def result(seed: int = 1, light: Spoil = as_it_is, *, true: Calibration | None = None, noise: float = 0.001) -> Result:
    calibration = plane_calibration(seed, projector=(30, 40), camera=CAMERA, spill=0.03)
    return Result(calibration, build_transport(true or calibration), light, noise=noise)


def indirect(share: float) -> Spoil:
    return lambda light: light + np.float32(share) * light.mean(axis=(0, 1))


def with_errors(seed: int) -> Calibration:
    """The same stage with random errors of its calibration: places, widths, brightness and response."""
    rng = np.random.default_rng(seed)
    calibration = plane_calibration(seed, projector=(30, 40), camera=CAMERA, spill=0.03)
    parts = []
    for part in calibration.projectors:
        at = part.metapixels
        shift = rng.normal(0, 0.3, 2).astype(np.float32)
        moved = replace(
            at,
            centre_px=at.centre_px + shift,
            covariance_px2=at.covariance_px2 * np.float32(rng.uniform(0.8, 1.5)),
        )
        shade = cv2.GaussianBlur(rng.normal(0, 1, CAMERA).astype(np.float32), (0, 0), 12)
        shade = shade * float(rng.uniform(0, 0.08) / shade.std())
        parts.append(replace(part, metapixels=moved, white=part.white * (1 + shade[..., None])))
    return replace(calibration, projectors=tuple(parts))


@pytest.mark.parametrize("seed", range(12))
def test_a_correction_is_never_worse_whatever_is_wrong_with_the_model(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    found = result(
        seed, indirect(rng.uniform(0, 0.15)), true=with_errors(seed), noise=float(10 ** rng.uniform(-4, -1.7))
    )
    once = found.corrected(found.frames, found.photograph(found.frames))
    twice = found.corrected(once, found.photograph(once))
    before, after, last = map(found.mean_error, (found.frames, once, twice))
    assert after <= before + LEAST_GAIN
    assert last <= after + LEAST_GAIN


@pytest.mark.parametrize("by", [0.005, 0.01, 0.02])
@pytest.mark.parametrize("known", [False, True])
def test_lamps_that_flicker_are_not_corrected(by: float, known: bool) -> None:
    found = result(noise=1e-5)
    away: dict[str, list[float]] = {"as seen": [], "steady": []}
    most = 0.25 if known else 0.5
    for _ in range(12):
        photograph = found.flickering(found.frames, by)
        predicted = found.predicted(found.frames)
        for name, one in (("as seen", photograph), ("steady", found.steady(found.frames, photograph, by * known))):
            away[name].append(float(np.abs((one.radiance - predicted)[found.mask]).mean()))
    assert np.mean(away["steady"]) < most * np.mean(away["as seen"])
    assert all(steady <= seen + 2e-4 for steady, seen in zip(away["steady"], away["as seen"], strict=True))


def test_errors_of_single_lamps_that_cancel_out_change_no_brightness() -> None:
    """The model gives too much of its light to one lamp, and too little to the other."""
    for seed in range(1, 9):
        found = result(seed, noise=1e-5)
        parts = [found.true.forward_part(n, frame) for n, frame in enumerate(found.frames)]
        share = float(parts[0][found.mask].sum() / parts[1][found.mask].sum())
        photograph = found.flickering(found.frames, 0.005)
        wrong = np.float32(0.02) * parts[0] - np.float32(0.02 * share) * parts[1]
        light, first, last = (one + wrong for one in (photograph.radiance, photograph.first, photograph.last))
        seen = ResultPhotograph(light, photograph.sigma, first, last)
        steady = found.steady(found.frames, seen, 0.005)
        predicted = found.predicted(found.frames)
        change = float((steady.radiance - predicted)[found.mask].sum() / predicted[found.mask].sum())
        assert abs(change) < 0.001


def test_a_lamp_that_is_darker_is_corrected_although_lamps_flicker() -> None:
    found = result()
    photograph = found.flickering(found.frames, 0.005, dimmed=0.92)
    changed = [np.abs((one.radiance - found.predicted(found.frames))[found.mask]).mean()
               for one in (photograph, found.steady(found.frames, photograph))]  # fmt: skip
    assert changed[1] == pytest.approx(changed[0], rel=0.1)


def test_light_that_is_in_no_model_is_kept_beside_steady_lamps() -> None:
    found = result(light=indirect(0.1))
    photograph = found.photograph(found.frames)
    steady = found.steady(found.frames, photograph)
    np.testing.assert_allclose(steady.radiance[found.mask], photograph.radiance[found.mask], atol=1e-3)


@pytest.mark.parametrize("noise", [0.0003, 0.003, 0.02])
def test_where_the_model_is_right_noise_is_not_taken_for_an_error(noise: float) -> None:
    found = result(noise=noise)
    after = found.corrected(found.frames, found.photograph(found.frames))
    assert found.mean_error(after) <= found.mean_error(found.frames) + LEAST_GAIN


def test_even_indirect_light_goes_with_one_photograph() -> None:
    found = result(light=indirect(0.05))
    disturbed, undisturbed = found.mean_error(found.frames), result().mean_error(found.frames)
    after = found.mean_error(found.corrected(found.frames, found.photograph(found.frames)))
    assert disturbed > undisturbed + 0.5
    assert after < undisturbed + 0.1 * (disturbed - undisturbed)


def hand(light: FloatImage) -> FloatImage:
    """Skin in the light of the projectors, over a part of the object."""
    spoiled = light.copy()
    spoiled[36:54, 45:65] = 0.8 * EXPOSURE * np.array([0.5, 0.3, 0.22], np.float32)
    return spoiled


def shadow(light: FloatImage) -> FloatImage:
    """Of a hand before one of the projectors."""
    spoiled = light.copy()
    spoiled[36:54, 45:65] *= 0.6
    return spoiled


@pytest.mark.parametrize("spoil", [hand, shadow])
def test_a_hand_in_the_photograph_is_left_out_and_the_rest_is_corrected(spoil: Spoil) -> None:
    found = result(light=indirect(0.05))
    photograph = found.photograph(found.frames, spoil)
    predicted = found.predicted(found.frames)
    trusted = trusted_pixels(photograph, predicted, found.stage, found.mask)
    assert not trusted[36:54, 45:65].any()
    assert trusted[found.mask].mean() > 0.6
    aimed = corrected_target(found.target, model_error(photograph, predicted, trusted), found.stage)
    assert np.array_equal(aimed[38:52, 47:63], found.target[38:52, 47:63])
    after = found.corrected(found.frames, photograph)
    here = np.zeros(CAMERA, np.bool_)
    here[36:54, 45:65] = True
    before_error, after_error = (found.error(found.seen(frames)) for frames in (found.frames, after))
    assert np.nanmean(after_error) < 0.75 * np.nanmean(before_error)
    assert np.nanmean(after_error[here]) <= np.nanmean(before_error[here]) + LEAST_GAIN


def test_what_changes_while_the_photograph_is_taken_is_left_out() -> None:
    found = result()
    photograph = found.photograph(found.frames)
    last = photograph.last.copy()
    last[36:54, 45:65] *= 0.9
    trusted = trusted_pixels(replace(photograph, last=last), found.predicted(found.frames), found.stage, found.mask)
    assert not trusted[36:54, 45:65].any()
    far = found.mask.copy()
    far[36 - 2 * MARGIN_PX : 54 + 2 * MARGIN_PX, 45 - 2 * MARGIN_PX : 65 + 2 * MARGIN_PX] = False
    assert trusted[far].all()


@pytest.mark.parametrize(
    ("factor", "why"), [(0.0, "it is too dark"), (0.3, "it is too dark"), (3.0, "it is too bright"), (1.0, None)]
)
def test_photographs_that_show_something_else_are_refused(factor: float, why: str | None) -> None:
    found = result()
    photograph = found.photograph(found.frames, lambda light: np.asarray(light * factor, np.float32))
    predicted = found.predicted(found.frames)
    trusted = trusted_pixels(photograph, predicted, found.stage, found.mask)
    assert refusal(photograph, predicted, found.stage, found.mask, trusted) == why


def test_a_photograph_that_measured_nothing_is_refused() -> None:
    found = result()
    photograph = replace(found.photograph(found.frames), radiance=np.full((*CAMERA, 3), np.nan, np.float32))
    trusted = trusted_pixels(photograph, found.target, found.stage, found.mask)
    assert not trusted.any()
    assert refusal(photograph, found.target, found.stage, found.mask, trusted) == "it is too dark"


def test_a_photograph_that_is_clipped_in_half_of_the_picture_says_so() -> None:
    found = result()
    photograph = found.photograph(found.frames)
    radiance = photograph.radiance.copy()
    radiance[: CAMERA[0] // 2] = np.nan
    photograph = replace(photograph, radiance=radiance)
    predicted = found.predicted(found.frames)
    trusted = trusted_pixels(photograph, predicted, found.stage, found.mask)
    assert refusal(photograph, predicted, found.stage, found.mask, trusted) == "too much of it is overexposed"


@pytest.mark.parametrize("seed", range(4))
def test_two_photographs_of_the_same_error_have_less_noise_than_one(seed: int) -> None:
    found = result(seed, indirect(0.1), noise=0.01)
    predicted = found.predicted(found.frames)
    true = found.seen(found.frames) - predicted
    first, second = (model_error(found.photograph(found.frames), predicted, found.mask) for _ in range(2))
    both = first.then(second)

    def away(one: ModelError) -> float:
        return float(np.std((one.light - true)[found.mask]))

    assert away(both) == pytest.approx(away(second) / 2**0.5, rel=0.05)
    np.testing.assert_allclose(both.sigma[found.mask], second.sigma[found.mask] / 2**0.5, rtol=1e-5)


def test_where_a_correction_changed_the_error_the_later_photograph_counts() -> None:
    found = result(noise=0.002)
    predicted = found.predicted(found.frames)
    light = found.seen(found.frames)
    step = np.zeros_like(light)
    step[:, CAMERA[1] // 2 :] = 0.05
    rng = np.random.default_rng(5)
    photographs = [np.asarray(image + rng.normal(0, 0.002, light.shape), np.float32) for image in (light + step, light)]
    first, second = (
        model_error(ResultPhotograph(one, np.full_like(one, 0.002), one, one), predicted, found.mask)
        for one in photographs
    )
    both = first.then(second)
    away = np.abs(cv2.GaussianBlur(np.nan_to_num(both.light - (light - predicted)), (0, 0), 3))
    assert away[found.mask & (step[..., 0] > 0)].mean() < 0.05 * 0.05


def test_what_a_later_photograph_does_not_show_is_known_by_the_earlier_one() -> None:
    found = result(light=indirect(0.1))
    predicted = found.predicted(found.frames)
    left, right = found.mask.copy(), found.mask.copy()
    left[:, 50:], right[:, :45] = False, False
    first, second = (model_error(found.photograph(found.frames), predicted, part) for part in (left, right))
    both = first.then(second)
    assert np.array_equal(both.known, left | right)
    assert np.array_equal(both.light[left & ~right], first.light[left & ~right])
    assert np.array_equal(both.light[right & ~left], second.light[right & ~left])
    assert np.array_equal(both.sigma[left & ~right], first.sigma[left & ~right])


def test_nothing_is_corrected_beyond_the_border_of_what_is_trusted() -> None:
    found = result(light=indirect(0.1))
    trusted = np.zeros(CAMERA, np.bool_)
    trusted[20:70, 20:70] = True
    photograph = found.photograph(found.frames)
    seen = model_error(photograph, found.predicted(found.frames), trusted)
    aimed = corrected_target(found.target, seen, found.stage)
    change = np.abs(aimed - found.target).max(axis=2)
    outside = cv2.dilate(trusted.astype(np.uint8), np.ones((3, 3)), iterations=int(4 * EDGE_PX)) == 0
    assert change[trusted].min() > 0.002
    assert change[outside].max() == 0
    across = change[45, 60:85]
    assert np.abs(np.diff(across)).max() < 0.5 * across.max(), "it ends smoothly"


def test_the_filter_drops_noise_and_keeps_an_edge_better_than_one_gaussian() -> None:
    rng = np.random.default_rng(3)
    mask, sigma = np.ones(CAMERA, np.bool_), np.full((*CAMERA, 3), 0.01, np.float32)
    noise = rng.normal(0, 0.01, (*CAMERA, 3)).astype(np.float32)
    assert np.sqrt((without_noise(noise, sigma, mask) ** 2).mean()) < 0.001
    step = np.zeros((*CAMERA, 3), np.float32)
    step[:, 60:] = 0.1
    kept, blurred = without_noise(step + noise, sigma, mask), masked_blur(step + noise, mask, 2.0)
    assert np.abs(kept - step).mean() < np.abs(blurred - step).mean()
    assert (kept[:, 61] - kept[:, 58]).mean() > (blurred[:, 61] - blurred[:, 58]).mean()


def looked_at(found: Result, light: FloatImage) -> tuple[Mask, str | None]:
    """What of a photograph of this light is trusted, and why it is refused."""
    seen = found.photograph(found.frames, lambda _: light)
    predicted = found.predicted(found.frames)
    parts = [found.transport.forward_part(n, frame) for n, frame in enumerate(found.frames)]
    trusted = trusted_pixels(seen, predicted, found.stage, found.mask, parts)
    return trusted, refusal(seen, predicted, found.stage, found.mask, trusted)


@pytest.mark.parametrize("share", [0.2, 0.6, 0.9])
@pytest.mark.parametrize("projector", [0, 1])
def test_somebody_in_a_projector_s_light_is_not_believed_even_before_most_of_the_object(
    share: float, projector: int
) -> None:
    found = result()
    columns = round(share * CAMERA[1])
    light = found.seen(found.frames)
    light[:, :columns] -= 0.95 * found.transport.forward_part(projector, found.frames[projector])[:, :columns]
    trusted, why = looked_at(found, light)
    assert trusted[:, : columns - 4].mean() < 0.05
    assert (why is not None) is (share > 0.3)


@pytest.mark.parametrize("first", [12, 40])
@pytest.mark.parametrize("brightness", [0.45, 1.6])
def test_somebody_before_most_of_the_object_is_not_believed(brightness: float, first: int) -> None:
    found = result()
    light = found.seen(found.frames)
    light[:, first:] = brightness * float(np.median(light))
    _, why = looked_at(found, light)
    assert why is not None


@pytest.mark.parametrize("gains", [(0.75, 0.75), (0.6, 1.0), (1.1, 1.1)])
def test_lamps_that_are_darker_or_brighter_everywhere_are_believed(gains: tuple[float, float]) -> None:
    found = result()
    parts = [np.float32(gain) * found.transport.forward_part(n, frame)
             for n, (gain, frame) in enumerate(zip(gains, found.frames, strict=True))]  # fmt: skip
    trusted, why = looked_at(found, np.asarray(parts[0] + parts[1] + found.calibration.black, np.float32))
    assert why is None
    assert trusted[found.mask].mean() > 0.9
