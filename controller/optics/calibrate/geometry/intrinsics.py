"""What is known of the camera's lens, kept in a file beside stage.toml: from a ChArUco session, or from EXIF."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from controller.core.arrays import Float64
from controller.core.errors import UsageError
from controller.core.files import read_bytes
from controller.core.storage import write_atomically
from controller.optics.calibrate.geometry.values import CameraPrior, MeasuredDistance

FILE: Final = "camera-intrinsics.toml"
PARAMETERS: Final = ("log_focal", "cx_px", "cy_px", "k1")
LARGEST_BYTES: Final = 1 << 16


@dataclass(frozen=True, slots=True)
class CameraIntrinsics:
    """A camera's lens in pixels of its full picture, square pixels.

    ``size_px`` (width, height); ``focal_px``; ``centre_px`` (x, y) of the principal point; ``k1`` radial distortion
    ``covariance`` (4, 4) of ``PARAMETERS``: log focal length, principal point in pixels, k1
    ``method`` "charuco" or "exif"; ``rms_px`` of a session's corners, 0 for EXIF; ``views``: photographs that count
    """

    size_px: tuple[int, int]
    focal_px: float
    centre_px: tuple[float, float]
    k1: float
    covariance: Float64
    method: Literal["charuco", "exif"]
    rms_px: float = 0.0
    views: int = 0

    @property
    def sigmas(self) -> Float64:
        """(4,) standard deviations of ``PARAMETERS``."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def prior(
        self,
        *,
        distance_m: float | None = None,
        distance_rel_sigma: float = 0.01,
        distances: tuple[MeasuredDistance, ...] = (),
    ) -> CameraPrior:
        """What the geometry starts from, and what else was measured."""
        focal, cx, cy, k1 = (float(sigma) for sigma in self.sigmas)
        return CameraPrior(
            focal_length_px=self.focal_px,
            focal_length_rel_sigma=focal,
            principal_point_px=self.centre_px,
            principal_point_sigma_px=max(cx, cy),
            distortion_k1=self.k1,
            distortion_sigma=k1,
            distance_m=distance_m,
            distance_rel_sigma=distance_rel_sigma,
            distances=distances,
            size_px=self.size_px,
        )


def write_intrinsics(path: Path, found: CameraIntrinsics) -> None:
    """Write as TOML, atomically. Raises WorkError("no-space", "cannot-write")."""
    rows = ",\n".join("    [" + ", ".join(f"{value!r}" for value in row) + "]" for row in found.covariance.tolist())
    sigmas = found.sigmas
    text = f"""\
# A camera's lens, as Velatura measured it; stage.toml names this file in [camera] as intrinsics.
method = "{found.method}"
width_px = {found.size_px[0]}
height_px = {found.size_px[1]}
focal_length_px = {found.focal_px!r}  # +- {100 * sigmas[0]:.2g} %
principal_point_px = [{found.centre_px[0]!r}, {found.centre_px[1]!r}]  # +- {sigmas[1]:.2g}, {sigmas[2]:.2g} px
distortion_k1 = {found.k1!r}  # +- {sigmas[3]:.2g}
rms_px = {found.rms_px!r}
views = {found.views}
# of the focal length's logarithm, the principal point in pixels, and k1
covariance = [
{rows},
]
"""
    write_atomically(path, text.encode())


def read_intrinsics(path: Path) -> CameraIntrinsics:
    """Read what ``write_intrinsics`` wrote, or a person did.

    Raises UsageError("camera-intrinsics-missing", "camera-intrinsics-unreadable", "camera-intrinsics-invalid").
    """
    try:
        data = read_bytes(path, LARGEST_BYTES)
    except FileNotFoundError as error:
        raise UsageError(
            "camera-intrinsics-missing",
            what=f"There is no {path}.",
            remedy="Make it with `velatura camera calibrate` from photographs of the board, or give focal_length_px.",
        ) from error
    except OSError as error:
        raise _unreadable(path, str(error.strerror)) from error
    try:
        content = tomllib.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise _unreadable(path, str(error)) from error
    return _checked(path, content)


def _unreadable(path: Path, reason: str) -> UsageError:
    return UsageError(
        "camera-intrinsics-unreadable",
        what=f"{path.name} can't be read ({reason}).",
        remedy="Make it again with `velatura camera calibrate`.",
    )


def _checked(path: Path, content: Mapping[str, Any]) -> CameraIntrinsics:
    def invalid(key: str, allowed: str) -> UsageError:
        return UsageError(
            "camera-intrinsics-invalid",
            what=f"{path.name}: {key} must be {allowed}.",
            remedy="Correct it, or make the file again with `velatura camera calibrate`.",
        )

    def numbers(key: str, count: int, value: Any) -> list[float]:
        if not (isinstance(value, list) and len(value) == count):
            raise invalid(key, f"a list of {count} numbers")
        return [number(key, item) for item in value]

    def number(key: str, value: Any, low: float = -math.inf) -> float:
        # a bool is an int to Python, not to TOML
        if isinstance(value, bool) or not isinstance(value, int | float) or not low < value < math.inf:
            raise invalid(key, "a finite number" if low == -math.inf else f"a number above {low:g}")
        return float(value)

    width, height = (number(key, content.get(key), 0.0) for key in ("width_px", "height_px"))
    x, y = numbers("principal_point_px", 2, content.get("principal_point_px"))
    rows = content.get("covariance")
    if not (isinstance(rows, list) and len(rows) == len(PARAMETERS)):
        raise invalid("covariance", "four lists of four numbers")
    covariance = np.array([numbers("covariance", len(PARAMETERS), row) for row in rows])
    if not np.allclose(covariance, covariance.T) or np.linalg.eigvalsh(covariance).min() <= 0:
        raise invalid("covariance", "symmetric and positive definite")
    method: Literal["charuco", "exif"] = "exif" if content.get("method") == "exif" else "charuco"
    return CameraIntrinsics(
        size_px=(int(width), int(height)),
        focal_px=number("focal_length_px", content.get("focal_length_px"), 0.0),
        centre_px=(x, y),
        k1=number("distortion_k1", content.get("distortion_k1", 0.0)),
        covariance=covariance,
        method=method,
        rms_px=number("rms_px", content.get("rms_px", 0.0)),
        views=int(number("views", content.get("views", 0))),
    )
