"""Colours of a projector that do not lie on each other, in pictures made by formula."""

from __future__ import annotations

import numpy as np
import pytest

from controller.core.arrays import Float64, FloatImage
from controller.optics.calibrate.correspondence.colour_alignment import (
    ColoursApart,
    ColourShifts,
    ColourSizes,
    colour_shifts,
    colour_sizes,
    colours_apart,
    fringed,
    misaligned,
)
from controller.optics.capture.pattern_frames import frame
from controller.optics.capture.patterns import plan_patterns

MIXING = np.array([[0.86, 0.10, 0.04], [0.07, 0.88, 0.05], [0.02, 0.09, 0.89]])
PLAN = plan_patterns((96, 72))


def places() -> FloatImage:
    """Where the camera's pixels look: it sees 2.3 pixels for each of the projector's."""
    y, x = np.mgrid[0:150, 0:200] / 2.3 + 3.0
    return np.stack([x, y], axis=2).astype(np.float32)


def pictures(shifts: Float64, noise: float = 0.01, larger: Float64 | None = None) -> dict[str, FloatImage]:
    """Seen at ``places``; colours are shifted by (3, 2) pixels, and ``larger`` (3,), seen from pixel (40, 30)."""
    x, y = np.moveaxis(places().astype(np.float64), 2, 0)
    sizes = np.zeros(3) if larger is None else larger
    rng = np.random.default_rng(3)
    paint = 0.2 + 0.6 * rng.random((1, 200, 3))
    whole = np.broadcast_to(paint, (150, 200, 3)).astype(np.float32)
    found = {"black": np.zeros_like(whole), "white": whole}
    for prefix in ("blur-x", "blur-y"):
        for step in PLAN.sinusoids(prefix):
            fx, fy = step.frequency
            # 0.6 of the contrast is left by blur
            own = [
                0.5 + 0.3 * np.cos(
                    2 * np.pi * (fx * (x - dx - by * (x - 40)) + fy * (y - dy - by * (y - 30))) - step.phase_rad
                )
                for (dx, dy), by in zip(shifts, sizes, strict=True)
            ]  # fmt: skip
            light = np.stack(own, axis=-1) @ MIXING.T * whole
            found[step.name] = (light * (1 + noise * rng.standard_normal(light.shape))).astype(np.float32)
    return found


def apart(made: dict[str, FloatImage]) -> ColoursApart:
    return colours_apart(made, PLAN, made["white"], MIXING)


def test_the_formula_is_that_of_the_patterns() -> None:
    (step,) = PLAN.sinusoids("blur-x")[1:2]
    shown = frame(step, (96, 72))
    x = np.arange(96)
    np.testing.assert_allclose(
        shown[0], 0.5 + 0.5 * np.cos(2 * np.pi * step.frequency[0] * x - step.phase_rad), atol=1e-5
    )


@pytest.mark.parametrize("shift", [((0.3, 0.0), (0.0, 0.0), (-0.1, 0.28)), ((-0.2, 0.15), (0.1, 0.1), (0.1, 0.1))])
def test_shifts_are_found_and_named(shift: tuple[tuple[float, float], ...]) -> None:
    wanted = np.asarray(shift)
    found = colour_shifts(apart(pictures(wanted)))
    np.testing.assert_allclose(found.px, wanted - wanted[1], atol=0.01)
    assert found.sure_px is not None
    np.testing.assert_array_equal(found.sure_px, found.px)
    assert np.all(found.error_px < 0.01)
    said = misaligned("left", found)
    assert said is not None
    assert f"red by {wanted[0, 0] - wanted[1, 0]:+.1f} pixels across" in said
    assert "convergence" in said


def test_colours_that_lie_on_each_other_are_not_named_however_noisy() -> None:
    for noise in (0.0, 0.05, 0.2):
        made = pictures(np.zeros((3, 2)), noise)
        assert misaligned("left", colour_shifts(apart(made))) is None


@pytest.mark.parametrize(
    ("px", "error_px", "sure"),
    [(0.3, 0.01, True), (0.03, 0.01, False), (0.03, 0.005, True), (0.015, 0.0, False), (-0.3, 0.1, False),
     (1.4, 0.01, True), (-1.6, 0.01, False), (np.nan, np.nan, False)],
)  # fmt: skip
def test_only_what_is_beyond_doubt_is_corrected(px: float, error_px: float, sure: bool) -> None:
    shifts = np.zeros((3, 2))
    shifts[2, 1] = px
    shifts[0, 0] = np.nan
    found = ColourShifts(shifts, np.where(shifts == 0, 0.0, error_px)).sure_px
    assert (found is not None) == sure
    if found is not None:
        assert found[2, 1] == px
        assert found[0, 0] == 0


def test_without_light_nothing_is_said() -> None:
    made = {name: np.zeros_like(image) for name, image in pictures(np.zeros((3, 2))).items()}
    assert misaligned("left", colour_shifts(apart(made))) is None
    assert fringed("left", colour_sizes(apart(made), places()), (96, 72)) is None


@pytest.mark.parametrize("larger", [(-4e-4, 0.0, 4e-4), (2e-3, 0.0, 0.0), (1e-3, 1e-3, 0.0)])
def test_colours_of_another_size_are_found_beside_shifts_and_named(larger: tuple[float, float, float]) -> None:
    made = pictures(np.array([[0.2, -0.1], [0.0, 0.0], [-0.1, 0.2]]), larger=np.array(larger))
    found = colour_sizes(apart(made), places())
    np.testing.assert_allclose(found.larger, np.array(larger) - larger[1], atol=6e-5)
    said = fringed("left", found, (1400, 1050))
    assert said is not None
    assert ("red's picture" in said) == (larger[0] != larger[1])
    assert ("blue's picture" in said) == (larger[2] != larger[1])
    assert "camera's" in said
    assert fringed("left", found, (int(0.19 / np.abs(found.larger).max()), 72)) is None, "less than a tenth of a pixel"


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.2])
def test_shifted_colours_of_one_size_are_not_named_as_fringes(noise: float) -> None:
    made = pictures(np.array([[0.2, -0.1], [0.0, 0.0], [-0.1, 0.2]]), noise)
    assert fringed("left", colour_sizes(apart(made), places()), (1400, 1050)) is None


def test_a_size_that_is_not_sure_is_not_named() -> None:
    assert fringed("left", ColourSizes(np.array([3e-4, 0, 0]), np.full(3, 1e-4)), (1400, 1050)) is None
    assert fringed("left", ColourSizes(np.full(3, np.nan), np.full(3, np.nan)), (96, 72)) is None


def test_places_on_one_line_stop_nothing() -> None:
    """An object may be a thin line in the picture; its colours then have a size along the line alone."""
    made, line = places(), apart(pictures(np.zeros((3, 2)), noise=0.01))
    made[..., 0] = 20.0
    assert np.isfinite(colour_sizes(line, made).larger).all()
