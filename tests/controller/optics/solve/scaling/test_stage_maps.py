"""The maps stand for the light transport, and what the processor makes of them is what the reference makes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from controller.bundle.live_maps import LiveMaps, compensate, compensate_light, light_table
from controller.core.arrays import ByteImage, FloatImage
from controller.core.colour import linear_to_srgb
from controller.core.errors import UsageError
from controller.optics.calibrate.values import Calibration
from controller.optics.solve.appearance import Base, BaseKind, StageLight, base_image, scale_frames, solve_base
from controller.optics.solve.bounded.equations import SolveSettings
from controller.optics.solve.scaling.dither import to_light
from controller.optics.solve.scaling.interactive import Interactive
from controller.optics.solve.scaling.stage_maps import NARROWED, footprints, reduced, reduction, scaling_maps
from controller.optics.transport import LightTransport, build_transport
from controller.optics.transport.indirect.indirect_light import IndirectLight
from lab.timings.tools.synthetic import synthetic_calibration, synthetic_target

Stage = tuple[Calibration, LightTransport, Base]


def solved(kind: BaseKind) -> Stage:
    calibration = synthetic_calibration(projector=(52, 70), camera=(130, 194))
    transport = build_transport(calibration)
    base = solve_base(transport, base_image(calibration, kind), calibration.black, SolveSettings(tolerance=1e-2))
    return calibration, transport, base


@pytest.fixture(scope="module")
def stage() -> Stage:
    return solved("minimum")


def maps_of(stage: Stage, largest_px: int = 2048, spread: float = NARROWED) -> LiveMaps:
    calibration, transport, base = stage
    radiometries = [part.radiometry for part in calibration.projectors]
    return scaling_maps(
        StageLight(transport, calibration.black), base, radiometries, largest_px=largest_px, spread=spread
    )


def seen(stage: Stage, frames: Sequence[ByteImage]) -> FloatImage:
    """(rows, columns, 3): the light of frames as the camera sees it, where dithering evens out."""
    calibration, transport, _ = stage
    parts = zip(frames, calibration.projectors, strict=True)
    return transport.forward([to_light(image, part.radiometry) for image, part in parts])


def wanted(stage: Stage, largest_px: int = 2048) -> tuple[np.ndarray[tuple[int, ...], np.dtype[np.uint8]], float]:
    """An sRGB target of the maps' size, and a brightness that leaves most of it in reach."""
    _, transport, base = stage
    small = reduced(synthetic_target(transport.camera_shape), reduction(transport.camera_shape, largest_px))
    brightness = 0.25 * float(np.median(base.image[transport.object_mask])) / 0.3
    return np.rint(255 * linear_to_srgb(small)).astype(np.uint8), brightness


def test_centres_and_spreads_are_those_of_the_transport(stage: Stage) -> None:
    _, transport, _ = stage
    centre, sigma, correlation = footprints(transport, 1)
    y, x = np.mgrid[0 : transport.camera_shape[0], 0 : transport.camera_shape[1]].astype(np.float64)
    lit = np.flatnonzero(sigma[:, 0] > 0)
    assert len(lit) > 3000
    white = transport.forward_planes(np.ones((3, transport.pixels), np.float32)).sum(axis=0)
    off, ratio = [], []
    for pixel in np.random.default_rng(1).choice(lit, 40, replace=False):
        one = np.zeros((3, transport.pixels), np.float32)
        one[:, pixel] = 1
        # The rows of T' in the mean of all channels, light of each camera pixel left out.
        seen = transport.forward_planes(one).astype(np.float64).sum(axis=0)
        weight = np.divide(seen, white, out=np.zeros_like(seen), where=white > 0)
        weight /= weight.sum()
        mean = (weight * x).sum(), (weight * y).sum()
        spread = np.sqrt([(weight * (x - mean[0]) ** 2).sum(), (weight * (y - mean[1]) ** 2).sum()])
        off.append(np.hypot(*(centre[pixel] - mean)))
        ratio.append(sigma[pixel] / np.maximum(spread, 0.3))
    # at the rim, where the camera's interpolation ends, a few lie apart
    assert np.median(off) < 0.06
    assert np.quantile(off, 0.75) < 0.25
    assert np.abs(np.median(ratio, axis=0) - 1).max() < 0.1
    assert np.abs(correlation[lit]).max() <= 0.95


