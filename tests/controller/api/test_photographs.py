"""Photographs and folders of captures, as the API reads them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from controller import api
from tests.controller.optics.calibrate.simulator import Scene, photographed, positions
from tests.controller.optics.capture.test_raw import RGGB, mosaic_of, write_dng

SCENE = Scene((132, 100), (64, 48), 1.9, 3.0, seed=3)
EXPOSURE_S = 0.5


def write_captures(folder: Path) -> None:
    """The simulator's photographs as 16-bit TIFF files, named as a camera would, with their description."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = [f"projector_px = [{SCENE.projector_px[0]}, {SCENE.projector_px[1]}]", f"exposure_s = {EXPOSURE_S}"]
    lines.append("[pictures]")
    for number, (name, image) in enumerate(photographed(SCENE).items()):
        file = f"IMG_{number:04}.tiff"
        assert cv2.imwrite(str(folder / file), np.rint(65534 * np.clip(image, 0, 1)).astype(np.uint16)[..., ::-1])
        lines.append(f'{name} = "{file}"')
    (folder / "captures.toml").write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("captures")
    write_captures(made)
    return made


def test_a_raw_file_is_linear_light_with_the_saturated_pixels_unknown(tmp_path: Path) -> None:
    scene = np.full((32, 48, 3), (0.2, 0.4, 0.3))
    scene[:8] = 1.2
    write_dng(tmp_path / "shot.dng", mosaic_of(scene, RGGB))
    found = api.develop(tmp_path / "shot.dng")
    np.testing.assert_allclose(found.image[12:], scene[12:].astype(np.float32), atol=5e-4)
    assert np.isnan(found.image[:6]).all()
    assert found.saturated[:6].all()
    assert found.noise is None
    assert found.bayer is not None
    np.testing.assert_array_equal(found.bayer, RGGB)
    measured = api.CameraProfile(noise=api.CameraNoise(1e-4, 2e-4))
    assert api.develop(tmp_path / "shot.dng", camera=measured).noise == api.CameraNoise(1e-4, 2e-4)


@pytest.mark.parametrize(("name", "dtype", "full"), [("a.png", np.uint8, 255), ("a.tif", np.uint16, 65535)])
def test_plain_pictures_are_taken_as_linear_light(tmp_path: Path, name: str, dtype: type, full: int) -> None:
    values: npt.NDArray[Any] = np.random.default_rng(1).integers(0, full, (5, 6, 3)).astype(dtype)
    values[2, 3, 1] = full
    assert cv2.imwrite(str(tmp_path / name), values[..., ::-1])
    found = api.develop(tmp_path / name)
    assert found.saturated.sum() == 1
    np.testing.assert_array_equal(np.isnan(found.image), values == full)
    known = values < full
    np.testing.assert_allclose(found.image[known], values[known] / full, rtol=1e-6)


def test_what_was_exported_as_exr_is_read_back_exactly(tmp_path: Path) -> None:
    image = np.random.default_rng(2).random((7, 9, 3), np.float32) * 20
    np.testing.assert_array_equal(api.develop(api.export(tmp_path / "a.exr", image)).image, image)


@pytest.mark.parametrize("name", ["gone.dng", "gone.png", "gone.jpg"])
def test_a_file_that_is_not_there_is_named(tmp_path: Path, name: str) -> None:
    with pytest.raises(api.VelaturaError, match=name) as error:
        api.develop(tmp_path / name, camera=api.CameraProfile(response=np.tile(np.linspace(0, 1, 256), (3, 1))))
    assert error.value.code == "photograph-unreadable"


def test_brackets_of_any_number_type_give_the_radiance() -> None:
    radiance = np.random.default_rng(3).uniform(0.1, 3, (6, 7, 3))
    exposures_s = [0.1, 0.5, 2.0]
    images = [np.where(radiance * one < 1, radiance * one, np.nan) for one in exposures_s]
    merged = api.merge_brackets(images, exposures_s)
    np.testing.assert_allclose(merged.radiance, radiance, rtol=1e-5)
    assert np.all(merged.sigma > 0)


def test_a_folder_is_decoded_to_the_positions_that_the_scene_has(folder: Path) -> None:
    captures = api.read_captures(folder)
    assert captures.projector_px == SCENE.projector_px
    np.testing.assert_allclose(
        captures.pictures["white"][20, 30], photographed(SCENE)["white"][20, 30] / EXPOSURE_S, atol=1e-4
    )
    found = api.decode(captures)
    assert found.valid.mean() > 0.5
    error = (found.projector_px - positions(SCENE))[found.valid]
    assert np.sqrt(np.mean(error**2)) < 0.05
    fitted = api.fit_metapixels(captures, found).metapixels
    off = (fitted.centre_px - SCENE.true_centres())[fitted.valid]
    assert np.sqrt(np.mean(off**2)) < 0.1
    measured = api.measure_response(captures)
    np.testing.assert_allclose(measured.mixing, SCENE.mixing, atol=0.02)


