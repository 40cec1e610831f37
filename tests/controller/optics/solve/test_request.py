"""An appearance from picture to frames, and what is reported of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from controller.core.arrays import FloatImage, Mask
from controller.optics.solve import request
from controller.optics.solve.appearance import StageLight
from controller.optics.solve.bounded.engine import ALONE, IterationControl, Processor, SolveContext, corrected
from controller.optics.solve.bounded.equations import APPEARANCE_TOLERANCE, Solution, SolveInput, SolveSettings
from controller.optics.solve.request import SolveOptions, continued, solve_appearance
from controller.optics.solve.result.metrics import colour_difference
from controller.optics.solve.result.refinement import solve_again
from controller.optics.solve.targets.values import Target
from controller.optics.transport import LightTransport, build_transport
from controller.optics.transport.indirect.indirect_light import IndirectLight
from tests.controller.optics.solve.conftest import plane_calibration

STAGE = plane_calibration(projector=(40, 52), camera=(120, 160), spill=0.0)
OPTIONS = SolveOptions(share=0.9, smoothness=0.001)


@pytest.fixture(scope="module")
def transport() -> LightTransport:
    return build_transport(STAGE)


def picture(pitch_px: float) -> Target:
    y, x = np.mgrid[0:120, 0:160].astype(np.float32)
    wave: FloatImage = 0.5 + 0.3 * np.sin(2 * np.pi * x / pitch_px) * np.sin(2 * np.pi * y / pitch_px)
    mask = np.ones((120, 160), np.bool_)
    mask[:10] = False
    return Target(np.repeat(wave[..., None], 3, axis=2).astype(np.float32), mask)


def test_an_appearance_ends_where_no_one_would_see_more_sweeps(
    transport: LightTransport, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a target with fine detail and parts out of reach; the judge is a solve to the end."""
    options = replace(OPTIONS, share=0.7)
    seen = {}
    for tolerance in (APPEARANCE_TOLERANCE, 1e-6):
        monkeypatch.setattr(request, "APPEARANCE_TOLERANCE", tolerance)
        found = solve_appearance(StageLight(transport, STAGE.black), picture(7), options)
        light, mask = transport.forward(found.frames) + STAGE.black, transport.object_mask
        white = float(found.figures["exposure"] or 0)
        apart = colour_difference(light, found.target, STAGE.camera_to_xyz, white, mask)[mask]
        seen[tolerance] = np.percentile(apart, (50, 95)), int(found.figures["iterations"] or 0)
    (early, few), (late, many) = seen.values()
    assert early[0] <= late[0] + 0.005
    assert early[1] <= late[1] + 0.02
    assert few < many / 2


def test_reachable_pixels_are_those_where_the_target_says_something(transport: LightTransport) -> None:
    found = solve_appearance(StageLight(transport, STAGE.black), picture(40), OPTIONS)
    assert not found.reachable[:10].any()
    assert found.reachable[10:].mean() > 0.85


def test_adaptation_brings_more_into_reach_and_keeps_what_was_asked_for(transport: LightTransport) -> None:
    options = replace(OPTIONS, adapt=1.0)
    asked = picture(60)
    asked = replace(asked, image=asked.image**4)
    light = StageLight(transport, np.asarray(STAGE.black + 0.1 * np.median(transport.reach()), np.float32))
    found = solve_appearance(light, asked, options)
    plain = solve_appearance(light, asked, replace(options, adapt=0.0))
    values = {key: value for key, value in found.figures.items() if isinstance(value, float)}
    assert values["reachable_share"] < 0.7 < 0.8 < values["adapted_share"]
    np.testing.assert_allclose(found.asked, plain.target)
    np.testing.assert_array_equal(found.asked_reachable, plain.reachable)
    np.testing.assert_array_equal(plain.asked, plain.target)
    assert found.reachable.sum() > found.asked_reachable.sum()
    assert not found.valid[:10].any()
    assert OPTIONS.inputs() != options.inputs()
    former = {"share": "0.9", "smoothness": "0.001", "mode": "full", "base": "white"}
    assert OPTIONS.inputs() == former, "what was solved by an older version stays valid"


def test_the_base_is_not_solved_again_for_another_way_of_using_it() -> None:
    quick = replace(OPTIONS, share=0.5, adapt=1.0)
    assert quick.inputs() != OPTIONS.inputs()
    assert quick.base_inputs() == OPTIONS.base_inputs()
    assert replace(OPTIONS, base="minimum").base_inputs() != OPTIONS.base_inputs()
    assert replace(OPTIONS, smoothness=0.5).base_inputs() != OPTIONS.base_inputs()


