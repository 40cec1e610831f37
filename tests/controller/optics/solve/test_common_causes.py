"""Causes that several photographs have in common are found with their amounts, and no others."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
import pytest

from controller.core.arrays import Float64, FloatImage
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.result.common_causes import CommonCauses, common_causes, equations
from controller.optics.solve.result.refinement import RefinedStage
from controller.optics.transport import LightTransport, build_transport
from tests.controller.optics.solve.conftest import plane_calibration

CAMERA = (90, 120)
STAGE = plane_calibration(projector=(30, 40), camera=CAMERA, spill=0.03)
TRUSTED = np.ones(CAMERA, np.bool_)
Frames = tuple[FloatImage, ...]
Seen = Callable[[Frames], FloatImage]


@cache
def transport() -> LightTransport:
    return build_transport(STAGE)


@cache
def appearances() -> tuple[Frames, ...]:
    """Three of different brightness, pattern and colour."""
    y, x = np.mgrid[0 : CAMERA[0], 0 : CAMERA[1]].astype(np.float32)
    waves = (0.15 + 0.1 * np.sin(x / 9), 0.25 + 0.2 * np.sin(x / 7) * np.sin(y / 11), 0.08 + 0.3 * (y > 45))
    tints = ((1.0, 0.9, 0.8), (0.6, 1.0, 0.9), (0.9, 0.7, 1.0))
    return tuple(
        solve_bounded(transport(), (wave[..., None] * np.array(tint)).astype(np.float32), STAGE.black).frames
        for wave, tint in zip(waves, tints, strict=True)
    )


def light(frames: Frames) -> FloatImage:
    return transport().forward(frames)


def found(seen: Seen, *, noise: float = 0.001) -> CommonCauses:
    rng = np.random.default_rng(4)
    white = np.sum([part.white for part in STAGE.projectors], axis=0)
    stage = RefinedStage(STAGE.black, white)
    said: list[Float64] = []
    for frames in appearances():
        error = seen(frames) - light(frames) + rng.normal(0, noise, (*CAMERA, 3))
        said.append(equations(transport(), frames, error.astype(np.float32), stage, TRUSTED))
    return common_causes(said, len(STAGE.projectors))


def dimmer(frames: Frames) -> FloatImage:
    return light((frames[0] * np.float32(0.9), frames[1]))


def bent(frames: Frames) -> FloatImage:
    return light((frames[0], frames[1] ** np.float32(1.05)))


def reflected(frames: Frames) -> FloatImage:
    whole = light(frames)
    white = np.sum([part.white for part in STAGE.projectors], axis=0)
    return np.asarray(whole + 0.05 * white / white.mean(axis=(0, 1)) * whole.mean(axis=(0, 1)), np.float32)


def room(frames: Frames) -> FloatImage:
    white = np.sum([part.white for part in STAGE.projectors], axis=0)
    return np.asarray(light(frames) + white * np.array([0.02, 0.015, 0.01]), np.float32)


@pytest.mark.parametrize(
    ("seen", "kind", "projector", "amounts"),
    [
        (dimmer, "brightness", 0, (-0.1, -0.1, -0.1)),
        (bent, "response", 1, (0.05,)),
        (reflected, "indirect", None, (0.05,)),
        (room, "ambient", None, (0.02, 0.015, 0.01)),
    ],
)
def test_a_cause_is_found_with_its_amount_and_alone(
    seen: Seen, kind: str, projector: int | None, amounts: tuple[float, ...]
) -> None:
    causes = found(seen)
    assert {(cause.kind, cause.projector) for cause in causes.causes} == {(kind, projector)}
    assert [cause.amount for cause in causes.causes] == pytest.approx(amounts, rel=0.1)
    assert causes.share > 0.9
    assert all(cause.sigma < 0.2 * abs(cause.amount) for cause in causes.causes)


def test_two_causes_are_told_apart() -> None:
    causes = found(lambda frames: dimmer(frames) + reflected(frames) - light(frames))
    assert {cause.kind for cause in causes.causes} == {"brightness", "indirect"}
    (share,) = (cause.amount for cause in causes.causes if cause.kind == "indirect")
    assert share == pytest.approx(0.05, rel=0.2)


@pytest.mark.parametrize("noise", [0.0005, 0.01])
def test_where_nothing_changed_no_cause_is_told(noise: float) -> None:
    assert found(light, noise=noise).causes == ()


def test_an_error_that_no_cause_explains_is_not_explained() -> None:
    rng = np.random.default_rng(1)
    pattern = rng.normal(0, 0.02, (9, 12, 3)).repeat(10, axis=0).repeat(10, axis=1)
    causes = found(lambda frames: np.asarray(light(frames) + pattern, np.float32))
    assert causes.share < 0.5


def test_room_light_from_one_side_is_room_light_and_no_projector_is_brighter() -> None:
    """The model's room light falls as the projectors' does; a window's falls otherwise."""
    white = np.sum([part.white for part in STAGE.projectors], axis=0)
    across = np.linspace(0.5, 1.5, CAMERA[1], dtype=np.float32)[None, :, None]
    causes = found(lambda frames: np.asarray(light(frames) + 0.04 * across * white, np.float32))
    assert {cause.kind for cause in causes.causes} == {"ambient"}
    assert all(0.02 < cause.amount < 0.06 for cause in causes.causes)


def test_light_that_comes_back_from_near_by_makes_no_projector_brighter() -> None:
    """The model's comes back evenly. Light of neighbours is nearly that; two causes fit a little better."""

    def near(frames: Frames) -> FloatImage:
        whole, white = light(frames), np.sum([part.white for part in STAGE.projectors], axis=0)
        around = cv2.GaussianBlur(whole, (0, 0), 12)
        return np.asarray(whole + 0.08 * white / white.mean(axis=(0, 1)) * around, np.float32)

    assert {cause.kind for cause in found(near).causes} == {"indirect"}


def test_a_room_that_is_darker_by_less_than_matters_is_not_named() -> None:
    white = np.sum([part.white for part in STAGE.projectors], axis=0)
    assert found(lambda frames: np.asarray(light(frames) - 0.003 * white, np.float32)).causes == ()


@pytest.mark.parametrize("one", [1.02, 0.97])
def test_what_one_photograph_says_and_another_denies_is_no_common_cause(one: float) -> None:
    """A lamp that flickers: darker in one photograph, brighter, or hardly darker, in the next."""
    gains = {id(frames): gain for frames, gain in zip(appearances(), (0.8, one, 0.8), strict=True)}
    causes = found(lambda frames: light((frames[0] * np.float32(gains[id(frames)]), frames[1])))
    assert causes.causes == ()


def test_a_cause_beside_a_larger_error_that_none_explains_is_not_named() -> None:
    rng = np.random.default_rng(1)
    pattern = rng.normal(0, 0.04, (9, 12, 3)).repeat(10, axis=0).repeat(10, axis=1)
    causes = found(lambda frames: np.asarray(dimmer(frames) + pattern, np.float32))
    assert causes.causes == ()
