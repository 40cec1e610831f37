"""What the optics must keep to whatever the stage: inverse square, Lambert, energy, shadows, the lamp."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from plugins.emulated.core.truth import BenchTruth, Pose
from plugins.emulated.optics.footprints import LARGEST_RADIUS, pixel_profiles
from plugins.emulated.optics.objects import StageObject
from plugins.emulated.optics.rays import SIGMA_STEP_PX, Samples, cast, project, samples_of
from plugins.emulated.optics.render import Renderer, emitted, response


def facing_plane(tilt: float = 0.0) -> StageObject:
    """A small square at the origin that faces the camera, turned round the upright axis by ``tilt``."""
    half = np.array([(-0.02, -0.02), (0.02, -0.02), (0.02, 0.02), (-0.02, 0.02)])
    vertices = np.stack((half[:, 0] * np.cos(tilt), half[:, 1], half[:, 0] * np.sin(tilt)), axis=-1)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    normal = np.array([np.sin(tilt), 0.0, -np.cos(tilt)], np.float32)
    return StageObject(
        vertices=vertices.astype(np.float32),
        faces=faces,
        normals=np.broadcast_to(normal, (2, 3, 3)).copy(),
        paint="corners",
        corner_values=np.full((2, 3, 3), 0.5, np.float32),
        texture=np.zeros(0, np.float32),
        parts=np.zeros(1, np.int32),
    )


def straight_on(truth: BenchTruth, distance_m: float, *, aside: float = 0.0) -> BenchTruth:
    """One projector on the optical axis at a distance, its lens axis through the object."""
    light = dataclasses.replace(truth.projectors[0].light, brightness=1.0, reference_m=1.0, vignetting=0.0)
    width, height = truth.projectors[0].lens.size_px
    lens = dataclasses.replace(truth.projectors[0].lens, centre_px=((width - 1) / 2, (height - 1) / 2))
    pose = Pose((aside, 0.0, -distance_m), (0.0, 0.0, 0.0))
    camera = dataclasses.replace(truth.camera, pose=Pose((0.0, 0.0, -1.2), (0.0, 0.0, 0.0)))
    projector = dataclasses.replace(truth.projectors[0], pose=pose, lens=lens, light=light)
    return dataclasses.replace(truth, camera=camera, projectors=(projector,))


def mean_gain(truth: BenchTruth, stage_object: StageObject) -> float:
    samples = cast(truth, stage_object, lambda share: None)
    assert len(samples.gain[0]) > 20
    return float(samples.gain[0].mean())


def test_light_falls_with_the_square_of_the_distance(tiny_truth: BenchTruth) -> None:
    near, far = (mean_gain(straight_on(tiny_truth, d), facing_plane()) for d in (0.8, 1.6))
    assert near / far == pytest.approx(4.0, rel=2e-3)
    assert near == pytest.approx(1.0 / 0.8**2, rel=2e-3)


@pytest.mark.parametrize("tilt", [0.3, 0.8, 1.2])
def test_light_falls_with_the_cosine_of_the_slant(tiny_truth: BenchTruth, tilt: float) -> None:
    truth = straight_on(tiny_truth, 1.0)
    assert mean_gain(truth, facing_plane(tilt)) / mean_gain(truth, facing_plane()) == pytest.approx(
        np.cos(tilt), rel=1e-2
    )


def test_a_blurred_pixel_keeps_its_light() -> None:
    """The light of one pixel over the whole plane is its area's, at every blur: integrate over positions."""
    for fill in (1.0, 0.9, 0.5):
        profiles, _ = pixel_profiles(fill)
        light_of_a_pixel = profiles.mean(axis=1).sum(axis=1)
        np.testing.assert_allclose(light_of_a_pixel[:200], 1.0, atol=5e-3)


def test_an_evenly_lit_image_is_even_where_it_is_blurred_and_shows_the_gaps_where_it_is_sharp() -> None:
    profiles, _ = pixel_profiles(0.8)
    over_positions = profiles.sum(axis=2)
    assert np.ptp(over_positions[round(1.0 / SIGMA_STEP_PX)]) < 1e-3
    assert np.ptp(over_positions[round(0.05 / SIGMA_STEP_PX)]) > 0.5


def test_blur_spreads_as_a_gaussian_of_the_wanted_width() -> None:
    profiles, _ = pixel_profiles(1.0)
    sigma_px = 1.5
    offsets = (np.arange(profiles.shape[1]) + 0.5) / profiles.shape[1] - 0.5
    position = offsets[:, None] - (np.arange(profiles.shape[2]) - LARGEST_RADIUS)[None, :]
    weights = profiles[round(sigma_px / SIGMA_STEP_PX)] / profiles.shape[1]
    assert float((weights * position**2).sum()) == pytest.approx(sigma_px**2 + 1 / 12, rel=0.02)