def thrown_back(*, near: float, strength: float, side: int = 8) -> IndirectLight:
    """Blocks give each other light: so much of it to those around, the rest to all alike; paint of three colours."""
    grid = (120 // side, 160 // side)
    blocks = grid[0] * grid[1]
    row, column = np.divmod(np.arange(blocks), grid[1])
    apart = np.hypot(row[:, None] - row, column[:, None] - column)
    around = np.exp(-0.5 * (apart / 3) ** 2)
    factors = near * around / around.sum(axis=1, keepdims=True) + (1 - near) / blocks
    paint = strength * STAGE.projectors[0].white / STAGE.projectors[0].white.max()
    return IndirectLight(factors.astype(np.float32), paint, np.ones((120, 160), np.bool_), grid, side)


def test_indirect_light_is_left_room_for(transport: LightTransport) -> None:
    """What surfaces throw back differs somewhat from what is known of it."""
    truth, known = thrown_back(near=0.7, strength=0.4), thrown_back(near=0.5, strength=0.4)
    wave = picture(60)
    errors = {}
    for name, indirect in (("none", None), ("known", known), ("truth", truth)):
        found = solve_appearance(StageLight(transport, STAGE.black, indirect), wave, OPTIONS)
        direct = transport.forward(found.frames)
        seen = STAGE.black + direct + truth.forward(direct)
        there = found.reachable & transport.object_mask
        error = (seen - found.target)[there] / found.target[there]
        errors[name] = float(np.sqrt(np.mean(error**2)))
    assert errors["truth"] < errors["known"] < 0.5 * errors["none"]


class Again(Processor):
    """Solves a corrected target from the equations on, as engines do that have no equations to keep."""

    def solve(self, given: SolveInput, control: IterationControl) -> Solution:
        return super().solve(corrected(Processor(), given, control), control)


def test_a_target_that_is_corrected_keeps_the_equations(transport: LightTransport) -> None:
    light, target = StageLight(transport, STAGE.black, thrown_back(near=0.5, strength=0.4)), picture(20)
    seen = []
    for engine in (Processor(), Again()):
        found = solve_appearance(light, target, replace(OPTIONS, share=0.6), SolveContext(engine))
        seen.append(transport.forward(found.frames) / np.float32(found.figures["exposure"] or 0))
    np.testing.assert_allclose(seen[0], seen[1], atol=0.01)


def test_too_dark_is_what_gets_more_indirect_light_than_wanted(transport: LightTransport) -> None:
    target = picture(60)
    target.image[40:80, 60:100] = 0.01
    indirect = thrown_back(near=0.3, strength=0.5)
    with_it, without = (
        solve_appearance(StageLight(transport, STAGE.black, one), target, OPTIONS) for one in (indirect, None)
    )
    assert without.reachable[45:75, 65:95].mean() > 0.9
    assert with_it.reachable[45:75, 65:95].mean() < 0.1
    assert with_it.reachable[85:].mean() > 0.8


def test_the_brightest_target_counts_on_indirect_light(transport: LightTransport) -> None:
    """With a fifth more light on everything, targets may be about so much brighter."""
    even = thrown_back(near=0.0, strength=0.4)
    with_it, without = (
        solve_appearance(StageLight(transport, STAGE.black, one), picture(40), OPTIONS) for one in (even, None)
    )
    ratio = float(with_it.figures["exposure"] or 0) / float(without.figures["exposure"] or 1)
    assert 1.02 < ratio < 1.4


@pytest.mark.parametrize("adapt", [0.0, 1.0])
def test_the_whole_picture_is_told_as_the_target(transport: LightTransport, adapt: float) -> None:
    indirect = thrown_back(near=0.5, strength=0.4)
    options = replace(OPTIONS, adapt=adapt)
    found = solve_appearance(StageLight(transport, STAGE.black, indirect), picture(40), options)
    direct = transport.forward(found.frames)
    seen = STAGE.black + direct + indirect.forward(direct)
    there = found.reachable & transport.object_mask
    assert np.median(np.abs(seen - found.target)[there] / found.target[there]) < 0.01


def test_what_no_camera_sees_continues_what_is_seen_beside_it() -> None:
    hidden = [np.zeros(part.metapixels.valid.shape, np.bool_) for part in STAGE.projectors]
    gap, corner = np.s_[10:30, 20:26], np.s_[:8, :8]
    for unseen in hidden:
        unseen[gap] = unseen[corner] = True
    parts = [
        replace(part, metapixels=replace(part.metapixels, valid=part.metapixels.valid & ~unseen))
        for part, unseen in zip(STAGE.projectors, hidden, strict=True)
    ]
    light = StageLight(build_transport(replace(STAGE, projectors=tuple(parts))), STAGE.black)
    smooth, black = (
        solve_appearance(light, picture(40), replace(OPTIONS, unseen=unseen)).frames for unseen in ("smooth", "black")
    )
    for n, (one, other) in enumerate(zip(smooth, black, strict=True)):
        assert not other[gap].any()
        around = np.concatenate([other[8:32, 16:20].reshape(-1, 3), other[8:32, 26:30].reshape(-1, 3)])
        assert around.min() - 1e-3 <= one[gap].min()
        assert one[gap].max() <= around.max() + 1e-3
        steps = [np.abs(np.diff(part, axis=1)).mean() for part in (one[9:31, 19:27], other[9:31, 30:38])]
        assert steps[0] < 1.5 * steps[1] + 0.01, "no edge, and no noise"

        def sheet(n: int, asked: Mask) -> FloatImage:
            """Half as much in the right part, not known at the bottom. None but these pixels are looked up."""
            paint = np.where(asked, np.float32(0.6), np.float32(np.nan))
            paint[10:30, 23:26] /= 2
            paint[27:30, 20:26] = np.nan
            return np.repeat(paint[..., None], 3, axis=2)

        painted = continued(light.transport, smooth, sheet)[n]
        np.testing.assert_array_equal(painted[28:30, 20:26], one[28:30, 20:26])
        np.testing.assert_allclose(painted[10:27, 20:23], one[10:27, 20:23], rtol=1e-4)
        np.testing.assert_allclose(painted[10:27, 23:26], one[10:27, 23:26] / 2, rtol=1e-4)
        seen = (light.transport.per_weight[light.transport.span(n)] > 0).reshape(other.shape[:2])
        np.testing.assert_array_equal(one[seen], other[seen])
        assert not one[0, 0].any(), "what is open to the border may light anything"
    settings = SolveSettings(OPTIONS.smoothness, start=smooth)
    grey = np.full((120, 160, 3), 0.2, np.float32)
    again = solve_again(light, grey, grey, settings, ALONE, exposure=1.0)
    for one, before in zip(again, smooth, strict=True):
        np.testing.assert_array_equal(one[gap], before[gap])
        assert np.abs(one - before).max() > 0.05, "the rest was solved"