@pytest.mark.parametrize(("largest_px", "most"), [(2048, 0.01), (100, 0.03)])
def test_frames_of_the_papers_means_are_base_times_scale(stage: Stage, largest_px: int, most: float) -> None:
    calibration, transport, base = stage
    target, brightness = wanted(stage, largest_px)
    shown = seen(stage, compensate(maps_of(stage, largest_px, spread=1.0), target, brightness))
    whole = np.rint(255 * linear_to_srgb(synthetic_target(transport.camera_shape))).astype(np.uint8)
    exact = scale_frames(transport, base, light_table()[whole] * np.float32(brightness), calibration.black)
    meant = transport.forward(exact)
    mask = transport.object_mask
    assert np.sqrt(np.mean((shown - meant)[mask] ** 2) / np.mean(meant[mask] ** 2)) < most


@pytest.mark.parametrize("kind", ["minimum", "white"])
def test_narrower_means_come_nearer_to_the_target_than_the_papers(kind: BaseKind) -> None:
    stage = solved(kind)
    calibration, transport, _ = stage
    target, brightness = wanted(stage)
    light = light_table()[target] * np.float32(brightness)
    mask = transport.object_mask & (transport.reach() > light).all(axis=2)
    away = {
        spread: seen(stage, compensate(maps_of(stage, spread=spread), target, brightness)) + calibration.black - light
        for spread in (NARROWED, 1.0)
    }
    narrow, paper = (float(np.sqrt(np.mean(error[mask] ** 2))) for error in away.values())
    assert narrow < 0.95 * paper


@pytest.mark.parametrize("kind", ["minimum", "white"])
@pytest.mark.parametrize("largest_px", [2048, 100], ids=["blocks of two", "target pixels"])
def test_the_processor_makes_the_frames_of_the_reference(kind: BaseKind, largest_px: int) -> None:
    stage = solved(kind)
    maps = maps_of(stage, largest_px)
    target, brightness = wanted(stage, largest_px)
    scaler = Interactive(maps)
    frames = scaler.blank()
    scaler.show_picture(np.zeros_like(target), brightness, frames)
    assert not any(frame.any() for frame in frames), "black is below the black image: no light"
    scaler.show_picture(target, brightness, frames)
    for frame, reference, output in zip(frames, compensate(maps, target, brightness), maps.outputs, strict=True):
        lit = output.shape[..., 0] > 0
        assert reference[lit].std() > 10
        assert not frame[~lit].any()
        away = np.abs(frame.astype(int) - reference)[lit]
        # the goal of the live mode is 2 in the mean
        assert away.mean() <= 0.75
        assert np.percentile(away, 99) <= 5


@pytest.mark.parametrize("largest_px", [2048, 100], ids=["camera's size", "half of it"])
def test_a_radiance_gives_the_frames_of_the_reference(stage: Stage, largest_px: int) -> None:
    _, transport, _ = stage
    maps = maps_of(stage, largest_px)
    radiance = synthetic_target(transport.camera_shape) * np.float32(wanted(stage)[1])
    factor = reduction(transport.camera_shape, largest_px)
    frames = Interactive(maps, transport.camera_shape).frames(radiance)
    for frame, reference in zip(frames, compensate_light(maps, reduced(radiance, factor)), strict=True):
        assert np.abs(frame.astype(int) - reference).mean() <= 0.5


