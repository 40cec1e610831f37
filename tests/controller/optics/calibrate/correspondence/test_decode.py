from __future__ import annotations

import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.core.arrays import MAPPED_FROM, FloatImage
from controller.core.errors import CalibrationError
from controller.optics.calibrate.correspondence.decode import decode
from controller.optics.calibrate.values import Correspondence
from controller.optics.capture.pattern_frames import device_frame
from controller.optics.capture.patterns import CELL_PX, plan_patterns
from controller.optics.solve.memory_need import DECODED
from tests.controller.optics.calibrate.simulator import Scene, Stage, photographed, positions

pytestmark = pytest.mark.slow

PLAN = plan_patterns(Scene().projector_px)


def rms(errors: np.ndarray[tuple[int, ...], np.dtype[np.floating]]) -> float:
    return float(np.sqrt(np.mean(errors**2)))


def changed(**images: FloatImage) -> dict[str, FloatImage]:
    return {**photographed(Scene()), **{name.replace("_", "-"): image for name, image in images.items()}}


@pytest.mark.parametrize(
    ("scene", "limit_px"),
    [
        (Scene(), 0.02),
        (Scene(projector_blur_px=1.5), 0.02),
        (Scene(projector_blur_px=0.0, camera_blur_px=0.4), 0.03),
        (Scene(scale=1.5, seed=5), 0.02),
    ],
    ids=["in focus", "defocused", "razor-sharp", "small pixels"],
)
def test_correspondences_are_accurate_to_a_few_hundredths_of_a_pixel(scene: Scene, limit_px: float) -> None:
    found = decode(photographed(scene), PLAN)
    assert rms((found.projector_px - positions(scene))[found.valid]) < limit_px
    assert np.mean(found.valid) > 0.35


def test_camera_pixels_that_look_past_the_projectors_frame_are_not_valid() -> None:
    found = decode(photographed(Scene()), PLAN)
    truth = positions(Scene())
    outside = np.any((truth < -0.5) | (truth > np.array(PLAN.size_px) - 0.5), axis=2)
    assert np.count_nonzero(outside) > 1000
    assert not np.any(found.valid & outside)
    assert np.all(np.isnan(found.projector_px[~found.valid]))


