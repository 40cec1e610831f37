"""Flicker of a lamp, from pictures of sinusoids whose strength is known."""

from __future__ import annotations

import numpy as np
import pytest

from controller.core.arrays import Float64, FloatImage
from controller.optics.calibrate.photometry.separation import lamp_flicker, sinusoid_contrast, unsteady
from controller.optics.capture.patterns import plan_patterns

SIZE = (96, 72)


def pictures(flicker: float, *, few: bool = False, bent: float = 0.0) -> tuple[dict[str, FloatImage], Float64]:
    """A camera that sees each of a projector's pixels twice; ``bent``: error of the response that all steps have."""
    rng, plan = np.random.default_rng(5), plan_patterns(SIZE, few=few)
    y, x = np.mgrid[0 : 2 * SIZE[1], 0 : 2 * SIZE[0]] / 2.0
    white = np.broadcast_to(0.3 + 0.5 * rng.random((1, 2 * SIZE[0], 3)), (*x.shape, 3))
    made = {"black": np.zeros_like(white), "white": white}
    strengths = []
    for prefix in ("phase-x", "phase-y", "blur-x", "blur-y"):
        for step in plan.sinusoids(prefix):
            strengths.append(1 + flicker * rng.standard_normal())
            light = 0.5 + 0.4 * np.cos(2 * np.pi * (step.frequency[0] * x + step.frequency[1] * y) - step.phase_rad)
            made[step.name] = white * ((1 + bent) * light * strengths[-1])[..., None]
    noisy = {name: one + 2e-3 * rng.standard_normal(one.shape) for name, one in made.items()}
    return {name: one.astype(np.float32) for name, one in noisy.items()}, np.reshape(strengths, (4, -1))


@pytest.mark.parametrize("flicker", [0.005, 0.01, 0.03])
@pytest.mark.parametrize("bent", [0.0, -0.02])
def test_flicker_is_measured(flicker: float, bent: float) -> None:
    made, strengths = pictures(flicker, bent=bent)
    found = lamp_flicker(sinusoid_contrast(made, plan_patterns(SIZE), made["white"]).strengths)
    true = float(np.sqrt(np.mean(np.var(strengths, axis=1, ddof=1))))
    assert found == pytest.approx(true, rel=0.1)
    said = unsteady("left", found)
    assert said is not None
    assert f"{100 * found:.1f} %" in said


@pytest.mark.parametrize("bent", [0.0, 0.03])
def test_a_steady_lamp_is_not_named_whatever_the_response(bent: float) -> None:
    made, _ = pictures(0.0, bent=bent)
    assert unsteady("left", lamp_flicker(sinusoid_contrast(made, plan_patterns(SIZE), made["white"]).strengths)) is None


def test_computed_steps_tell_nothing() -> None:
    made, _ = pictures(0.03, few=True)
    assert lamp_flicker(sinusoid_contrast(made, plan_patterns(SIZE, few=True), made["white"]).strengths) == 0


@pytest.mark.parametrize("flicker", [0.0, 0.005])
def test_what_darkens_a_part_of_the_picture_is_no_lamp(flicker: float) -> None:
    """Somebody's shadow in one photograph. A lamp that flickers is named yet."""
    made, _ = pictures(flicker)
    plan = plan_patterns(SIZE)
    shown = made[plan.sinusoids("phase-x")[0].name]
    if not flicker:
        shown[:30] *= np.float32(0.9)
    seen = sinusoid_contrast(made, plan, made["white"])
    found = lamp_flicker(seen.strengths)
    assert found > 0.002, "the photographs differ in light"
    assert (unsteady("left", found, seen.sigma) is None) is (flicker == 0)