def test_a_calibration_predicts_a_photograph_that_it_was_not_made_of(folder: Path) -> None:
    captures = api.read_captures(folder)
    calibration = api.calibrate({"left": captures})
    assert [part.name for part in calibration.projectors] == ["left"]
    transport = api.build_transport(calibration)
    response = calibration.projectors[0].radiometry.response
    shown = api.draw_patterns(SCENE.projector_px, response=response)["random-0"]
    light = np.stack([response[c][shown[..., c]] for c in range(3)], axis=-1).astype(np.float32)
    seen = captures.pictures["random-0"] - captures.pictures["black"]
    difference = (transport.forward([light]) - seen)[transport.object_mask]
    assert np.sqrt(np.mean(difference**2) / np.mean(seen[transport.object_mask] ** 2)) < 0.05


def test_files_named_after_their_patterns_need_only_the_projectors_size(tmp_path: Path) -> None:
    api.export(tmp_path / "black.exr", np.zeros((4, 5, 3), np.float32))
    api.export(tmp_path / "gray-x-0.exr", np.full((4, 5, 3), 0.5, np.float32))
    api.export(tmp_path / "notes.exr", np.ones((4, 5, 3), np.float32))
    found = api.read_captures(tmp_path, projector_px=(64, 48), exposure_s=0.25)
    assert set(found.pictures) == {"black", "gray-x-0"}
    np.testing.assert_array_equal(found.pictures["gray-x-0"], np.full((4, 5, 3), 2, np.float32))


def test_what_says_most_of_light_is_taken_and_nothing_else(tmp_path: Path) -> None:
    light = np.full((4, 5, 3), 0.25, np.float32)
    for name in ("black.exr", "white.exr"):
        api.export(tmp_path / name, light)
    for beside in ("white.JPG", "white.xmp", "white.txt", "black.png", "black.pp3", "._white.exr"):
        (tmp_path / beside).write_bytes(b"no photograph")
    (tmp_path / "gray-x-0.dng").mkdir()
    found = api.read_captures(tmp_path, projector_px=(64, 48))
    assert set(found.pictures) == {"black", "white"}
    np.testing.assert_array_equal(found.pictures["white"], light)


@pytest.mark.parametrize("raw", ["white.DNG", "white.cr3", "white.ARW"])
def test_a_raw_file_goes_before_the_jpeg_beside_it(tmp_path: Path, raw: str) -> None:
    for name in (raw, "white.JPG", "white.tif"):
        (tmp_path / name).write_bytes(b"none")
    with pytest.raises(api.VelaturaError, match=raw):
        api.read_captures(tmp_path, projector_px=(64, 48))


def test_a_description_by_other_editors_is_read_or_told_how_to_save_it(tmp_path: Path) -> None:
    api.export(tmp_path / "black.exr", np.zeros((4, 5, 3), np.float32))
    file = tmp_path / "captures.toml"
    file.write_text("projector_px = [64, 48]\r\n", encoding="utf-8-sig")
    assert api.read_captures(tmp_path).projector_px == (64, 48)
    for encoding in ("utf-16", "latin-1"):
        file.write_text("projector_px = [64, 48] # Gr\xf6\xdfe", encoding=encoding)
        with pytest.raises(api.VelaturaError, match="Save it as UTF-8"):
            api.read_captures(tmp_path)


@pytest.mark.parametrize("seconds", [float("nan"), "1/25", 0.0, -1.0, float("inf"), None, True])
def test_an_exposure_time_that_is_none_is_refused(tmp_path: Path, seconds: Any) -> None:
    light = np.full((4, 5, 3), 0.25, np.float32)
    with pytest.raises(api.VelaturaError) as refused:
        api.merge_brackets([light, light], [0.04, seconds])
    assert refused.value.code == "bracket-mismatch"
    api.export(tmp_path / "white.exr", light)
    if seconds:
        with pytest.raises(api.VelaturaError) as refused:
            api.read_captures(tmp_path, projector_px=(64, 48), pictures={"white": [("white.exr", seconds)]})
        assert refused.value.code == "captures-description-wrong"


