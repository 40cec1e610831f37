"""Gray code and phase shift of other programs from a folder, against OpenCV's own decoder on the same pictures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from controller import api
from tests.controller.optics.capture.test_raw import RGGB, mosaic_of, write_dng

PROJECTOR, CAMERA = (64, 48), (240, 176)  # (width, height)
SOME = 8000
"""Pixels of which OpenCV is asked, one at a time."""
Image = npt.NDArray[np.float64]


def truth() -> Image:
    """(rows, columns, 2): where each camera pixel looks; a turned picture, with a border that is not lit."""
    x, y = np.meshgrid(np.arange(CAMERA[0]), np.arange(CAMERA[1]))
    return np.stack([0.3 * x + 0.03 * y - 4.3, -0.03 * x + 0.31 * y - 0.6], axis=2)


def photographed(shown: npt.NDArray[Any]) -> Image:
    """Light from 0 to 1 of a shown picture: a projector pixel wide at edges, painted, with some light in the room."""
    at = truth().astype(np.float32)
    light = cv2.remap(shown.astype(np.float32) / 255, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderValue=0)
    paint = 0.35 + 0.3 * ((np.arange(CAMERA[0]) // 25) % 2)
    noise = np.random.default_rng(int(shown.sum()) % 1000).normal(0, 0.002, light.shape)
    return np.asarray(np.clip(0.04 + paint * light + noise, 0, 1))


def gray_code() -> tuple[Any, list[npt.NDArray[np.uint8]]]:
    pattern = cv2.structured_light.GrayCodePattern.create(*PROJECTOR)
    _, pictures = pattern.generate()
    return pattern, [np.asarray(picture, np.uint8) for picture in pictures]


def as_colours(light: Image) -> Image:
    return np.repeat(light[..., None], 3, axis=2)


def write_cv(path: Path, light: Image, full: int) -> None:
    whole: npt.NDArray[np.integer] = np.rint(as_colours(light) * full).astype(np.uint8 if full == 255 else np.uint16)
    options = [cv2.IMWRITE_JPEG_QUALITY, 95] if path.suffix == ".jpg" else []
    assert cv2.imwrite(str(path), whole, options)


WRITERS: dict[str, Callable[[Path, Image], object]] = {
    "jpg": lambda path, light: write_cv(path, light, 255),
    "png": lambda path, light: write_cv(path, light, 65535),
    "tiff": lambda path, light: write_cv(path, light, 65535),
    "exr": lambda path, light: api.export(path, as_colours(light).astype(np.float32)),
    "dng": lambda path, light: write_dng(path, mosaic_of(as_colours(light), RGGB)),
}


def write_gray(folder: Path, suffix: str, pictures: list[npt.NDArray[np.uint8]], *, pairs: bool = True) -> str:
    """The photographs, and the tables that describe them."""
    names = []
    for number, picture in enumerate(pictures):
        names.append(f"DSC_{number:03}.{suffix}")
        WRITERS[suffix](folder / names[-1], photographed(picture))
    bits = [names[n : n + 2] if pairs else names[n] for n in range(0, len(names), 2)]
    columns = int(np.ceil(np.log2(PROJECTOR[0])))
    return f"projector_px = {list(PROJECTOR)}\n[gray]\nx = {bits[:columns]}\ny = {bits[columns:]}\n"


def by_opencv(pattern: Any, pictures: list[npt.NDArray[np.uint8]]) -> Image:
    """(rows, columns, 2) as OpenCV decodes the same photographs, NaN where it refuses, and where it was not asked."""
    pattern.setWhiteThreshold(8)
    taken = [np.rint(255 * photographed(picture)).astype(np.uint8) for picture in pictures]
    found = np.full((CAMERA[1], CAMERA[0], 2), np.nan)
    for number in np.random.default_rng(1).permutation(CAMERA[0] * CAMERA[1])[:SOME].tolist():
        y, x = divmod(number, CAMERA[0])
        refused, place = pattern.getProjPixel(taken, x, y)
        if not refused:
            found[y, x] = place
    return found


@pytest.mark.parametrize("suffix", WRITERS)
def test_opencv_finds_the_same_projector_pixels(tmp_path: Path, suffix: str) -> None:
    pattern, pictures = gray_code()
    (tmp_path / "captures.toml").write_text(write_gray(tmp_path, suffix, pictures))
    found = api.decode_folder(tmp_path)
    theirs = by_opencv(pattern, pictures)
    both = found.valid & np.isfinite(theirs).all(axis=2)
    inside = ((truth() > 0.5) & (truth() < np.array(PROJECTOR) - 1.5)).all(axis=2)
    assert both.sum() > 0.6 * SOME * inside.mean()
    assert found.valid[inside].mean() > 0.7
    same = (found.projector_px[both] == theirs[both]).all(axis=1)
    assert same.mean() > 0.99
    # at borders of cells one of the two may take the neighbour
    assert np.abs(found.projector_px[both] - theirs[both]).max() <= 1
    off = found.projector_px - truth()
    assert np.percentile(np.abs(off[found.valid]), 99) < 0.8
    assert not found.valid[(truth() < -1.5).any(axis=2)].any()


def test_bits_without_opposites_are_told_by_black_and_white(tmp_path: Path) -> None:
    _, pictures = gray_code()
    text = write_gray(tmp_path, "png", pictures, pairs=False)
    for name, value in (("black", 0), ("white", 255)):
        WRITERS["png"](tmp_path / f"{name}.png", photographed(np.full((PROJECTOR[1], PROJECTOR[0]), value)))
    (tmp_path / "captures.toml").write_text(text + '[pictures]\nblack = "black.png"\nwhite = "white.png"\n')
    found = api.decode_folder(tmp_path)
    assert found.valid.sum() > 5000
    assert np.percentile(np.abs((found.projector_px - truth())[found.valid]), 99) < 0.8


@pytest.mark.parametrize("shifts", [[0, 90, 180, 270], [30, 170, 260]])
def test_a_phase_shift_measures_inside_the_cells(tmp_path: Path, shifts: list[float]) -> None:
    _, pictures = gray_code()
    text = write_gray(tmp_path, "png", pictures) + "[phase]\n"
    for axis, name in enumerate("xy"):
        place = np.indices((PROJECTOR[1], PROJECTOR[0]))[1 - axis]
        files = []
        for shift in shifts:
            files.append(f"{name}{shift}.png")
            shown = 127.5 + 120 * np.cos(2 * np.pi * place / 16 + np.deg2rad(shift))
            WRITERS["png"](tmp_path / files[-1], photographed(shown))
        text += f"{name} = {{ period_px = 16, files = {files}, phases_deg = {shifts} }}\n"
    (tmp_path / "captures.toml").write_text(text)
    found = api.decode_folder(tmp_path)
    inside = found.valid & ((truth() > 1) & (truth() < np.array(PROJECTOR) - 2)).all(axis=2)
    assert inside.sum() > 5000
    off = (found.projector_px - truth())[inside]
    assert np.sqrt(np.mean(off**2)) < 0.06
    assert found.modulation[inside].min() > 0.5


SIZED = "projector_px = [64, 48]\n"


@pytest.mark.parametrize(
    ("text", "code"),
    [
        (SIZED, "captures-description-wrong"),
        ("[gray]\nx = [['a', 'b']]\ny = [['a', 'b']]", "captures-description-wrong"),
        (SIZED + "[gray]\nx = [['a', 'b']]\ny = [['a', 'b']]", "capture-file-missing"),
        (SIZED + "[gray]\nx = []\ny = []", "captures-description-wrong"),
        (SIZED + "[gray]\nx = [['a', 'b', 'c']]\ny = []", "captures-description-wrong"),
        (SIZED + "[gray]\nx = ['a']\ny = ['b']", "captures-description-wrong"),
        (SIZED + "[gray]\nx = [['a', 'b']]\nz = 1", "captures-description-wrong"),
        (SIZED + "[gray]\ncell_px = 0\nx = [['a', 'b']]", "captures-description-wrong"),
    ],
)
def test_a_wrong_description_of_a_code_is_refused(tmp_path: Path, text: str, code: str) -> None:
    (tmp_path / "captures.toml").write_text(text)
    with pytest.raises(api.VelaturaError) as refused:
        api.decode_folder(tmp_path)
    assert refused.value.code == code


@pytest.mark.parametrize(
    "phase",
    ["x = 3", "x = { period_px = 16, files = ['a', 'b'] }", "x = { period_px = 0, files = ['a', 'b', 'c'] }",
     "x = { period_px = 16, files = ['DSC_000.png', 'DSC_000.png', 'DSC_000.png'], phases_deg = [0, 0, 90] }",
     "x = { period_px = 1, files = ['DSC_000.png', 'DSC_000.png', 'DSC_000.png'] }", "z = 1"],
)  # fmt: skip
def test_a_wrong_phase_shift_is_refused(tmp_path: Path, phase: str) -> None:
    _, pictures = gray_code()
    (tmp_path / "captures.toml").write_text(f"{write_gray(tmp_path, 'png', pictures)}[phase]\n{phase}\n")
    with pytest.raises(api.VelaturaError) as refused:
        api.decode_folder(tmp_path)
    assert refused.value.code == "captures-description-wrong"


def test_pictures_of_different_sizes_are_refused(tmp_path: Path) -> None:
    _, pictures = gray_code()
    (tmp_path / "captures.toml").write_text(write_gray(tmp_path, "png", pictures))
    write_cv(tmp_path / "DSC_003.png", np.zeros((5, 6)), 255)
    with pytest.raises(api.VelaturaError) as refused:
        api.decode_folder(tmp_path)
    assert refused.value.code == "capture-shape-wrong"
