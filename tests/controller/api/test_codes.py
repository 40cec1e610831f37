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


@pytest.mark.parametrize("axis", ["x", "y"])
def test_where_one_of_the_two_codes_does_not_reach_nothing_is_valid(tmp_path: Path, axis: str) -> None:
    """A visitor stands in a part of the picture while one of the codes is photographed."""
    _, pictures = gray_code()
    text, columns = write_gray(tmp_path, "png", pictures), 2 * int(np.ceil(np.log2(PROJECTOR[0])))
    hidden = np.s_[60:100, 70:130]
    for number in range(columns) if axis == "x" else range(columns, len(pictures)):
        light = photographed(pictures[number])
        light[hidden] = 0.2 + np.random.default_rng(number).normal(0, 0.002, light[hidden].shape)
        WRITERS["png"](tmp_path / f"DSC_{number:03}.png", light)
    (tmp_path / "captures.toml").write_text(text)
    found = api.decode_folder(tmp_path)
    assert not found.valid[hidden].any()
    assert found.valid[110:150, 70:130].mean() > 0.7


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
        ("projector_px = [2, 2]\n[gray]\nx = [['a', 'b']]\ny = [['a', 'b']]", "capture-file-missing"),
        (SIZED + "[gray]\nx = [['a', 'b']]\ny = [['a', 'b']]", "captures-description-wrong"),
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


WIDE = (120, 90)
BITS = 7
"""Of each axis of ``WIDE``."""
Files = list[list[str]]


def looked_at() -> Image:
    x, y = np.meshgrid(np.arange(CAMERA[0]), np.arange(CAMERA[1]))
    return np.stack([0.48 * x + 0.03 * y - 2.3 + 3 * np.sin(x / 20), -0.03 * x + 0.5 * y + 0.4], axis=2)


