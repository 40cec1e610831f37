"""Target pictures from files, and the photograph that comes with Velatura."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final, Literal

import cv2
import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import FloatImage
from controller.core.errors import UsageError
from controller.core.files import read_picture_bytes
from controller.optics.capture.linear_files import Unreadable, exr_chromaticities, read_exr
from controller.optics.solve.targets.colour import (
    SPACES,
    ColourSpace,
    Primaries,
    Profile,
    Unsuitable,
    decoded,
    embedded_profile,
    read_profile,
)
from controller.optics.solve.targets.values import Target

PHOTOGRAPHS: Final = {"astronaut": Path(__file__).with_name("astronaut.png")}
"""The astronaut Eileen Collins, photographed by NASA: in the public domain (https://flic.kr/p/r9qvLn). sRGB."""
_ALLOWED = "EXR, PNG or JPEG"


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
    image = np.where(mask[..., None], np.maximum(picture[..., :3], 0), 0).astype(np.float32)
    return Target(image, mask)


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


def read_picture(path: Path, colour: ColourSpace | None = None) -> FloatImage:
    """(rows, columns, 3 or 4) float32 linear sRGB light of an EXR, PNG (8 or 16 bit) or JPEG.

    ``colour``: the file's colour space; None: what the file says (an ICC profile, chromaticities of an EXR), else sRGB.
    An EXR is linear light.

    Raises UsageError("target-unreadable").
    """
    try:
        return _read_encoded(path, colour) if path.suffix.lower() != ".exr" else _read_light(path, colour)
    except (Unreadable, Unsuitable) as error:
        raise _unreadable(path, str(error)) from error


def _read_light(path: Path, colour: ColourSpace | None) -> FloatImage:
    picture = read_exr(path)
    said = exr_chromaticities(path) if colour is None else None
    if said is not None:
        red, green, blue, white = ((said[n], said[n + 1]) for n in (0, 2, 4, 6))
        space = Primaries(red, green, blue, white)
    else:
        space = SPACES[colour or "srgb"]
    try:
        return _with_alpha(decoded(picture[..., :3], space), picture[..., 3:])
    except (np.linalg.LinAlgError, ZeroDivisionError) as error:
        raise Unsuitable("its chromaticities are no colours") from error


def shipped_photograph(name: Literal["astronaut"] = "astronaut") -> FloatImage:
    """(512, 512, 3) float32 linear light in [0, 1] of the photograph that comes with Velatura."""
    return read_picture(PHOTOGRAPHS[name], "srgb")


def _read_encoded(path: Path, colour: ColourSpace | None) -> FloatImage:
    """(rows, columns, 3 or 4) float32, linear, from PNG or JPEG."""
    if colour is not None and SPACES[colour].curve == "none":
        raise Unsuitable(f"{colour} is linear light, which only an EXR file can hold")
    try:
        data = read_picture_bytes(path)
    except OSError as error:
        raise _unreadable(path, f"it can't be read: {error.strerror}") from error
    jpeg = data.startswith(b"\xff\xd8\xff")
    if not jpeg and not data.startswith(b"\x89PNG\r\n\x1a\n"):
        raise _unreadable(path, f"it is not an {_ALLOWED} file")
    # decoders fill missing parts with grey and only print a warning
    if (jpeg and b"\xff\xd9" not in data[-4096:]) or (not jpeg and b"IEND" not in data[-4096:]):
        raise _unreadable(path, "its end is missing")
    embedded = embedded_profile(data)
    source = SPACES[colour] if colour else read_profile(embedded) if embedded else SPACES["srgb"]
    try:
        picture: npt.NDArray[Any] | None = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise _unreadable(path, "it could not be decoded") from error
    if picture is None:
        raise _unreadable(path, "it could not be decoded")
    if picture.ndim == 2:
        return _linear(np.repeat(picture[..., None], 3, axis=2), source)
    alpha = picture[..., 3:].astype(np.float32) / np.float32(np.iinfo(picture.dtype).max)
    return _with_alpha(_linear(picture[..., 2::-1], source), alpha)


def _linear(values: npt.NDArray[Any], source: Primaries | Profile) -> FloatImage:
    return source.decoded(values) if isinstance(source, Profile) else decoded(values, source)


def _with_alpha(light: FloatImage, alpha: FloatImage) -> FloatImage:
    return np.concatenate([light, alpha], axis=2) if alpha.shape[2] else light


def _unreadable(path: Path, why: str) -> UsageError:
    return UsageError(
        "target-unreadable",
        what=f"{path.name} can't be used as a target: {why}.",
        remedy=f"Give an {_ALLOWED} picture as seen from the camera.",
    )
