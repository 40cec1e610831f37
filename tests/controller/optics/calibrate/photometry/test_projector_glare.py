"""A veil of a projector's lens is distinguished from other light in dark parts: judged by veils of other shapes."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
import pytest

from controller.core.arrays import Float64, FloatImage, Mask
from controller.optics.calibrate.photometry.glare import spread_by_lens
from controller.optics.calibrate.photometry.projector_glare import DarkPart, Glare, lens_veils, projector_glare
from tests.controller.optics.calibrate.photometry.spreading import blurred, by_angle

SHAPE = (320, 420)
SIZE = (150, 200)
"""Of the projector's picture; it lies on the whole wall."""
Veil = Callable[[Float64], Float64]


def even(picture: Float64) -> Float64:
    return np.full_like(picture, picture.mean())


@cache
def stripes() -> list[tuple[Float64, Float64, Mask, FloatImage]]:
    """Pictures; where their light is wide around, where it is dark, and what a lens spreads of it, on the wall."""
    found = []
    for axis, bits in ((1, 3), (0, 3)):
        for bit in range(bits):
            lit = (np.arange(SIZE[axis]) * 2 ** (bit + 1) // SIZE[axis]) % 2 == 1
            picture = np.broadcast_to(lit if axis else lit[:, None], SIZE).astype(np.float64)
            dark = on_wall(np.asarray(cv2.dilate(picture, np.ones((13, 13))), np.float64)) < 0.01
            spread = on_wall(spread_by_lens(picture.astype(np.float32)).astype(np.float64))
            found.append((picture, on_wall(blurred(picture, 35.0)), dark, spread.astype(np.float32)))
    return found


def on_wall(picture: Float64) -> Float64:
    return np.asarray(cv2.resize(picture, SHAPE[::-1], interpolation=cv2.INTER_LINEAR), np.float64)


def stage(
    glare: float,
    veil: Veil = even,
    *,
    bounced: float = 0.1,
    lens: float = 0.02,
    seed: int = 0,
    shadows: int = 30,
    near: float = 0.0,
) -> tuple[list[FloatImage], list[DarkPart], FloatImage]:
    """A painted wall behind things that throw shadows on it; light of other surfaces comes from where stripes are.

    ``near``: how much more light the backs of things throw into their shadows in the left 60 % of the picture.
    """
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    paint = rng.choice((0.2, 0.5, 0.8), (20, 26, 3)).repeat(17, axis=0)[: SHAPE[0]].repeat(17, axis=1)[:, : SHAPE[1]]
    paint = cv2.GaussianBlur(paint, (0, 0), 0.7)
    falling = []
    for slope, number in ((0.3, shadows), (-0.3, 4), (0.1, 4)):
        lit = np.ones(SHAPE)
        for _ in range(number):
            row, column, radius = rng.uniform(20, 300), rng.uniform(20, 400), rng.uniform(10, 18)
            lit[np.hypot(y - row, x - column) < radius] = 0
        falling.append(cv2.GaussianBlur(lit, (0, 0), 1.2) * (1 + slope * (x / SHAPE[1] - 0.5)))
    around = paint * bounced * (1 + 0.5 * np.sin(x / 40) * np.cos(y / 30))[..., None]
    whites = [_noisy(paint * light[..., None] + around, rng) for light in falling]
    parts = []
    for picture, wide, dark, spread in stripes():
        stray = np.clip(veil(picture), 0, None)
        seen = paint * (falling[0] * on_wall((1 - glare) * picture + glare * stray))[..., None]
        seen = seen + around * wide[..., None]
        seen = seen + near * rng.uniform() * paint * ((1 - falling[0]) * (x < 0.6 * SHAPE[1]))[..., None]
        seen = seen + lens * blurred(seen, 60.0)
        parts.append(DarkPart(_noisy(seen, rng), dark & (falling[0] > 0.3), spread))
    return whites, parts, np.full(SHAPE, 1.2, np.float32)


def _noisy(light: Float64, rng: np.random.Generator) -> FloatImage:
    return (light + rng.standard_normal(light.shape) * np.sqrt(np.maximum(light, 0) / 36_000 + 1e-7)).astype(np.float32)


@pytest.mark.slow
@pytest.mark.parametrize(("veil", "least", "most"), [(even, 1.0, 3.0), (by_angle, 0.6, 1.4)], ids=["even", "by angle"])
@pytest.mark.parametrize("glare", [0.02, 0.04])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_veil_is_measured(veil: Veil, least: float, most: float, glare: float, seed: int) -> None:
    whites, parts, depth_m = stage(glare, veil, seed=seed)
    found = projector_glare(whites, 0, parts, depth_m)
    # dark parts get more of a veil that is as strong everywhere than of one that falls with the angle
    assert least * glare < found.share < most * glare


def test_a_veil_is_named() -> None:
    whites, parts, depth_m = stage(0.03, by_angle)
    found = projector_glare(whites, 0, parts, depth_m)
    said = lens_veils("left", found.sure)
    assert said is not None
    assert f"{100 * found.share:.1f} %" in said
    assert "projector left" in said


@pytest.mark.slow
@pytest.mark.parametrize("bounced", [0.0, 0.05, 0.2])
@pytest.mark.parametrize("lens", [0.0, 0.04])
@pytest.mark.parametrize("seed", [0, 1])
def test_light_of_other_surfaces_and_the_cameras_veil_are_none(bounced: float, lens: float, seed: int) -> None:
    whites, parts, depth_m = stage(0.0, bounced=bounced, lens=lens, seed=seed)
    assert lens_veils("left", projector_glare(whites, 0, parts, depth_m).sure) is None


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("near", [0.1, 0.3])
def test_things_that_light_their_own_shadows_neither_hide_a_veil_nor_are_one(near: float, seed: int) -> None:
    whites, parts, depth_m = stage(0.03, by_angle, near=near, seed=seed, shadows=50)
    found = projector_glare(whites, 0, parts, depth_m)
    assert 0.6 * 0.03 < found.share < 1.4 * 0.03
    assert lens_veils("left", found.sure) is not None
    whites, parts, depth_m = stage(0.0, near=near, seed=seed, shadows=50)
    assert lens_veils("left", projector_glare(whites, 0, parts, depth_m).sure) is None


def test_a_veil_is_named_where_few_shadows_tell_it() -> None:
    whites, parts, depth_m = stage(0.03, by_angle, shadows=6)
    found = projector_glare(whites, 0, parts, depth_m)
    assert found.blocks < 12
    assert lens_veils("left", found.sure) is not None


def test_nothing_is_said_where_nothing_tells() -> None:
    whites, parts, depth_m = stage(0.04)
    assert projector_glare(whites, 0, [], depth_m).sure == 0
    assert projector_glare(whites[:1], 0, parts, depth_m).sure == 0
    assert projector_glare(whites, 0, parts, np.full_like(depth_m, np.nan)).sure == 0
    whites, parts, depth_m = stage(0.04, shadows=0)
    assert projector_glare(whites, 0, parts, depth_m).sure == 0


@pytest.mark.parametrize(
    ("share", "error", "blocks", "groups", "sure"),
    [
        (0.02, 0.004, 40, 9, True), (0.02, 0.006, 40, 9, False), (0.02, 0.0, 5, 5, False), (0.02, 0.0, 40, 1, False),
        (-0.02, 0.001, 40, 9, False),
    ],
)  # fmt: skip
def test_only_what_is_beyond_doubt_is_believed(
    share: float, error: float, blocks: int, groups: int, sure: bool
) -> None:
    assert Glare(share, error, blocks, groups).sure == (share if sure else 0)