def test_every_projector_covers_the_object_with_room_to_spare(
    tiny_truth: BenchTruth, vase_and_bust: StageObject
) -> None:
    points = vase_and_bust.vertices.astype(np.float64)
    camera = tiny_truth.camera
    for pose, lens in [(camera.pose, camera.lens), *((p.pose, p.lens) for p in tiny_truth.projectors)]:
        at, _ = project(pose, lens, points)
        share = np.ptp(at, axis=0) / lens.size_px
        assert (at > 1).all()
        assert (at < np.asarray(lens.size_px) - 2).all()
        assert 0.8 < share.max() < 0.95
    angles = [angle_to_camera(tiny_truth, p.pose) for p in tiny_truth.projectors]
    assert all(15.0 < angle < 40.0 for angle in angles)


def angle_to_camera(truth: BenchTruth, pose: Pose) -> float:
    a, b = np.asarray(truth.camera.pose.position_m), np.asarray(pose.position_m)
    return float(np.rad2deg(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b))))


@pytest.fixture(scope="module")
def tiny_samples(tiny_truth: BenchTruth, vase_and_bust: StageObject) -> Samples:
    return cast(tiny_truth, vase_and_bust, lambda share: None)


def blank(truth: BenchTruth, value: int) -> list[npt.NDArray[np.uint8]]:
    return [np.full((*p.lens.size_px[::-1], 3), value, np.uint8) for p in truth.projectors]


def test_projectors_add_up_and_lamps_scale(tiny_truth: BenchTruth, tiny_samples: Samples) -> None:
    renderer = Renderer(tiny_truth, tiny_samples)
    white = blank(tiny_truth, 255)
    dark = renderer.light(white, [0.0, 0.0, 0.0])
    alone = [renderer.light(white, [float(i == n) for i in range(3)]) - dark for n in range(3)]
    together = renderer.light(white, [1.0, 0.5, 1.0]) - dark
    np.testing.assert_allclose(together, alone[0] + 0.5 * alone[1] + alone[2], atol=1e-5)
    assert 1.2 < together.max() < 3.0


def test_a_dark_stage_shows_the_ambient_light_and_black_frames_the_black_level(
    tiny_truth: BenchTruth, tiny_samples: Samples
) -> None:
    renderer = Renderer(tiny_truth, tiny_samples)
    white, black = blank(tiny_truth, 255), blank(tiny_truth, 0)
    dark = renderer.light(black, [0.0] * 3)
    assert 0.0 < dark.max() < 0.0025
    lit = renderer.light(white, [1.0] * 3) - dark
    leaked = renderer.light(black, [1.0] * 3) - dark
    on_object = lit[..., 1] > 0.1
    assert np.median(leaked[on_object] / lit[on_object]) == pytest.approx(1 / 1500, rel=0.15)


def test_shadows_differ_by_projector_and_no_lit_point_is_behind_another(tiny_samples: Samples) -> None:
    shadowed = [float(np.mean(gain == 0.0)) for gain in tiny_samples.gain]
    assert all(0.01 < share < 0.3 for share in shadowed)
    assert float(np.mean(np.all(tiny_samples.gain == 0.0, axis=0))) < min(shadowed) / 2


def test_a_response_rises_from_nothing_to_full_in_every_channel(tiny_truth: BenchTruth) -> None:
    for projector in tiny_truth.projectors:
        curve = response(projector.light)
        assert curve[0] == pytest.approx([0.0] * 3)
        assert curve[255] == pytest.approx([1.0] * 3)
        assert (np.diff(curve, axis=0) > 0).all()


def test_red_light_is_mostly_but_not_only_red(tiny_truth: BenchTruth) -> None:
    red = np.zeros((2, 2, 3), np.uint8)
    red[..., 0] = 255
    for projector in tiny_truth.projectors:
        seen = emitted(projector.light, red)[0, 0]
        assert 0.02 < seen[1] / seen[0] < 0.2


def test_rays_are_cast_once_and_again_only_for_another_stage(
    tiny_truth: BenchTruth, vase_and_bust: StageObject, tmp_path: Path
) -> None:
    folder = tmp_path
    shares: list[float] = []
    first = samples_of(tiny_truth, vase_and_bust, folder, shares.append)
    assert len(shares) > 1
    shares.clear()
    again = samples_of(tiny_truth, vase_and_bust, folder, shares.append)
    assert shares == [1.0]
    np.testing.assert_array_equal(first.gain, again.gain)
    (file,) = folder.glob("*.npz")
    file.write_bytes(b"damaged")
    np.testing.assert_array_equal(samples_of(tiny_truth, vase_and_bust, folder, shares.append).at_px, first.at_px)