def thrown_back(stage: Stage) -> IndirectLight:
    """A sixth of what the stage sees comes by way of other surfaces: of all of them, and more of near ones."""
    _, transport, _ = stage
    rows, columns = transport.camera_shape
    grid, side = (-(-rows // 8), -(-columns // 8)), 8
    y, x = np.divmod(np.arange(grid[0] * grid[1]), grid[1])
    near = np.exp(-0.5 * (np.subtract.outer(x, x) ** 2 + np.subtract.outer(y, y) ** 2) / 9)
    factors = (near / near.sum(axis=1, keepdims=True) + 1 / len(x)).astype(np.float32) / 2
    paint = np.repeat(0.15 + 0.1 * np.sin(np.arange(columns) / 3)[None, :, None], rows, axis=0)
    surface = np.repeat(paint, 3, axis=2).astype(np.float32)
    return IndirectLight(factors, surface, transport.object_mask, grid, side)


def painted(stage: Stage, most: float = 0.5) -> IndirectLight:
    """Colours that depend on the paint: white stays white, others are off by up to ``most``, in stripes."""
    calibration, transport, _ = stage
    columns = transport.camera_shape[1]
    white = np.sum([part.white for part in calibration.projectors], axis=0)
    white = np.maximum(white / np.maximum(white.max(axis=2, keepdims=True), 1e-9), 0.05)
    stripes = (most * np.sin(np.arange(columns) / 5)).astype(np.float32)
    mixed = np.full((3, 3), 0.5) - 1.5 * np.eye(3)
    paint = np.einsum("ck,x,yxc,yxk->ckyx", mixed, stripes, white, 1 / white)
    paint = np.where(transport.object_mask, paint, 0).astype(np.float16)
    return dataclasses.replace(thrown_back(stage), factors=np.zeros_like(thrown_back(stage).factors), paint=paint)


def both(stage: Stage) -> IndirectLight:
    return dataclasses.replace(thrown_back(stage), paint=painted(stage).paint)


@pytest.mark.parametrize("largest_px", [2048, 100], ids=["camera's size", "half of it"])
@pytest.mark.parametrize("light", [thrown_back, painted, both])
def test_the_processor_leaves_room_for_other_light_as_the_reference_does(
    largest_px: int, light: Callable[[Stage], IndirectLight]
) -> None:
    stage = solved("white")
    calibration, transport, base = stage
    radiometries = [part.radiometry for part in calibration.projectors]
    maps = scaling_maps(
        StageLight(transport, calibration.black, light(stage)), base, radiometries, largest_px=largest_px
    )
    target, brightness = wanted(stage, largest_px)
    scaler = Interactive(maps)
    frames = scaler.blank()
    scaler.show_picture(target, brightness, frames)
    plain = compensate(dataclasses.replace(maps, indirect=None, paint=None), target, brightness)
    radiance = light_table()[target] * np.float32(brightness)
    as_light = Interactive(maps, maps.present.shape).frames(radiance)
    for n, reference in enumerate(compensate(maps, target, brightness)):
        lit = maps.outputs[n].shape[..., 0] > 0
        assert np.abs(reference.astype(int) - plain[n])[lit].mean() > 3, "that light counts here"
        for made in (frames[n], as_light[n]):
            assert np.abs(made.astype(int) - reference)[lit].mean() <= 0.75


def shown(stage: Stage, indirect: IndirectLight, target: ByteImage, brightness: float) -> tuple[FloatImage, FloatImage]:
    """(rows, columns, 3): what is seen of a live picture whose maps know ``indirect`` light, and whose do not."""
    calibration, transport, base = stage
    radiometries = [part.radiometry for part in calibration.projectors]
    found = []
    for known in (indirect, None):
        maps = scaling_maps(StageLight(transport, calibration.black, known), base, radiometries)
        direct = seen(stage, compensate(maps, target, brightness))
        found.append(direct + indirect.forward(direct) + calibration.black)
    return found[0], found[1]


def test_a_live_picture_with_its_indirect_light_is_as_bright_as_wanted() -> None:
    stage = solved("white")
    _, transport, _ = stage
    target, brightness = wanted(stage)
    light = light_table()[target] * np.float32(brightness)
    mask = transport.object_mask & (0.7 * transport.reach() > light).all(axis=2)
    known, unknown = (
        abs(float(whole[mask].mean() / light[mask].mean()) - 1)
        for whole in shown(stage, thrown_back(stage), target, brightness)
    )
    assert known < 0.02
    assert unknown > 4 * known


def test_a_live_picture_on_paint_that_changes_colours_has_the_wanted_ones() -> None:
    stage = solved("white")
    _, transport, _ = stage
    target, brightness = wanted(stage)
    target[..., 0], target[..., 2] = 200, 90
    light = light_table()[target] * np.float32(brightness)
    mask = transport.object_mask & (0.5 * transport.reach() > light).all(axis=2)
    mild = painted(stage, 0.3)  # all of it can be made up for
    known, unknown = (
        float(np.median(np.abs(whole[mask] / light[mask] - 1))) for whole in shown(stage, mild, target, brightness)
    )
    assert known < 0.03
    assert unknown > 3 * known


def segmented(stage: Stage, share: float) -> Stage:
    """Another white segment in each projector, and a base that knows them."""
    calibration, _, _ = stage
    projectors = tuple(
        dataclasses.replace(part, radiometry=dataclasses.replace(part.radiometry, segment=share * (n + 1)))
        for n, part in enumerate(calibration.projectors)
    )
    calibration = dataclasses.replace(calibration, projectors=projectors)
    transport = build_transport(calibration)
    base = solve_base(transport, base_image(calibration, "white"), calibration.black, SolveSettings(tolerance=1e-2))
    return calibration, transport, base


@pytest.mark.parametrize("largest_px", [2048, 100], ids=["camera's size", "half of it"])
def test_the_processor_knows_white_segments_as_the_reference_does(stage: Stage, largest_px: int) -> None:
    stage = segmented(stage, 0.12)
    maps = maps_of(stage, largest_px)
    target, brightness = wanted(stage, largest_px)
    target[..., 0] //= 2
    scaler = Interactive(maps)
    frames = scaler.blank()
    scaler.show_picture(target, brightness, frames)
    outputs = tuple(dataclasses.replace(output, segment=0.0) for output in maps.outputs)
    plain = compensate(dataclasses.replace(maps, outputs=outputs), target, brightness)
    for n, reference in enumerate(compensate(maps, target, brightness)):
        lit = maps.outputs[n].shape[..., 0] > 0
        assert np.abs(reference.astype(int) - plain[n])[lit].mean() > 1, "the segment counts here"
        assert np.abs(frames[n].astype(int) - reference)[lit].mean() <= 0.75


def test_a_live_picture_by_projectors_with_white_segments_has_the_wanted_colours(stage: Stage) -> None:
    stage = segmented(stage, 0.12)
    calibration, transport, _ = stage
    target, brightness = wanted(stage)
    target[..., 0], target[..., 2] = 200, 120
    light = light_table()[target] * np.float32(brightness)
    mask = transport.object_mask & (0.5 * transport.reach() > light).all(axis=2)
    maps = maps_of(stage)
    unaware = tuple(dataclasses.replace(output, segment=0.0) for output in maps.outputs)
    known, unknown = (
        float(
            np.median(
                np.abs((seen(stage, compensate(each, target, brightness)) + calibration.black)[mask] / light[mask] - 1)
            )
        )
        for each in (maps, dataclasses.replace(maps, outputs=unaware))
    )
    assert mask.sum() > 1000
    assert known < 0.03
    assert unknown > 3 * known


def test_a_picture_of_another_size_is_refused_with_both_sizes(stage: Stage) -> None:
    scaler = Interactive(maps_of(stage))
    with pytest.raises(UsageError) as refused:
        scaler.show_picture(np.zeros((10, 12, 3), np.uint8), 1.0, scaler.blank())
    assert refused.value.code == "image-wrong-size"
    assert "10 x 12 x 3" in refused.value.what
    assert "130 x 194 x 3" in refused.value.what


def test_a_camera_of_odd_size_is_reduced_with_its_edge_repeated(stage: Stage) -> None:
    calibration, _, _ = stage
    maps = maps_of(stage, 100)
    rows, columns = (side - 1 for side in calibration.black.shape[:2])
    scaler = Interactive(dataclasses.replace(maps), (rows, columns))
    radiance = np.full((rows, columns, 3), 0.1, np.float32)
    whole = Interactive(maps, (rows + 1, columns + 1)).frames(np.full((rows + 1, columns + 1, 3), 0.1, np.float32))
    for frame, other in zip(scaler.frames(radiance), whole, strict=True):
        np.testing.assert_array_equal(frame, other)
