"""What is known of the camera's lens, kept in a file beside stage.toml: from a ChArUco session, or from EXIF."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import cv2
import numpy as np

from controller.core.arrays import Float64
from controller.core.errors import UsageError
from controller.core.files import read_bytes
from controller.core.storage import write_atomically
from controller.optics.calibrate.geometry.values import CameraPrior, MeasuredDistance
from controller.optics.calibrate.values import Pinhole

FILE: Final = "camera-intrinsics.toml"
PARAMETERS: Final = ("log_focal", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "log_fy_by_fx")
OTHER_KEYS: Final = ("distortion_k2", "distortion_p1", "distortion_p2", "log_fy_by_fx")
LARGEST_BYTES: Final = 1 << 16


@dataclass(frozen=True, slots=True)
class CameraIntrinsics:
    """A camera's lens in pixels of its full picture.

    ``size_px`` (width, height); ``focal_px``; ``centre_px`` (x, y) of the principal point; ``k1`` radial distortion
    ``covariance`` (4, 4) or (8, 8) of the first ``PARAMETERS``, the principal point in pixels
    ``method`` "charuco" or "exif"; ``rms_px`` of a session's corners, 0 for EXIF; ``views``: photographs that count
    ``other_terms``: k2, p1, p2 as OpenCV counts them, and log fy/fx; all 0 where one focal length and k1 suffice
    """

    size_px: tuple[int, int]
    focal_px: float
    centre_px: tuple[float, float]
    k1: float
    covariance: Float64
    method: Literal["charuco", "exif"]
    rms_px: float = 0.0
    views: int = 0
    other_terms: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)

    @property
    def sigmas(self) -> Float64:
        """(4,) or (8,) standard deviations of ``PARAMETERS``."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def prior(
        self,
        *,
        distance_m: float | None = None,
        distance_rel_sigma: float = 0.01,
        distances: tuple[MeasuredDistance, ...] = (),
    ) -> CameraPrior:
        """What the geometry starts from, and what else was measured."""
        focal, cx, cy, k1 = (float(sigma) for sigma in self.sigmas[:4])
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
            other_terms=self.other_terms,
        )


def write_intrinsics(path: Path, found: CameraIntrinsics) -> None:
    """Write as TOML, atomically. Raises WorkError("no-space", "cannot-write")."""
    rows = ",\n".join("    [" + ", ".join(f"{value!r}" for value in row) + "]" for row in found.covariance.tolist())
    sigmas, more = found.sigmas, ""
    if len(sigmas) == len(PARAMETERS):
        values = zip(OTHER_KEYS, found.other_terms, sigmas[4:], strict=True)
        more = "".join(f"{key} = {value!r}  # +- {sigma:.2g}\n" for key, value, sigma in values)
    text = f"""\
# A camera's lens, as Velatura measured it; stage.toml names this file in [camera] as intrinsics.
method = "{found.method}"
width_px = {found.size_px[0]}
height_px = {found.size_px[1]}
focal_length_px = {found.focal_px!r}  # +- {100 * sigmas[0]:.2g} %
principal_point_px = [{found.centre_px[0]!r}, {found.centre_px[1]!r}]  # +- {sigmas[1]:.2g}, {sigmas[2]:.2g} px
distortion_k1 = {found.k1!r}  # +- {sigmas[3]:.2g}
{more}rms_px = {found.rms_px!r}
views = {found.views}
# of {", ".join(PARAMETERS[: len(sigmas)])}
covariance = [
{rows},
]
"""
    write_atomically(path, text.encode())