def test_cells_agree_with_opencvs_gray_code_decoder() -> None:
    captures = photographed(Scene())
    width, height = PLAN.size_px
    oracle = cv2.structured_light.GrayCodePattern.create(-(-width // CELL_PX), -(-height // CELL_PX))
    whole = {name: image.sum(axis=2) for name, image in captures.items()}
    images = []
    for pattern in (*PLAN.gray(0), *PLAN.gray(1)):
        above = whole[pattern.name] - (whole["white"] + whole["black"]) / 2
        images += [np.clip(128 + side * above * 80, 0, 255).astype(np.uint8) for side in (1, -1)]
    found = decode(captures, PLAN)
    inner = np.min(np.abs((found.projector_px + 0.5) % CELL_PX - CELL_PX / 2), axis=2) < CELL_PX / 2 - 0.4
    rows, columns = np.nonzero(found.valid & inner)
    compared = 0
    for row, column in list(zip(rows, columns, strict=True))[::97]:
        position = found.projector_px[row, column]
        if np.any(np.abs((position + 0.5) % CELL_PX - CELL_PX / 2) > CELL_PX / 2 - 0.4):
            continue
        failed, cell = oracle.getProjPixel(images, int(column), int(row))
        assert not failed
        assert cell == tuple(int(v) for v in (position + 0.5) // CELL_PX)
        compared += 1
    assert compared > 100


def test_a_depth_edge_neither_mixes_surfaces_nor_spreads() -> None:
    scene = Scene(step_px=7.0)
    found = decode(photographed(scene), PLAN)
    error = np.abs(found.projector_px - positions(scene))
    assert np.nanmax(error) < 0.75
    assert rms(error[found.valid]) < 0.03
    near = np.abs(np.arange(scene.camera_px[0]) - 0.6 * scene.camera_px[0]) < 3
    truth = positions(scene)
    inside = np.all((truth > 2) & (truth < np.array(PLAN.size_px) - 3), axis=2)
    assert np.mean(found.valid[inside & ~near]) > 0.99


@pytest.mark.parametrize("step_px", [13.0, 20.0, 30.0])
def test_an_object_with_many_depth_edges_is_no_contradiction(step_px: float) -> None:
    """Bars narrower than a cell: most cells beside each other in the picture are none on the projector's."""
    scene = Scene(step_px=step_px, bars_px=11)
    found = decode(photographed(scene), PLAN)
    at = np.arange(scene.camera_px[0]) % scene.bars_px
    inside = found.valid & (at > 1) & (at < scene.bars_px - 1)
    error = np.abs(found.projector_px - positions(scene))[inside]
    assert np.count_nonzero(inside) > 5000
    assert float(np.median(error)) < 0.05
    assert float(np.percentile(error, 99)) < 0.75


@pytest.mark.parametrize("name", ["black", "gray-x-2", "phase-y-2", "blur-d-1"])
def test_a_missing_capture_is_named(name: str) -> None:
    captures = changed()
    del captures[name]
    with pytest.raises(CalibrationError, match=name) as caught:
        decode(captures, PLAN)
    assert caught.value.code == "capture-missing"


def test_a_capture_of_another_size_is_refused() -> None:
    with pytest.raises(CalibrationError) as caught:
        decode(changed(gray_x_1=np.zeros((10, 10, 3), np.float32)), PLAN)
    assert caught.value.code == "capture-shape-wrong"


@pytest.mark.parametrize(
    "lag",
    [
        ["gray-x-0", "gray-x-1", "gray-x-2"],
        ["phase-x-0", "phase-x-1"],
        ["gray-y-0", "gray-y-2"],
        ["blur-x-0", "blur-x-1"],
        ["blur-y-0", "blur-d-0"],
    ],
)
def test_captures_in_the_wrong_order_are_refused(lag: list[str]) -> None:
    captures = changed()
    captures.update(zip(lag, [captures[name] for name in [lag[-1], *lag[:-1]]], strict=True))
    with pytest.raises(CalibrationError) as caught:
        decode(captures, PLAN)
    assert caught.value.code == "captures-inconsistent"


@pytest.mark.parametrize("again", [("gray-x-3", "gray-x-2"), ("gray-y-3", "gray-y-1"), ("gray-y-0", "gray-y-3")])
def test_one_picture_photographed_in_place_of_another_is_refused_also_by_a_coarse_camera(
    again: tuple[str, str],
) -> None:
    """One camera pixel on 1.4 projector pixels: without the refusal, two thirds of the pixels would be lost."""
    stage = Stage(Scene((132, 100), (160, 120), 0.7))
    captures = stage.captures()
    decode(captures, stage.plan())
    captures[again[0]] = captures[again[1]]
    with pytest.raises(CalibrationError) as caught:
        decode(captures, stage.plan())
    assert caught.value.code == "captures-inconsistent"


@pytest.mark.parametrize("value", [0.0, 1.0, np.nan])
def test_black_saturated_and_unmeasured_photographs_give_nothing(value: float) -> None:
    captures = {pattern.name: np.full((40, 50, 3), value, np.float32) for pattern in PLAN}
    found = decode(captures, PLAN)
    assert not found.valid.any()
    assert np.all(np.isnan(found.projector_px))


def test_a_dead_projector_gives_nothing_but_noise_and_no_pixels() -> None:
    stage = Stage(Scene(exposure=0.0))
    captures = {p.name: stage.photograph(device_frame(p, PLAN.size_px, stage.scene.response())) for p in PLAN}
    assert np.mean(decode(captures, PLAN).valid) < 1e-3


def test_pixels_that_were_saturated_in_one_capture_are_left_out_and_the_rest_is_kept() -> None:
    hurt = photographed(Scene())["phase-x-0"].copy()
    hurt[60:80, 100:130] = np.nan
    found, whole = decode(changed(phase_x_0=hurt), PLAN), decode(photographed(Scene()), PLAN)
    assert not found.valid[60:80, 100:130].any()
    far = np.ones(found.valid.shape, bool)
    far[55:85, 95:135] = False
    assert np.mean(found.valid[far] != whole.valid[far]) < 1e-3


@pytest.mark.parametrize("same", ["everything", "patterns", "phase-x", "phase-y", "blur-x", "blur-d"])
def test_pixels_that_show_the_same_in_several_photographs_are_left_out_and_the_rest_is_kept(same: str) -> None:
    """As dark paint does in a camera whose steps are coarser than its light."""
    captures = {name: image.copy() for name, image in photographed(Scene()).items()}
    hurt = np.zeros(captures["black"].shape[:2], bool)
    hurt[40:120:3, 60:180:4] = True
    for name, image in captures.items():
        if same == "everything" or name.startswith(same) or (same == "patterns" and name[-1].isdigit()):
            image[hurt] = captures["black"][hurt] if same == "everything" else captures["white"][hurt] / 2
    found, whole = decode(captures, PLAN), decode(photographed(Scene()), PLAN)
    assert whole.valid[hurt].mean() > 0.5
    if same in ("everything", "patterns", "phase-x", "phase-y"):
        assert not found.valid[hurt].any()
    error = np.abs(found.projector_px - positions(Scene()))[found.valid]
    assert rms(error) < 0.03
    far = cv2.dilate(hurt.astype(np.uint8), np.ones((13, 13), np.uint8)) == 0
    assert np.mean(found.valid[far] != whole.valid[far]) < 1e-3


@settings(max_examples=8, deadline=None)
@given(scale=st.floats(1.4, 3.2), bend=st.floats(0, 4), blur=st.floats(0.1, 1.2), seed=st.integers(0, 1000))
def test_any_smooth_warp_is_decoded(scale: float, bend: float, blur: float, seed: int) -> None:
    scene = Scene((132, 100), (64, 48), scale, bend, projector_blur_px=blur, seed=seed)
    stage = Stage(scene)
    found = decode(stage.captures(), stage.plan())
    assert rms((found.projector_px - positions(scene))[found.valid]) < 0.04


@pytest.mark.parametrize(
    "scene",
    [
        Scene(projector_blur_px=2.0, electrons=3000.0),
        Scene(projector_blur_px=3.0),
        Scene(exposure=0.2, electrons=3000.0, read_electrons=12.0),
    ],
    ids=["defocused and noisy", "hardly a fringe left", "dark"],
)
def test_no_pixel_is_ever_a_fringe_off(scene: Scene) -> None:
    found = decode(photographed(scene), PLAN)
    assert np.mean(found.valid) > 0.3
    assert np.max(np.abs(found.projector_px - positions(scene))[found.valid]) < 1.5


def test_pixels_whose_fine_fringes_were_saturated_keep_what_the_other_waves_tell() -> None:
    hurt = photographed(Scene())["blur-x-1"].copy()
    hurt[60:80, 100:130] = np.nan
    found = decode(changed(blur_x_1=hurt), PLAN)
    assert found.valid[60:80, 100:130].mean() > 0.95
    error = (found.projector_px - positions(Scene()))[60:80, 100:130]
    assert rms(error[np.isfinite(error)]) < 0.1


def test_a_known_blur_of_the_camera_frees_positions_from_the_pull_of_pale_paint() -> None:
    scene = Scene(scale=1.5, seed=5)
    blur_px = float(np.hypot(scene.camera_blur_px, np.sqrt(1 / 12)))
    as_seen = decode(photographed(scene), PLAN)
    freed = decode(photographed(scene), PLAN, camera_blur_px=blur_px)
    both = as_seen.valid & freed.valid
    assert np.mean(both) > 0.35
    errors = [rms((found.projector_px - positions(scene))[both]) for found in (as_seen, freed)]
    assert errors[1] < 0.6 * errors[0]


def test_sums_in_a_file_give_the_same_to_the_bit_and_leave_the_memory(tmp_path: Path) -> None:
    captures, beside = photographed(Scene()), (6, 5, 1)
    pixels = 30 * captures["black"].shape[0] * captures["black"].shape[1]
    assert 40 * pixels >= MAPPED_FROM

    class Lent(dict[str, FloatImage]):
        """As a run has them, each read again: many scenes side by side, for a file is used from some size on."""

        def __getitem__(self, name: str) -> FloatImage:
            return np.tile(captures[name], beside)

    def decoded(scratch: Path | None) -> tuple[Correspondence, int]:
        tracemalloc.start()
        try:
            found = decode(Lent(), PLAN, camera_blur_px=0.6, scratch=scratch)
            return found, tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    (filed, least), (kept, most) = decoded(tmp_path), decoded(None)
    for name in ("projector_px", "modulation", "valid", "as_seen_px"):
        np.testing.assert_array_equal(getattr(filed, name), getattr(kept, name))
    assert most - least == pytest.approx(40 * pixels, rel=0.02)
    assert least < DECODED * pixels
    assert list(tmp_path.iterdir()) == []
