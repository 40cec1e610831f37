"""What a drift check says of lamps, against light whose strength is given."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import pytest

from controller.core.arrays import FloatImage
from controller.optics.calibrate.values import Calibration
from controller.optics.calibrate.verify.drift import Drift, DriftCause, DriftPhotographs, find_drift, update_white
from controller.optics.calibrate.verify.drift_report import advice
from controller.optics.transport import LightTransport, build_transport
from lab.timings.tools.synthetic import synthetic_calibration

NAMES = ("left", "middle", "right")
Optics = Callable[[FloatImage], FloatImage]


@lru_cache
def stage() -> tuple[Calibration, LightTransport, list[FloatImage]]:
    calibration = synthetic_calibration(projector=(54, 72), camera=(140, 208))
    rng = np.random.default_rng(3)
    frames = [
        rng.uniform(0, 1, (*part.metapixels.valid.shape, 3)).astype(np.float32) for part in calibration.projectors
    ]
    return calibration, build_transport(calibration), frames


def checked(optics: Optics, gain: float = 1.0, noise: float = 0.0) -> Drift:
    """A drift check of a stage whose projectors show their pictures through ``optics``."""
    calibration, transport, frames = stage()
    rng = np.random.default_rng(5)

    def seen(light: FloatImage) -> FloatImage:
        photon = np.sqrt(np.maximum(light, 0) * float(light.max())) * rng.standard_normal(light.shape)
        return np.asarray(light + noise * photon, np.float32)

    patterns = {
        part.name: seen(np.float32(gain) * transport.forward_part(n, optics(frames[n])) + calibration.black)
        for n, part in enumerate(calibration.projectors)
    }
    white = calibration.black + np.float32(gain) * np.sum([part.white for part in calibration.projectors], axis=0)
    return find_drift(transport, calibration, frames, DriftPhotographs(calibration.black, seen(white), patterns))


def as_it_is(frame: FloatImage) -> FloatImage:
    return frame


def softer(frame: FloatImage) -> FloatImage:
    """Less contrast than the model's, as by a lens that is a little out of focus; the light is the same."""
    return np.asarray(cv2.GaussianBlur(frame, (0, 0), 0.45, borderType=cv2.BORDER_REFLECT), np.float32)


@pytest.mark.parametrize("optics", [as_it_is, softer])
@pytest.mark.parametrize("gain", [1.0, 0.98])
def test_a_lamp_is_as_strong_as_its_light_and_not_as_its_contrast(optics: Optics, gain: float) -> None:
    for one in checked(optics, gain, noise=0.02).projectors:
        assert one.gain == pytest.approx((gain,) * 3, abs=0.002)
        assert np.all(np.abs(np.array(one.gain) - gain) < 3 * np.array(one.gain_sigma) + 5e-4)


def test_a_lamp_that_flickers_has_not_dimmed_where_flicker_says_as_much() -> None:
    for one in checked(as_it_is, gain=0.98).projectors:
        assert (one.dimmed, one.flickering(0.01).dimmed, one.flickering(0.002).dimmed) == (True, False, True)


@pytest.mark.parametrize(("shift_px", "culprit"), [(0, DriftCause.NONE), (3, DriftCause.CAMERA)])
def test_a_projector_that_a_view_does_not_see_is_neither_dark_nor_has_it_moved(
    shift_px: int, culprit: DriftCause
) -> None:
    calibration, _, frames = stage()
    hidden = calibration.projectors[2]
    nowhere = replace(hidden.metapixels, valid=np.zeros_like(hidden.metapixels.valid))
    behind = replace(hidden, metapixels=nowhere, white=np.zeros_like(hidden.white), indirect=None)
    parts = (*calibration.projectors[:2], behind)
    calibration = replace(calibration, projectors=parts)
    light = build_transport(calibration)

    def seen(image: FloatImage) -> FloatImage:
        return np.asarray(np.roll(image + calibration.black, shift_px, axis=1), np.float32)

    patterns = {part.name: seen(light.forward_part(n, frames[n])) for n, part in enumerate(parts)}
    white = seen(np.sum([part.white for part in parts], axis=0, dtype=np.float32))
    photographs = DriftPhotographs(seen(np.zeros_like(white)), white, patterns)
    drift = find_drift(light, calibration, frames, photographs)
    assert (drift.culprit, drift.moved, drift.dimmed) == (culprit, (), ())
    assert advice(drift) == ("nothing" if culprit is DriftCause.NONE else "full")


def test_white_that_was_photographed_once_more_has_the_noise_of_all_photographs() -> None:
    """A lamp that has dimmed a little, and a shadow that has moved; 0.5 % of noise, and 0.1 % in the mean of many."""
    rng = np.random.default_rng(1)
    y, x = np.mgrid[0:120, 0:160].astype(np.float32)
    paint = (0.3 + 0.6 * ((x // 7 + y // 9) % 2))[..., None] * np.array([1.0, 0.8, 0.5])

    def lit(shadow_px: float) -> FloatImage:
        return np.asarray(paint * np.where(x < shadow_px, 0.05, 1)[..., None], np.float32)

    before, now = lit(40), np.float32(0.9) * lit(44) * (1 - 0.0005 * x)[..., None]
    sigma = np.sqrt(now).astype(np.float32) * np.float32(0.005)
    noisy = (before * (1 + 0.001 * rng.standard_normal(before.shape))).astype(np.float32)
    again = (now + sigma * rng.standard_normal(now.shape)).astype(np.float32)
    again[5, 90] = np.nan
    found = update_white(noisy, again, sigma)
    relative = found / now - 1
    assert np.nanstd(relative[:, 60:]) < 0.4 * np.nanstd((again / now - 1)[:, 60:])
    assert np.nanstd(relative[:, 30:60]) < 1.1 * np.nanstd((again / now - 1)[:, 30:60])
    assert np.isnan(found[5, 90]).all()
    assert np.isfinite(np.delete(found[5], 90, axis=0)).all()