def test_numbers_of_files_are_not_taken_for_light() -> None:
    coded = np.full((4, 5, 3), 200, np.uint8)
    with pytest.raises(api.VelaturaError, match="200") as refused:
        api.merge_brackets([coded, coded], [0.1, 0.4])
    assert refused.value.code == "image-not-light"
    captures = api.CaptureSet(dict.fromkeys(api.draw_patterns((64, 48)), coded), (64, 48))  # type: ignore[arg-type]
    with pytest.raises(api.VelaturaError) as refused:
        api.decode(captures)
    assert refused.value.code == "image-not-light"


def test_several_exposures_of_a_pattern_are_merged(tmp_path: Path) -> None:
    api.export(tmp_path / "short.png", np.full((4, 5, 3), 51, np.uint8))
    api.export(tmp_path / "long.png", np.full((4, 5, 3), 255, np.uint8))
    pictures = {"white": [("short.png", 0.1), ("long.png", 1.0)]}
    found = api.read_captures(tmp_path, projector_px=(64, 48), pictures=pictures)
    np.testing.assert_allclose(found.pictures["white"], 2.0, rtol=1e-5)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "projector_px = [64]",
        "projector_px = [64, 48]",
        "projector_px = [64, 48]\nexposure_s = 0",
        "projector_px = [64, 48]\nexposure = 1",
        "projector_px = [64, 48",
        "projector_px = [64, 48]\npictures = 3",
        "projector_px = [64, 48]\n[pictures]\nblack = 3",
        "projector_px = [64, 48]\n[pictures]\nblack = []",
        'projector_px = [64, 48]\n[pictures]\nblack = [{file = "a.png", exposure_s = -1}]',
    ],
)
def test_a_wrong_description_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "captures.toml").write_text(text)
    with pytest.raises(api.VelaturaError) as error:
        api.read_captures(tmp_path)
    assert error.value.code == "captures-description-wrong"


def test_a_file_that_the_description_names_and_the_folder_lacks_is_refused(tmp_path: Path) -> None:
    (tmp_path / "captures.toml").write_text('projector_px = [64, 48]\n[pictures]\nblack = "gone.png"')
    with pytest.raises(api.VelaturaError, match=r"gone\.png") as error:
        api.read_captures(tmp_path)
    assert error.value.code == "capture-file-missing"


def test_no_captures_and_a_dark_projector_are_refused() -> None:
    with pytest.raises(api.VelaturaError, match="No captures were given"):
        api.calibrate({})
    dark = {name: np.zeros_like(image) for name, image in photographed(SCENE).items()}
    with pytest.raises(api.VelaturaError) as error:
        api.calibrate({"left": api.CaptureSet(dark, SCENE.projector_px)})
    assert error.value.code == "projector-dark"


def moved(name: str, image: Any) -> Any:
    return np.roll(image, 1, axis=1) if name.startswith(("phase", "blur")) else image


def colours_exchanged(name: str, image: Any) -> Any:
    return image[..., ::-1] if name.startswith(("mosaic", "phase", "blur")) else image


def overexposed(name: str, image: Any) -> Any:
    return np.where(3 * image < 1, 3 * image, np.nan)


@pytest.mark.parametrize(
    ("change", "size", "code", "words"),
    [
        (moved, SCENE.projector_px, "captures-inconsistent", "camera moved by .* px between white and the sinusoids"),
        (colours_exchanged, SCENE.projector_px, "captures-inconsistent", "red and blue"),
        (overexposed, SCENE.projector_px, "captures-overexposed", "clipped"),
        (lambda name, image: image, SCENE.projector_px[::-1], "projector-size-wrong", "48x64"),
    ],
)
def test_captures_that_cannot_be_right_are_refused_with_their_fault(
    change: Any, size: tuple[int, int], code: str, words: str
) -> None:
    tint = np.array([0.6, 0.9, 1.0], np.float32)
    pictures = {name: change(name, image * tint) for name, image in photographed(SCENE).items()}
    step: Any = api.decode if code == "captures-inconsistent" else api.measure_response
    with pytest.raises(api.VelaturaError, match=words) as error:
        step(api.CaptureSet(pictures, size))
    assert error.value.code == code


def test_a_size_with_as_many_bits_is_refused_because_the_code_goes_beyond_it() -> None:
    scene = Scene((200, 150), (96, 72), 1.9, 3.0, seed=3)
    captures = api.CaptureSet(photographed(scene), (72, 96))
    for step in (api.decode, api.measure_response):
        with pytest.raises(api.VelaturaError, match="72x96") as error:
            step(captures)
        assert error.value.code == "projector-size-wrong"


