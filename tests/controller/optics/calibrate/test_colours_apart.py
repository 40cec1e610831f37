"""A projector whose colours lie apart, from photographs to frames; the simulator moves whole pictures of one colour."""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import numpy as np
import pytest

from controller.core.arrays import Float64, FloatImage
from controller.optics.calibrate.correspondence.colour_alignment import (
    ColourPlaces,
    ColourShifts,
    colour_shifts,
    colours_apart,
)
from controller.optics.calibrate.correspondence.decode import decode
from controller.optics.calibrate.correspondence.phase_shift import FRINGE_PX
from controller.optics.calibrate.metapixels.from_phase import fit_pixels
from controller.optics.calibrate.photometry.radiometry import measure_radiometry
from controller.optics.calibrate.values import Calibration, Correspondence, ProjectorCalibration
from controller.optics.solve.bounded.equations import SolveSettings
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.transport import LightTransport, build_transport
from tests.controller.optics.calibrate.simulator import Scene, Stage, photographed, positions

ALIGNED = Scene()
APART = Scene(apart_px=((0.3, 0.0), (0.0, 0.0), (0.0, 0.3)))
FURTHER = Scene(apart_px=((-0.5, 0.2), (0.1, 0.1), (0.3, -0.4)), seed=2)


class Found(NamedTuple):
    shifts: ColourShifts
    correspondence: Correspondence
    calibration: Calibration
    transport: LightTransport


@functools.cache
def found(scene: Scene, *, corrected: bool = True) -> Found:
    """What the calibration makes of a scene's photographs."""
    captures, plan = photographed(scene), Stage(scene).plan()
    white = np.maximum(captures["white"] - captures["black"], 0).astype(np.float32)
    radiometry = measure_radiometry(captures, plan)[0]
    shifts = colour_shifts(colours_apart(captures, plan, white, radiometry.mixing))
    apart_px = shifts.sure_px if corrected else None
    colours = None if apart_px is None else ColourPlaces.of(apart_px, white, radiometry.mixing)
    correspondence = decode(captures, plan, colours=colours)
    fitted = fit_pixels(captures, plan, correspondence, colours)
    part = ProjectorCalibration("one", fitted.metapixels, radiometry, white, fitted.phase_map)
    calibration = Calibration((part,), captures["black"], correspondence.valid, np.eye(3), mosaic=fitted.mosaic)
    return Found(shifts, correspondence, calibration, build_transport(calibration))


def places_off(scene: Scene, one: Found) -> Float64:
    """Errors against where green lies, projector px."""
    true = positions(scene) - np.array(scene.apart_px[1])
    return np.asarray((one.correspondence.projector_px - true)[one.correspondence.valid], np.float64)


def prediction(scene: Scene, one: Found, frame: FloatImage) -> float:
    """Relative error of T p."""
    seen = 0.998 * Stage(scene).light(frame)
    use = one.transport.object_mask
    return float(np.sqrt(np.mean((one.transport.forward([frame]) - seen)[use] ** 2) / np.mean(seen[use] ** 2)))


def random_frame(scene: Scene) -> FloatImage:
    columns, rows = scene.projector_px
    return np.random.default_rng(5).random((rows, columns, 3), np.float32)


@pytest.mark.parametrize("scene", [APART, FURTHER], ids=["apart", "further"])
def test_what_is_measured_is_where_each_colour_lies(scene: Scene) -> None:
    one = found(scene)
    wanted = np.array(scene.apart_px) - scene.apart_px[1]
    assert one.shifts.sure_px is not None
    np.testing.assert_allclose(one.shifts.sure_px, wanted, atol=0.012)
    off = places_off(scene, one)
    assert np.sqrt(np.mean(off**2)) < 0.02
    # and what is left does not follow the paint, as it does without
    before = places_off(scene, found(scene, corrected=False))
    assert np.std(off, axis=0).max() < 0.8 * np.std(before, axis=0).max()


@pytest.mark.parametrize("scene", [APART, FURTHER], ids=["apart", "further"])
@pytest.mark.parametrize(("grey", "limit"), [(True, 1.3), (False, 3.5)], ids=["grey", "colours"])
def test_noise_of_single_pixels_is_predicted_nearly_as_with_aligned_colours(
    scene: Scene, grey: bool, limit: float
) -> None:
    """In grey, what the camera's channels see of other colours is blurred; in colours, that sixth is misplaced."""
    frame = random_frame(scene)
    if grey:
        frame = np.repeat(frame[..., :1], 3, axis=2)
    now, before = (prediction(scene, found(scene, corrected=on), frame) for on in (True, False))
    assert now < limit * prediction(ALIGNED, found(ALIGNED), frame)
    assert before > 3 * now


