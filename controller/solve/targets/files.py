"""Target pictures from files, and the photographs that come with scikit-image."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt

from controller.capture.linear_files import Unreadable, read_exr
from controller.core.arrays import FloatImage
from controller.core.errors import UsageError
from controller.core.files import read_picture_bytes
from controller.solve.targets.values import Target, srgb_to_linear

PHOTOGRAPHS: tuple[str, ...] = ("astronaut", "chelsea", "coffee")
_ALLOWED = "EXR, PNG or JPEG"


def load_target(path: Path, size: tuple[int, int]) -> Target:
    """Read a picture as seen from the camera: EXR is taken as linear light, PNG (8 or 16 bit) and JPEG as sRGB.

    An alpha channel becomes the mask. Negative light is set to 0; EXR values above 1 are kept.

    Parameters
    ----------
    size : (width, height) of the camera's picture

    Raises UsageError "target-unreadable", "target-wrong-size", "target-not-finite".
    """
    picture = read_picture(path)
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
        wrong = int(np.count_nonzero(~np.isfinite(picture).all(axis=2)))
        raise UsageError(
            "target-not-finite",
            what=f"{path.name} has {wrong} pixels that are not finite numbers.",
            remedy="Render it again, or replace infinite and undefined pixels.",
        )


def read_picture(path: Path) -> FloatImage:
    """(rows, columns, 3 or 4) float32 linear light of an EXR, PNG or JPEG; UsageError("target-unreadable") if not."""
    if path.suffix.lower() != ".exr":
        return _read_encoded(path)
    try:
        return read_exr(path)
    except Unreadable as error:
        raise _unreadable(path, str(error)) from error


def shipped_photograph(name: Literal["astronaut", "chelsea", "coffee"] = "astronaut") -> FloatImage:
    """(rows, columns, 3) float32 linear light in [0, 1]; from scikit-image's own files, nothing is downloaded."""
    import skimage.data

    if name not in PHOTOGRAPHS:
        raise UsageError(
            "photograph-unknown",
            what=f"The photograph {name!r} is unknown.",
            remedy=f"Choose one of {', '.join(PHOTOGRAPHS)}, or give a file.",
        )
    return srgb_to_linear(np.asarray(getattr(skimage.data, name)()))


def _read_encoded(path: Path) -> FloatImage:
    """(rows, columns, 3 or 4) float32, linear, from PNG or JPEG."""
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
    try:
        decoded: npt.NDArray[Any] | None = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise _unreadable(path, "it could not be decoded") from error
    if decoded is None:
        raise _unreadable(path, "it could not be decoded")
    if decoded.ndim == 2:
        return srgb_to_linear(np.repeat(decoded[..., None], 3, axis=2))
    colour = srgb_to_linear(decoded[..., 2::-1])
    if decoded.shape[2] == 4:
        alpha = decoded[..., 3:].astype(np.float32) / np.float32(np.iinfo(decoded.dtype).max)
        return np.concatenate([colour, alpha], axis=2)
    return colour


def _unreadable(path: Path, why: str) -> UsageError:
    return UsageError(
        "target-unreadable",
        what=f"{path.name} can't be used as a target: {why}.",
        remedy=f"Give an {_ALLOWED} picture as seen from the camera.",
    )