@pytest.mark.parametrize("exposures_s", [[0.05, 0.2, 0.8], [0.01, 0.0333, 0.07, 0.3, 0.5, 1.9]])
def test_brackets_of_jpegs_give_the_light_that_opencvs_debevec_gives(tmp_path: Path, exposures_s: list[float]) -> None:
    """Both get the same photographs and the same response; light is compared up to one factor."""
    curve = np.linspace(0, 1, 256) ** 2.2
    y, x = np.mgrid[0:60, 0:90]
    # without colours, since OpenCV weighs a sample by the mean of its three channels
    scene = np.repeat(np.exp(x / 34 + y / 30)[..., None], 3, axis=2) / 12
    pictures, files = [], []
    for number, seconds in enumerate(exposures_s):
        picture = np.searchsorted((curve[1:] + curve[:-1]) / 2, np.minimum(scene * seconds, 1)).astype(np.uint8)
        files.append(tmp_path / f"{number}.jpg")
        assert cv2.imwrite(str(files[-1]), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100])
        decoded = cv2.imread(str(files[-1]))
        assert decoded is not None
        pictures.append(decoded)
    camera = api.CameraProfile(response=np.tile(curve, (3, 1)))
    ours = api.merge_brackets([api.develop(file, camera=camera).image for file in files], exposures_s).radiance
    table = np.repeat(np.maximum(curve, 1e-6)[:, None, None], 3, axis=2).astype(np.float32)
    merged = cv2.createMergeDebevec().process(pictures, np.array(exposures_s, np.float32), table)
    theirs = np.asarray(merged, np.float64)[..., ::-1]
    # OpenCV gives a clipped sample a hundredth of the weight of one in the middle, ours none: compare near the middle
    well = np.any([(picture > 80) & (picture < 200) for picture in pictures], axis=0)[..., ::-1] & np.isfinite(ours)
    assert well.mean() > 0.3
    ratio = (ours / theirs)[well]
    assert np.median(np.abs(ratio / np.median(ratio) - 1)) < 0.01
    assert np.percentile(np.abs(ratio / np.median(ratio) - 1), 95) < 0.03
    assert np.percentile(np.abs(ours / scene - 1)[well], 95) < 0.02


@pytest.mark.parametrize("exposures_s", [[0.05, 0.2, 0.8], [0.01, 0.0333, 0.07, 0.3, 0.5, 1.9]])
def test_brackets_in_colour_are_nearer_to_the_truth_than_opencvs_debevec(exposures_s: list[float]) -> None:
    """OpenCV weighs a sample by the mean of its three channels, so it takes over channels that are clipped.

    A channel that OpenCV gets alone has its own weight: then both agree with each other and with the known light.
    """
    curve = np.linspace(0, 1, 256) ** 2.2
    y, x = np.mgrid[0:60, 0:90]
    hue = np.stack([1 + 0.9 * np.cos(x / 17 + 2.1 * channel + y / 23) for channel in range(3)], axis=-1)
    scene = np.exp(x / 34 + y / 30)[..., None] / 12 * hue
    steps = (curve[1:] + curve[:-1]) / 2
    pictures = [np.searchsorted(steps, np.minimum(scene * one, 1)).astype(np.uint8) for one in exposures_s]
    images = [np.where(picture < 255, curve[picture], np.nan) for picture in pictures]
    ours = api.merge_brackets(images, exposures_s).radiance
    table = np.repeat(np.maximum(curve, 1e-6)[:, None, None], 3, axis=2).astype(np.float32)

    def debevec(given: list[npt.NDArray[np.uint8]]) -> npt.NDArray[Any]:
        merged = cv2.createMergeDebevec().process(given, np.array(exposures_s, np.float32), table)
        return np.asarray(merged, np.float64)

    together = debevec(pictures)
    alone = np.stack(
        [debevec([np.repeat(one[..., c : c + 1], 3, axis=2) for one in pictures])[..., 0] for c in range(3)], axis=-1
    )
    well = np.any([(picture > 80) & (picture < 200) for picture in pictures], axis=0) & np.isfinite(ours)
    assert well.mean() > 0.8

    def off(light: npt.NDArray[Any]) -> float:
        """95 % of the pixels are nearer to the truth than this; no factor is taken out."""
        return float(np.percentile(np.abs(light / scene - 1)[well], 95))

    assert off(ours) < 0.008
    assert off(alone) < 0.01
    assert float(np.percentile(np.abs(ours / alone - 1)[well], 95)) < 0.01
    assert off(together) > 0.15, "OpenCV weighs each channel by itself now: compare with its merge in colour, too"