def test_the_blur_is_that_of_one_colour() -> None:
    spreads = []
    for scene, corrected in ((ALIGNED, True), (APART, True), (APART, False)):
        phase_map = found(scene, corrected=corrected).calibration.projectors[0].phase_map
        assert phase_map is not None
        spreads.append(np.nanmedian(phase_map.spread_px2, axis=(0, 1)))
    aligned, apart, uncorrected = spreads
    np.testing.assert_allclose(apart, aligned, atol=0.003)
    assert np.all(uncorrected[[0, 2]] > aligned[[0, 2]] + 0.01)


def test_frames_show_a_fine_pattern_as_an_aligned_projector_does() -> None:
    """Grey stripes as fine as the projector can: with colours apart, uncorrected frames show coloured edges."""
    errors = {}
    for name, scene, corrected in (
        ("aligned", ALIGNED, True), ("corrected", APART, True), ("uncorrected", APART, False),
    ):  # fmt: skip
        one = found(scene, corrected=corrected)
        part = one.calibration.projectors[0]
        target = part.white * (0.5 + 0.25 * np.cos(2 * np.pi / 6 * positions(ALIGNED)[..., :1])).astype(np.float32)
        target[~one.transport.object_mask] = 0
        (frame,) = solve_bounded(one.transport, target, np.zeros_like(target), SolveSettings(smoothness=0.0)).frames
        off = 0.998 * Stage(scene).light(frame) - target
        inner = one.transport.object_mask & (part.white.min(axis=2) > 0)
        inner[:20], inner[-20:], inner[:, :20], inner[:, -20:] = False, False, False, False
        errors[name] = float(np.sqrt(np.mean(off[inner] ** 2) / np.mean(target[inner] ** 2)))
    assert errors["corrected"] < 1.3 * errors["aligned"] + 0.002
    assert errors["uncorrected"] > 2 * errors["corrected"]


@pytest.mark.parametrize("seed", range(1, 6))
def test_aligned_colours_are_left_alone(seed: int) -> None:
    assert found(dataclasses.replace(ALIGNED, seed=seed)).shifts.sure_px is None


@pytest.mark.parametrize("paint", [(1.0, 0.0, 0.0), (0.2, 0.5, 0.3), (0.0, 0.05, 0.95)])
def test_grey_sinusoids_are_taken_back_to_green(paint: tuple[float, float, float]) -> None:
    shifts = np.array([(0.4, -0.3), (0.0, 0.0), (-0.2, 0.5)])
    white = np.full((2, 3, 3), paint, np.float32)
    colours = ColourPlaces.of(shifts, white, np.eye(3))
    at = 17.3
    for axis in range(2):
        x = np.arange(50) / 50 * FRINGE_PX
        light = sum(share * np.cos(2 * np.pi * (at - shift - x) / FRINGE_PX)
                    for share, shift in zip(paint, shifts[:, axis], strict=True))  # fmt: skip
        wave = np.mean(light * np.exp(2j * np.pi * x / FRINGE_PX)) * 2
        seen = float(np.angle(wave)) * FRINGE_PX / (2 * np.pi)
        off = (seen + float(colours.to_green_px()[0, 0, axis]) - at + FRINGE_PX / 2) % FRINGE_PX - FRINGE_PX / 2
        assert off == pytest.approx(0, abs=1e-5)
        frequency = (1 / FRINGE_PX, 0.0) if axis == 0 else (0.0, 1 / FRINGE_PX)
        in_phase = float(np.real(wave * np.exp(-2j * np.pi * at / FRINGE_PX)))
        assert float(colours.contrast(frequency)[1, 2]) == pytest.approx(in_phase, abs=1e-5)


def test_where_white_is_not_known_the_shares_are_those_of_the_picture() -> None:
    white = np.full((300, 4, 3), (0.2, 0.4, 0.4), np.float32)
    white[0, 0] = np.nan
    white[299, 1] = 0
    white[150, 2] = (0.0, 0.0, 1e-3)
    share = shares_of(white)
    wanted = np.full_like(share, (0.2, 0.4, 0.4))
    wanted[150, 2] = (0, 0, 1)
    np.testing.assert_allclose(share, wanted, rtol=1e-3)
    np.testing.assert_allclose(shares_of(np.zeros((4, 4, 3), np.float32)), 1 / 3)


def shares_of(white: FloatImage) -> FloatImage:
    colours = ColourPlaces.of(np.zeros((3, 2)), white, np.eye(3))
    return np.concatenate([share for _, share in colours.shares()])
