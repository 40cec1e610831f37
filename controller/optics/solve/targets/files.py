"""Target pictures from files, and the photograph that comes with Velatura."""

from __future__ import annotations

from pathlib import Path
from typing import Final, Literal

import numpy as np

from controller.core import channels
from controller.core.arrays import FloatImage
from controller.core.colour import SPACES, ColourSpace, Primaries, Unsuitable, mixed
from controller.core.errors import UsageError
from controller.core.files import MOST_PIXELS
from controller.core.pictures import KINDS, read_picture_file
from controller.optics.capture.linear_files import exr_chromaticities, read_exr
from controller.optics.solve.targets.values import Target

PHOTOGRAPHS: Final = {"astronaut": Path(__file__).with_name("astronaut.png")}
"""The astronaut Eileen Collins, photographed by NASA: in the public domain (https://flic.kr/p/r9qvLn). sRGB."""


def load_target(path: Path, size: tuple[int, int], colour: ColourSpace | None = None) -> Target:
    """Read a picture as seen from the camera, as ``read_picture``.

    An alpha channel becomes the mask. Negative light is set to 0; EXR values above 1 are kept.

    Parameters
    ----------
    size : (width, height) of the camera's picture

    Raises UsageError "target-unreadable", "target-wrong-size", "target-not-finite".
    """
    picture = read_picture(path, colour)
    height, width = picture.shape[:2]
    check_picture(path, picture, size)
    mask = picture[..., 3] > 0.5 if picture.shape[2] == 4 else np.ones((height, width), dtype=np.bool_)
    return Target(np.maximum(picture[..., :3], 0), mask)


def check_picture(path: Path, picture: FloatImage, size: tuple[int, int]) -> None:
    """Raise UsageError "target-wrong-size" or "target-not-finite" if ``picture``, read from ``path``, is no target."""
    height, width = picture.shape[:2]
    if (width, height) != size:
        raise UsageError(
            "target-wrong-size",
            what=f"{path.name} is {width} x {height} pixels, and the camera's picture is {size[0]} x {size[1]}.",
            remedy=f"Render or scale it to {size[0]} x {size[1]}, as seen from the camera.",
        )
    if not np.isfinite(picture).all():
        wrong = int(np.count_nonzero(~channels.finite(picture)))
        raise UsageError(
            "target-not-finite",
            what=f"{path.name} has {wrong} pixels that are not finite numbers.",
            remedy="Render it again, or replace infinite and undefined pixels.",
        )


def read_picture(path: Path, colour: ColourSpace | None = None, *, soft: bool = False) -> FloatImage:
    """(rows, columns, 3 or 4) float32 linear sRGB light of an EXR, PNG, JPEG, TIFF or WebP, upright.

    ``colour``: the file's colour space; None: what the file says (an ICC profile, chromaticities, ...), else sRGB.
    An EXR is linear light. The fourth channel, where there is transparency, is 1 or 0, or ``soft``: as in the file; at
    0 the light is 0.

    Raises UsageError("target-unreadable").
    """
    return read_large_picture(path, colour, soft=soft)[0]


def read_large_picture(
    path: Path, colour: ColourSpace | None = None, least_px: tuple[int, int] | None = None, *, soft: bool = False
) -> tuple[FloatImage, int]:
    """As ``read_picture``, and by how many times it was made smaller: a whole number, as long as it covers ``least_px``
    (width, height); 1 without that. Each pixel is the mean light of those that it stands for; an EXR stays as it is.
    """
    by = 1
    try:
        if path.suffix.lower() == ".exr":
            light, alpha = _read_exr(path, colour)
        else:
            if colour is not None and SPACES[colour].curve == "none":
                raise Unsuitable(f"{colour} is linear light, which only an EXR file can hold")
            picture = read_picture_file(path)
            height, width = picture.values.shape[:2]
            by = max(1, min(width // least_px[0], height // least_px[1])) if least_px else 1
            light, alpha = picture.averaged(SPACES[colour] if colour else None, by), picture.opacity(by)
    except Unsuitable as error:
        raise unreadable(path, error) from error
    if alpha is None:
        return light, by
    opaque = alpha if soft else alpha > 0.5
    return np.dstack([np.where(opaque[..., None] > 0, light, 0), opaque]).astype(np.float32), by


def unreadable(path: Path, why: Unsuitable) -> UsageError:
    """The error of a picture that can't be a target."""
    return UsageError(
        "target-unreadable",
        what=f"{path.name} can't be used as a target: {why}.",
        remedy=f"Give an EXR, {KINDS} picture of at most {MOST_PIXELS // 1_000_000} million pixels.",
    )


def _read_exr(path: Path, colour: ColourSpace | None) -> tuple[FloatImage, FloatImage | None]:
    picture = read_exr(path)
    light, alpha = picture[..., :3], None
    if picture.shape[2] == 4:
        alpha = np.clip(picture[..., 3], 0, 1)
        light = np.asarray(light / np.clip(alpha, 1e-3, 1)[..., None], np.float32)  # EXR's alpha is premultiplied
    said = exr_chromaticities(path) if colour is None else None
    if said is None:
        return mixed(light, SPACES[colour or "srgb"]), alpha
    red, green, blue, white = ((said[n], said[n + 1]) for n in (0, 2, 4, 6))
    return mixed(light, Primaries(red, green, blue, white)), alpha


def shipped_photograph(name: Literal["astronaut"] = "astronaut") -> FloatImage:
    """(512, 512, 3) float32 linear light in [0, 1] of the photograph that comes with Velatura."""
    return read_picture(PHOTOGRAPHS[name], "srgb")