def read_intrinsics(path: Path) -> CameraIntrinsics:
    """Read what ``write_intrinsics`` wrote, or a person or another program did.

    OpenCV's YAML, XML and JSON, ROS's YAML and COLMAP's cameras.txt are read. A lens with more terms is replaced by the
    one with k1, k2, p1 and p2 that comes nearest over the picture, and what is left over widens the covariance.

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
        text = data.decode("utf-8-sig")
        if path.suffix.lower() in (".txt", ".yml", ".yaml", ".xml", ".json"):
            return _simplified(path, *(_of_colmap(text) if path.suffix.lower() == ".txt" else _of_opencv(text)))
        content = tomllib.loads(text)
    except (ValueError, RecursionError, SystemError, cv2.error) as error:
        raise _unreadable(path, str(error)) from error
    return _checked(path, content)


def _unreadable(path: Path, reason: str) -> UsageError:
    return UsageError(
        "camera-intrinsics-unreadable",
        what=f"{path.name} can't be read ({reason}).",
        remedy="Make it with `velatura camera calibrate`, or give a lens file of OpenCV, ROS or COLMAP as it is.",
    )


def _of_opencv(text: str) -> tuple[tuple[int, int], Float64, Float64]:
    """Size, (3, 3) matrix and (4,) to (14,) distortion of OpenCV's or ROS's file. Raises ValueError or cv2.error."""
    if not text.lstrip().startswith(("%YAML", "<", "{")):
        text = "%YAML:1.0\n---\n" + text
    file = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)

    def node(*names: str) -> Any:
        return next((file.getNode(name) for name in names if not file.getNode(name).empty()), None)

    def numbers(where: Any) -> Float64:
        data = None if where is None else where.getNode("data") if where.isMap() else where
        if data is None or data.empty():
            raise ValueError("it has no image_width, image_height, camera_matrix or distortion_coefficients")
        rows = [data.at(n) for n in range(data.size())]
        cells = [one for row in rows for one in ([row.at(n) for n in range(row.size())] if row.isSeq() else [row])]
        return np.array([cell.real() for cell in cells], np.float64)

    model = node("distortion_model")
    if model is not None and model.string() not in ("plumb_bob", "rational_polynomial"):
        raise ValueError(f"its lens model {model.string()} is not known here")
    size = [node(name, name.title().replace("I", "i", 1)) for name in ("image_width", "image_height")]
    matrix = numbers(node("camera_matrix", "cameraMatrix", "Camera_Matrix", "K"))
    bent = numbers(node("distortion_coefficients", "distCoeffs", "dist_coeffs", "Distortion_Coefficients", "D"))
    if matrix.size != 9 or bent.size not in (4, 5, 8, 12, 14) or None in size:
        raise ValueError("it needs image_width, image_height, a 3x3 camera_matrix and 4 to 14 distortion_coefficients")
    width, height = (int(one.real()) for one in size)
    return (width, height), matrix.reshape(3, 3), bent


COLMAP: Final = {
    "SIMPLE_PINHOLE": "f cx cy", "PINHOLE": "fx fy cx cy", "SIMPLE_RADIAL": "f cx cy k1", "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2", "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
}  # fmt: skip


def _of_colmap(text: str) -> tuple[tuple[int, int], Float64, Float64]:
    """As ``_of_opencv``, of the one camera in COLMAP's cameras.txt, where a pixel's middle is at a half."""
    lines = [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if len(lines) != 1 or len(lines[0]) < 4 or lines[0][1] not in COLMAP:
        raise ValueError(f"it is no list of one camera with a model of {', '.join(COLMAP)}")
    names = COLMAP[lines[0][1]].split()
    has = dict(zip(names, map(float, lines[0][4:]), strict=True))
    fx, fy = has.get("fx", has.get("f", 0.0)), has.get("fy", has.get("f", 0.0))
    matrix = np.array([[fx, 0, has["cx"] - 0.5], [0, fy, has["cy"] - 0.5], [0, 0, 1]])
    bent = np.array([has.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")])
    return (int(lines[0][2]), int(lines[0][3])), matrix, bent


LARGEST_MISFIT_PX: Final = 2.0
LEAST_SIGMAS: Final = (2e-3, 2.0, 2.0, 5e-3, 5e-3, 5e-4, 5e-4, 1e-4)
"""Of ``PARAMETERS``, where another program does not say how sure it is."""


def _simplified(path: Path, size_px: tuple[int, int], matrix: Float64, bent: Float64) -> CameraIntrinsics:
    """The nearest lens with k1, k2, p1 and p2 alone, by linear least squares over the picture."""
    width, height = size_px
    seen = np.stack(np.meshgrid(np.linspace(0, width - 1, 17), np.linspace(0, height - 1, 13)), axis=2).reshape(-1, 2)
    if min(width, height, matrix[0, 0], matrix[1, 1]) <= 0 or not np.isfinite([*matrix.ravel(), *bent]).all():
        raise ValueError("its size or focal length is not above zero")
    if matrix[0, 1]:
        raise ValueError("its camera_matrix is skew")
    aspect = float(matrix[1, 1] / matrix[0, 0])
    x, y = Pinhole(matrix, bent, np.eye(3), np.zeros(3), size_px).rays(seen).T
    r2, one, zero = x**2 + y**2, np.ones(len(x)), np.zeros(len(x))
    across = np.stack([x, one, zero, x * r2, x * r2**2, 2 * x * y, r2 + 2 * x**2], axis=1)
    down = np.stack([y, zero, one, y * r2, y * r2**2, r2 + 2 * y**2, 2 * x * y], axis=1)
    rows, wanted = np.concatenate([across, down]), np.concatenate([seen[:, 0], seen[:, 1] / aspect])
    solved = np.linalg.lstsq(rows, wanted, rcond=None)[0]
    misfit = float(np.sqrt(np.mean((rows @ solved - wanted) ** 2)))
    if not misfit < LARGEST_MISFIT_PX:
        raise UsageError(
            "camera-lens-unlike",
            what=f"k1, k2 and tangential distortion do not explain the lens in {path.name}: they are off by "
            f"{misfit:.1f} px.",
            remedy="Measure the lens with `velatura camera calibrate`, or write focal_length_px into stage.toml.",
        )
    focal, cx, cy = (float(value) for value in solved[:3])
    k1, k2, p1, p2 = (float(value) for value in solved[3:] / focal)
    spread = np.append(np.sqrt(np.diag(np.linalg.inv(rows.T @ rows))) * misfit * np.sqrt(len(rows)), 0.0)
    spread[[0, 3, 4, 5, 6]] /= focal
    other = (k2, p1, p2, float(np.log(aspect)))
    covariance = np.diag(np.hypot(spread, LEAST_SIGMAS) ** 2)
    lens = CameraIntrinsics(size_px, focal, (cx, cy * aspect), k1, covariance, "charuco", other_terms=other)
    return _in_picture(path, lens)


def _in_picture(path: Path, lens: CameraIntrinsics) -> CameraIntrinsics:
    x, y = lens.centre_px
    width, height = lens.size_px
    if -width / 2 < x < 1.5 * width and -height / 2 < y < 1.5 * height:
        return lens
    raise UsageError(
        "camera-intrinsics-invalid",
        what=f"{path.name}: the principal point lies far outside of the picture of {width}x{height} pixels.",
        remedy="Correct it, or make the file again with `velatura camera calibrate`.",
    )


KEYS: Final = (
    "method", "width_px", "height_px", "focal_length_px", "principal_point_px", "distortion_k1", "rms_px", "views",
    "covariance", *OTHER_KEYS,
)  # fmt: skip


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

    unknown = next(iter(set(content) - set(KEYS)), None)
    if unknown is not None:
        raise invalid(f"the key {unknown}", f"one of {', '.join(KEYS)}")
    width, height = (number(key, content.get(key), 0.0) for key in ("width_px", "height_px"))
    x, y = numbers("principal_point_px", 2, content.get("principal_point_px"))
    rows = content.get("covariance")
    if not (isinstance(rows, list) and len(rows) in (4, len(PARAMETERS))):
        raise invalid("covariance", "four lists of four numbers, or eight of eight")
    covariance = np.array([numbers("covariance", len(rows), row) for row in rows])
    if not np.allclose(covariance, covariance.T) or np.linalg.eigvalsh(covariance).min() <= 0:
        raise invalid("covariance", "symmetric and positive definite")
    method: Literal["charuco", "exif"] = "exif" if content.get("method") == "exif" else "charuco"
    lens = CameraIntrinsics(
        size_px=(int(width), int(height)),
        focal_px=number("focal_length_px", content.get("focal_length_px"), 0.0),
        centre_px=(x, y),
        k1=number("distortion_k1", content.get("distortion_k1", 0.0)),
        covariance=covariance,
        method=method,
        rms_px=number("rms_px", content.get("rms_px", 0.0)),
        views=int(number("views", content.get("views", 0))),
        other_terms=tuple(number(key, content.get(key, 0.0)) for key in OTHER_KEYS),
    )
    return _in_picture(path, lens)