def seen(shown: npt.NDArray[Any], number: int, *, moved_px: float = 0.0, bright: float = 1.0) -> Image:
    """Photograph ``number`` on a painted, chequered wall, with noise of its own."""
    at = looked_at().astype(np.float32)
    light = cv2.remap(shown.astype(np.float32) / 255, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderValue=0)
    rows, columns = np.indices(light.shape)
    light = 0.04 + bright * (0.2 + 0.5 * ((rows // 25 + columns // 25) % 2)) * light
    if moved_px:
        shift = np.array([[1, 0, moved_px], [0, 1, 0]], np.float64)
        light = cv2.warpAffine(light, shift, CAMERA, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(light + np.random.default_rng(number).normal(0, 0.002, light.shape))


def wide_code(size: tuple[int, int] = WIDE) -> list[npt.NDArray[np.uint8]]:
    return [np.asarray(one, np.uint8) for one in cv2.structured_light.GrayCodePattern.create(*size).generate()[1]]


def folder_of(folder: Path, photographs: list[Image], x: Any = None, y: Any = None, more: str = "") -> Path:
    """``x`` and ``y`` change the lists of the files."""
    pairs: Files = []
    for number, light in enumerate(photographs):
        write_cv(folder / f"{number}.png", np.clip(light, 0, 1), 65535)
        pairs.append([f"{number - 1}.png", f"{number}.png"])
    lists = pairs[1 : 2 * BITS : 2], pairs[2 * BITS + 1 :: 2]
    x, y = (change(*lists) if change else own for change, own in zip((x, y), lists, strict=True))
    (folder / "captures.toml").write_text(f"projector_px = {list(WIDE)}\n[gray]\nx = {x}\ny = {y}\n{more}")
    return folder


def turned(files: Files, *bits: int) -> Files:
    return [row[::-1] if number in bits else row for number, row in enumerate(files)]


@pytest.mark.parametrize(
    ("x", "y", "words"),
    [
        *[(lambda x, y, k=k: turned(x, k), None, f"opposite of bit {k + 1} are exchanged") for k in range(1, BITS)],
        (lambda x, y: turned(x, 0), None, "mirrored"),
        (None, lambda x, y: turned(y, 0), "mirrored"),
        (None, lambda x, y: turned(y, 3), "code of y jumps .* bit 4 are exchanged"),
        (lambda x, y: turned(x, *range(BITS)), None, "all pictures and opposites are exchanged"),
        (lambda x, y: x[::-1], lambda x, y: y[::-1], "begin with the finest"),
        (lambda x, y: [x[1], x[0], *x[2:]], None, "bits 1 and 2 are exchanged"),
        (lambda x, y: y, lambda x, y: x, "x and y seem to be exchanged"),
        (lambda x, y: x[1:], None, "6 bits of x are 64 cells"),
        (lambda x, y: [*x[:2], [x[2][0], x[2][0]], *x[3:]], None, "bit 3 of x and its opposite show the same"),
    ],
)
def test_a_wrong_order_of_the_pictures_of_a_code_is_named(tmp_path: Path, x: Any, y: Any, words: str) -> None:
    folder = folder_of(tmp_path, [seen(one, number) for number, one in enumerate(wide_code())], x, y)
    with pytest.raises(api.VelaturaError, match=words):
        api.decode_folder(folder)


@pytest.mark.parametrize(
    ("late_from", "moved_px", "change", "words"),
    [
        (5, 0.0, 1.0, "camera was late"),
        (4, 0.0, 1.0, "do not add up to the same light"),
        (99, 1.0, 1.0, "moved by 1.0 px between"),
        (99, 3.0, 1.0, "moved by 3.0 px between"),
        (99, 0.0, 0.6, "do not add up to the same light"),
    ],
)
def test_a_camera_that_was_late_moved_or_changed_its_exposure_is_named(
    tmp_path: Path, late_from: int, moved_px: float, change: float, words: str
) -> None:
    code, photographs = wide_code(), []
    for number in range(len(code)):
        later = number >= 2 * BITS
        shown = code[number - (number >= late_from)]
        bright = change if number % 4 > 1 else 1.0
        photographs.append(seen(shown, number, moved_px=moved_px * later, bright=bright))
    with pytest.raises(api.VelaturaError, match=words) as refused:
        api.decode_folder(folder_of(tmp_path, photographs))
    assert refused.value.code == "captures-inconsistent"


def test_a_code_centred_in_its_power_of_two_is_noticed_and_decoded_by_its_offset(tmp_path: Path) -> None:
    code = [one[19 : 19 + WIDE[1], 4 : 4 + WIDE[0]] for one in wide_code((128, 128))]
    folder = folder_of(tmp_path, [seen(one, number) for number, one in enumerate(code)])
    with pytest.raises(api.VelaturaError) as refused:
        api.decode_folder(folder)
    assert "offset_px" in refused.value.remedy
    with (folder / "captures.toml").open("a") as file:
        file.write("offset_px = [4, 19]\n")
    found = api.decode_folder(folder)
    assert found.valid.mean() > 0.9
    assert np.abs(found.projector_px - looked_at())[found.valid].max() < 1.2


def test_a_picture_in_a_mirror_is_decoded_where_the_description_says_so(tmp_path: Path) -> None:
    photographs = [seen(one, number)[:, ::-1] for number, one in enumerate(wide_code())]
    found = api.decode_folder(folder_of(tmp_path, photographs, more="mirrored = true\n"))
    assert found.valid.mean() > 0.9


def test_noise_alone_is_nowhere_valid(tmp_path: Path) -> None:
    random = np.random.default_rng(4)
    dark = [random.normal(0.02, 0.003, CAMERA[::-1]) for _ in range(4 * BITS)]
    assert not api.decode_folder(folder_of(tmp_path, dark)).valid.any()


def test_a_clipped_colour_drops_only_itself(tmp_path: Path) -> None:
    """Light in the room clips red in half of the picture. The other colours of the pixels still tell the code."""
    photographs = [seen(one, number) for number, one in enumerate(wide_code())]
    folder = folder_of(tmp_path, photographs)
    for number, light in enumerate(photographs):
        colours = np.rint(np.clip(as_colours(light), 0, 1) * 65535).astype(np.uint16)
        colours[:, : CAMERA[0] // 2, 2] = 65535
        cv2.imwrite(str(folder / f"{number}.png"), colours)
    found = api.decode_folder(folder)
    assert found.valid.mean() > 0.9
    assert np.abs(found.projector_px - looked_at())[found.valid].max() < 1.2


def test_clipped_sinusoids_are_not_measured(tmp_path: Path) -> None:
    """Where white would be clipped, a phase from clipped steps is a third of a pixel off."""
    code = [seen(one, number, bright=0.8) for number, one in enumerate(wide_code())]
    text, photographs = "[phase]\n", list[Image]()
    for axis, name in enumerate("xy"):
        place = np.indices(WIDE[::-1])[1 - axis]
        files = [f"{len(code) + len(photographs) + shift}.png" for shift in range(4)]
        for shift in range(4):
            shown = 127.5 + 127.5 * np.cos(2 * np.pi * place / 16 + shift * np.pi / 2)
            photographs.append(seen(shown, shift, bright=1.8))
        text += f"{name} = {{ period_px = 16, files = {files} }}\n"
    folder = folder_of(tmp_path, code, more=text)
    for number, light in enumerate(photographs, len(code)):
        write_cv(folder / f"{number}.png", np.clip(light, 0, 1), 65535)
    found = api.decode_folder(folder)
    off = np.abs(found.projector_px - looked_at())[found.valid & (looked_at() > 2).all(axis=2)]
    assert found.valid.mean() > 0.4
    assert np.percentile(off, 99.9) < 0.25


def test_noisy_pictures_of_8_bits_give_what_opencv_finds_and_more_that_agrees_with_it(tmp_path: Path) -> None:
    """Dark paint beside bright paint. What is taken beside OpenCV's pixels fits to the pixels around it."""
    taken = []
    for number, one in enumerate(wide_code()):
        light = 0.02 + 0.6 * (seen(cv2.GaussianBlur(one, (0, 0), 0.5), number) - 0.04)
        light[:, 150:] *= 0.15
        taken.append(np.clip(light + np.random.default_rng(99 + number).normal(0, 0.004, light.shape), 0, 1))
    folder = folder_of(tmp_path, [])
    folder_of(folder, taken)
    for number, light in enumerate(taken):
        write_cv(folder / f"{number}.png", light, 255)
    found = api.decode_folder(folder)
    pattern = cv2.structured_light.GrayCodePattern.create(*WIDE)
    pattern.setWhiteThreshold(5)
    whole, theirs = [np.rint(255 * one).astype(np.uint8) for one in taken], np.full((*CAMERA[::-1], 2), np.nan)
    for y in range(20, 150, 3):
        for x in range(20, 220, 3):
            refused, place = pattern.getProjPixel(whole, x, y)
            if not refused:
                theirs[y, x] = place
    both = np.isfinite(theirs).all(axis=2)
    assert both.sum() > 1000
    assert found.valid[both].mean() >= 0.98
    assert (found.projector_px[both & found.valid] == theirs[both & found.valid]).all()
    assert found.valid[20:150, 160:].mean() > 0.5
    assert np.mean(np.abs(found.projector_px - looked_at())[found.valid].max(axis=1) > 2) < 0.01
