from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from controller.core.arrays import FloatImage, Mask
from controller.optics.calibrate.values import Calibration, Metapixels, ProjectorCalibration, Radiometry
from controller.optics.calibrate.verify.error_attribution import attribute_error, attribution_picture, ranked
from controller.optics.calibrate.verify.error_causes import COLOURS, ErrorCause
from controller.optics.capture.pattern_frames import frame
from controller.optics.capture.patterns import Pattern, PatternKind
from controller.optics.capture.profile import CameraNoise

ROWS, COLUMNS = 90, 120
SHOWN: FloatImage = np.asarray(
    cv2.GaussianBlur(frame(Pattern("r", PatternKind.RANDOM, seed=2), (COLUMNS, ROWS)), (0, 0), 1.0), np.float32
)
PATCH = (slice(30, 60), slice(40, 80))


@dataclass(frozen=True, slots=True)
class OneToOne:
    """A light transport whose camera pixels are the projector's."""

    white: FloatImage
    lit: Mask

    def forward_part(self, n: int, p: FloatImage) -> FloatImage:
        return np.asarray(self.white * p * self.lit[n][:, :, None], np.float32)

    def gaussian_mean(self, image: FloatImage, n: int) -> FloatImage:
        return image


def stage(white: float = 100.0) -> tuple[OneToOne, Calibration]:
    image = np.full((ROWS, COLUMNS, 3), white, np.float32)
    metapixels = Metapixels(
        np.zeros((ROWS, COLUMNS, 2), np.float32),
        np.ones((ROWS, COLUMNS, 3), np.float32),
        np.ones((ROWS, COLUMNS), bool),
    )
    part = ProjectorCalibration("one", metapixels, Radiometry(np.zeros((3, 256)), np.eye(3)), image)
    everywhere = np.ones((ROWS, COLUMNS), np.bool_)
    calibration = Calibration((part,), np.zeros_like(image), everywhere, np.eye(3))
    return OneToOne(image, everywhere[None].copy()), calibration


def variance(seen: FloatImage, exposure_s: float = 0.005) -> FloatImage:
    return CameraNoise().per_second(exposure_s).variance(seen, interpolated=False)


@pytest.mark.parametrize(
    "reason", [ErrorCause.SATURATED, ErrorCause.UNDECODED, ErrorCause.MOVED, ErrorCause.DIMMED, ErrorCause.DARK]
)
def test_each_fault_is_blamed_on_what_caused_it(reason: ErrorCause) -> None:
    light, calibration = stage()
    random, exposure_s = np.random.default_rng(1), 0.005
    seen = light.forward_part(0, SHOWN)
    if reason is ErrorCause.SATURATED:
        seen[PATCH] = np.nan
    elif reason is ErrorCause.UNDECODED:
        light.lit[0][PATCH] = False
    elif reason is ErrorCause.MOVED:
        seen[PATCH] = light.forward_part(0, np.roll(SHOWN, 1, axis=1).astype(np.float32))[PATCH]
    elif reason is ErrorCause.DIMMED:
        seen[PATCH] *= 0.8
    else:
        exposure_s = 1e-5
        sigma = np.sqrt(seen / 30_000 / exposure_s + (6 / 30_000 / exposure_s) ** 2)
        seen += (sigma * random.standard_normal(seen.shape)).astype(np.float32)
    found = attribute_error(light, calibration, 0, SHOWN, seen, variance=variance(seen, exposure_s))
    inner = found.labels[38:52, 50:70]
    assert np.mean(inner == reason) > 0.8
    assert ranked(found)[0]["sentence"].endswith(".")
    if reason is ErrorCause.DARK:
        assert ranked(found)[0]["reason"] == "noise"
    else:
        assert not found.labels[:15].any()
        assert "in the middle" in ranked(found)[0]["sentence"]


def test_a_good_prediction_blames_nothing_and_the_picture_stays_grey() -> None:
    light, calibration = stage()
    seen = light.forward_part(0, SHOWN)
    found = attribute_error(light, calibration, 0, SHOWN, seen, variance=variance(seen))
    assert not found.labels.any()
    assert ranked(found) == []
    picture = attribution_picture(found, calibration, "one")
    assert np.ptp(picture[:ROWS].astype(int), axis=2).max() == 0


def test_indirect_light_is_the_reason_where_there_is_much_of_it() -> None:
    light, calibration = stage()
    seen = light.forward_part(0, SHOWN)
    back = np.zeros_like(seen)
    back[PATCH] = 0.5 * seen[PATCH].mean()
    ripple = np.sin(np.arange(ROWS) / 2)[:, None, None] * np.cos(np.arange(COLUMNS) / 2)[None, :, None]
    found = attribute_error(
        light, calibration, 0, SHOWN, (seen + back * (1 + 0.5 * ripple)).astype(np.float32), variance=variance(seen),
        indirect=back,
    )  # fmt: skip
    inside = found.labels[PATCH]
    assert np.mean(inside[inside > 0] == ErrorCause.INDIRECT) > 0.5
    assert "indirect light" in [row["reason"] for row in ranked(found)]
    exact = attribute_error(light, calibration, 0, SHOWN, seen + back, variance=variance(seen), indirect=back)
    assert not exact.labels.any()


def of_metal(light: OneToOne) -> FloatImage:
    """A mirror in the middle shows another part of the object."""
    seen = light.forward_part(0, SHOWN)
    seen[PATCH] = seen[:, ::-1][:30, :40]
    return seen


def of_a_dent(light: OneToOne) -> FloatImage:
    """15 % less light at levels between two measured ones."""
    dent = 0.15 * np.exp(-(((SHOWN - 0.6) / 0.12) ** 2))
    return light.forward_part(0, np.asarray(SHOWN * (1 - dent), np.float32))


def of_a_knock(light: OneToOne) -> FloatImage:
    """Knocked after its x patterns: places are known across as before, and down as now."""
    return light.forward_part(0, np.asarray(np.roll(SHOWN, 1, axis=1), np.float32))


@pytest.mark.parametrize(
    ("seen_of", "reason", "advice"),
    [
        (of_metal, "unexplained", "make shiny metal matt"),
        (of_a_dent, "brightness", "picture mode"),
        (of_a_knock, "moved", "velatura drift"),
    ],
)
def test_what_no_part_of_the_model_describes_has_a_reason_and_advice(
    seen_of: Callable[[OneToOne], FloatImage], reason: str, advice: str
) -> None:
    light, calibration = stage()
    seen = seen_of(light)
    found = ranked(attribute_error(light, calibration, 0, SHOWN, seen, variance=variance(seen)))
    assert found[0]["reason"] == reason
    assert found[0]["error_share"] > 0.5
    assert advice in found[0]["sentence"]


def test_colours_differ_for_every_reason() -> None:
    assert len(set(COLOURS.values())) == len(COLOURS) == len(ErrorCause) - 1
