from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from controller.core.arrays import FloatImage
from controller.optics.capture.profile import CameraNoise, CameraProfile
from controller.stage.artefacts.photographs import TakenPhotograph
from controller.stage.steps.appearance.photographing import brightest, speeds, timed
from tests.controller.optics.capture.test_raw import BLACK, WHITE, write_dng

AVAILABLE_S = [round(2.0 ** (number / 3), 4) for number in range(-30, 10)]
LIGHT = np.geomspace(0.05, 30.0, 320)[None, :] * (1 + 0.4 * np.sin(np.arange(240) / 9))[:, None]


def profile_of(*known: tuple[float, float]) -> CameraProfile:
    return CameraProfile(exposures=np.array(known) if known else np.empty((0, 2)))


def photographed(path: Path, told_s: float, opened_s: float, profile: CameraProfile, seed: int) -> TakenPhotograph:
    light = np.random.default_rng(seed).poisson(LIGHT * opened_s * 30_000) / 30_000
    write_dng(path, np.clip(np.rint(BLACK + light * (WHITE - BLACK)), 0, WHITE).astype(np.uint16))
    return TakenPhotograph(path.stem, path, profile.true_exposure(told_s), profile=profile)


def test_a_camera_that_is_right_is_asked_for_the_exposures_that_are_wanted() -> None:
    wanted = [0.0787, 0.5]
    assert speeds(9.0, AVAILABLE_S, 1.0, None) == pytest.approx(wanted)
    assert speeds(9.0, AVAILABLE_S, 1.0, profile_of()) == pytest.approx(wanted)


def test_the_longer_exposure_is_one_that_is_known() -> None:
    profile = profile_of((0.0625, 0.065), (0.315, 0.31), (0.63, 0.64))
    assert speeds(9.0, AVAILABLE_S, 1.0, profile) == pytest.approx([0.0787, 0.63])
    assert speeds(9.0, AVAILABLE_S, 0.5, profile) == pytest.approx([0.0787, 0.315])
    assert speeds(200.0, AVAILABLE_S, 1.0, profile) == pytest.approx([0.0039, 0.0248]), "none of them is near"


def shades(*levels: float) -> FloatImage:
    """As many pixels of each of these levels of light."""
    return np.repeat(np.asarray(levels, np.float32), 300)[:, None] * np.ones(3, np.float32)


def speeds_for(light: FloatImage, longest_s: float, profile: CameraProfile | None = None) -> list[float]:
    return speeds(brightest(light), AVAILABLE_S, longest_s, profile, light=light)


def test_what_is_all_about_as_bright_is_exposed_about_alike() -> None:
    assert speeds_for(shades(4.0), 1.0) == pytest.approx([0.1575, 0.1984])
    assert speeds(4.0, [0.01, 0.16, 0.5, 1.0], 1.0, None, light=shades(4.0)) == [0.16, 0.16], "0.5 s would clip"


def test_dark_light_beside_bright_is_exposed_for_longer() -> None:
    short_s, long_s = speeds_for(shades(4.0, 0.4, 0.4, 0.4), 4.0)
    assert short_s == pytest.approx(0.1575)
    assert 1.5 < long_s < 0.9 / 0.4, "as long as the dark light does not clip"
    assert speeds_for(shades(4.0, 0.4, 0.4, 0.4), 1.0)[1] == pytest.approx(1.0)


@pytest.mark.parametrize("level", [0.0, 1e-9, 1e5])
def test_light_that_no_exposure_suits_is_photographed_all_the_same(level: float) -> None:
    nearest_s = max(value for value in AVAILABLE_S if value <= 1) if level < 1 else min(AVAILABLE_S)
    assert speeds_for(shades(level), 1.0) == [nearest_s] * 2
    assert speeds(9.0, AVAILABLE_S, 1.0, None, light=shades()) == pytest.approx([0.0787, 0.5]), "nothing is lit"


@pytest.mark.parametrize("seed", range(20))
def test_the_exposures_have_about_the_least_noise(seed: int) -> None:
    """By photographs with noise, and not by a formula of it."""
    rng = np.random.default_rng(seed)
    light = np.asarray(10 ** rng.uniform(-2, 0.5, (4000, 1)) * rng.uniform(0.3, 1, (4000, 3)), np.float32)
    white, noise = brightest(light), CameraNoise()
    short_s, long_s = speeds(white, AVAILABLE_S, 4.0, None, light=light, shorter=2)

    def error(value: float) -> float:
        total, weights = np.zeros(light.shape), np.zeros(light.shape)
        for exposure_s in (short_s, value, short_s):
            variance = noise.shot * light * exposure_s + noise.read**2
            seen = light * exposure_s + rng.normal(size=light.shape) * np.sqrt(variance)
            weight = np.where(light * exposure_s < 0.9, exposure_s**2 / variance, 1e-12)
            total, weights = total + weight * seen / exposure_s, weights + weight
        return float((np.abs(total / weights - light) / (light + 0.1 * white)).mean())

    others = [value for value in AVAILABLE_S if short_s <= value <= min(9 / white, 4.0)]
    assert error(long_s) < 1.05 * min(error(value) for value in others)


def test_the_longer_exposure_of_known_light_is_one_that_is_known() -> None:
    profile = profile_of((0.0625, 0.065), (0.315, 0.31), (0.63, 0.64))
    assert speeds_for(shades(9.0, 0.9), 1.0, profile) == pytest.approx([0.0787, 0.63])
    assert speeds_for(shades(9.0, 2.0), 1.0, profile) == pytest.approx([0.0787, 0.315])


def test_an_unknown_exposure_is_measured_by_one_that_is_known(tmp_path: Path) -> None:
    """6 % wrong, as 1/30 s that are 1/32 s; both photographs of this exposure get the same time."""
    profile = profile_of((0.16, 0.155), (0.5, 0.51))
    first, long, last = (
        photographed(tmp_path / f"{name}.dng", told_s, opened_s, profile, seed)
        for seed, (name, told_s, opened_s) in enumerate(
            (("first", 1 / 30, 1 / 32), ("long", 0.16, 0.155), ("last", 1 / 30, 1 / 32))
        )
    )
    found = timed([first, long, last])
    assert [one.path for one in found] == [first.path, long.path, last.path]
    assert found[1].exposure_s == 0.155
    assert found[0].exposure_s == found[2].exposure_s == pytest.approx(1 / 32, rel=0.003)


def test_what_cannot_be_measured_stays_as_the_camera_says(tmp_path: Path) -> None:
    profile = profile_of((0.16, 0.155), (0.5, 0.51))
    dark = photographed(tmp_path / "dark.dng", 1e-5, 1e-5, profile, 1)
    short = photographed(tmp_path / "short.dng", 1 / 30, 1 / 32, profile, 2)
    known = photographed(tmp_path / "known.dng", 0.16, 0.155, profile, 3)
    assert timed([short, dark]) == [short, dark], "none is known"
    assert timed([dark, known])[0].exposure_s == pytest.approx(1e-5), "nothing is well exposed in both"
    assert timed([known]) == [known]
    sound = TakenPhotograph("short", short.path, short.exposure_s, profile=profile_of())
    assert timed([sound, known]) == [sound, known]
