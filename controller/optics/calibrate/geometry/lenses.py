"""Lenses: the camera's own from a printed ChArUco board or from EXIF data, and how far a projector's bends its picture.

A handful of photographs of the board is enough (Zhang 2000; OpenCV's detector); its size on paper does not matter,
because a focal length in pixels follows from angles alone. What photographs say of themselves (EXIF 2.32) is the
fallback.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image, UnidentifiedImageError

from controller.core.arrays import Float64
from controller.core.errors import CalibrationError, WorkError
from controller.core.files import require_regular
from controller.optics.calibrate.geometry.intrinsics import CameraIntrinsics
from controller.optics.calibrate.values import Pinhole
from controller.optics.capture.raw import raw_size

SQUARES: Final = (11, 8)
MARKER_SHARE: Final = 0.75
DICTIONARY: Final = cv2.aruco.DICT_5X5_50
FEWEST_CORNERS: Final = 15
FEWEST_VIEWS: Final = 5
LEAST_TILT_DEGREES: Final = 12.0
"""Between the two most different views; with less, focal length and distance can't be separated."""
LARGEST_FOCAL_REL_SIGMA: Final = 0.01
LARGEST_RMS_PX: Final = 2.0
LARGEST_BEND_PX: Final = 0.3
"""Rms of what is off alike in neighbouring corners: paper and detector stay below, another lens model explains it."""
MOST_SIGMAS: Final = 4.0
LEAST_SIGMAS: Final = np.array([3e-4, 0.3, 0.3, 1e-3, 1e-3, 1e-4, 1e-4, 1e-4])
"""What a printed board that is not quite flat leaves uncertain of ``PARAMETERS``, however many corners there are."""
TERMS: Final = {
    "aspect": ((7, 8), cv2.CALIB_FIX_ASPECT_RATIO),
    "tangential": ((5, 6), cv2.CALIB_ZERO_TANGENT_DIST),
    "k2": ((4,), cv2.CALIB_FIX_K2),
}
"""What a fit can have beside focal length, centre and k1: columns of ``_LensFit.columns``, OpenCV's flag without it.

The aspect is that of the pixels and that of the board, of which a printer may make one side longer.
"""

Grey = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class BoardView:
    """One photograph's corners: ``board`` (corners, 3) float32 in squares, ``seen_px`` (corners, 2) float32 x, y."""

    board: npt.NDArray[np.float32]
    seen_px: npt.NDArray[np.float32]


def board_picture(width_px: int = 3300) -> Grey:
    """The board to print, (rows, columns) uint8, 0 or 255, half a square of white around it."""
    margin = width_px // (2 * SQUARES[0] + 2)
    height_px = round((width_px - 2 * margin) * SQUARES[1] / SQUARES[0]) + 2 * margin
    return np.asarray(_board().generateImage((width_px, height_px), marginSize=margin), dtype=np.uint8)


def find_corners(photograph: Grey) -> BoardView | None:
    """The board's corners in a grey photograph (rows, columns); None where too few are seen."""
    corners, ids, _, _ = cv2.aruco.CharucoDetector(_board()).detectBoard(photograph)
    if ids is None or corners is None or len(ids) < FEWEST_CORNERS:
        return None
    board = np.asarray(_board().getChessboardCorners(), dtype=np.float32)[np.asarray(ids).ravel()]
    return BoardView(board, np.asarray(corners, dtype=np.float32).reshape(-1, 2))


def calibrate_views(views: Sequence[BoardView], size_px: tuple[int, int]) -> CameraIntrinsics:
    """Focal length, centre and distortion with their covariance, from the board's corners in several photographs.

    ``size_px``: (width, height) of the photographs, which were taken with the zoom and focus of the stage

    Raises CalibrationError("camera-too-few-views", "camera-views-parallel", "camera-fit-poor": no lens explains the
    corners, or "camera-lens-unlike": they are off in whole areas, or two causes explain them alike).
    """
    _require_enough(views)
    fit = _fit_lens(views, size_px, tuple(TERMS))
    scatter = float(np.sqrt(np.mean([np.mean(off**2) for off in fit.off_px])))
    kept = [_trimmed(view, off, MOST_SIGMAS * max(scatter, 0.02)) for view, off in zip(views, fit.off_px, strict=True)]
    kept = [view for view in kept if len(view.board) >= FEWEST_CORNERS]
    _require_enough(kept)
    fit = _simplest(kept, size_px)
    covariance = fit.covariance()
    rms_px = float(np.sqrt(np.mean(np.concatenate([off.ravel() ** 2 for off in fit.off_px]))))
    if rms_px > LARGEST_RMS_PX:
        raise CalibrationError(
            "camera-fit-poor",
            what=f"No lens model explains the corners of the board: they are off by {rms_px:.1f} px rms.",
            remedy="Do not change zoom and focus between photographs, and mount the board flat on something stiff.",
        )
    covariance = covariance * _growth(fit)
    if _tilt_degrees(fit.turns) < LEAST_TILT_DEGREES or covariance[0, 0] > LARGEST_FOCAL_REL_SIGMA**2:
        raise CalibrationError(
            "camera-views-parallel",
            what="The board had nearly the same angle in all photographs, so focal length and distance can't be "
            "separated.",
            remedy="Turn the board by 20 to 45 degrees to the left, right, up and down between photographs.",
        )
    used = 8 if fit.terms else 4
    return CameraIntrinsics(
        size_px=size_px,
        focal_px=float(fit.matrix[0, 0]),
        centre_px=(float(fit.matrix[0, 2]), float(fit.matrix[1, 2])),
        k1=float(fit.distortion[0]),
        other_terms=(*map(float, fit.distortion[1:4]), float(np.log(fit.matrix[1, 1] / fit.matrix[0, 0]))),
        covariance=(covariance + np.diag(LEAST_SIGMAS**2))[:used, :used],
        method="charuco",
        rms_px=rms_px,
        views=len(kept),
    )


@dataclass(frozen=True, slots=True)
class _LensFit:
    """A lens and the board's poses; ``off_px`` (corners, 2) of each view, found less seen; ``terms``: some of TERMS."""

    views: Sequence[BoardView]
    terms: tuple[str, ...]
    matrix: Float64
    distortion: Float64
    turns: list[Float64]
    moves: list[Float64]
    off_px: list[Float64]

    @property
    def free(self) -> list[int]:
        """Columns that were fitted."""
        return [0, 1, 2, 3, *sorted(column for name in self.terms for column in TERMS[name][0])]

    def criterion(self, *, with_all: bool = False) -> float:
        """Schwarz's information criterion: of two fits of the same corners the lower is the likelier one.

        ``with_all``: of the fit with all terms, as far as the slope of the squares tells it
        """
        off, terms = np.concatenate([off.ravel() for off in self.off_px]), len(self.free)
        squares = float(np.sum(off**2))
        if with_all:
            inverse, gradient = self.inverse(range(9))
            squares, terms = squares - float(gradient @ inverse @ gradient), 9
        return float(off.size * np.log(max(squares, 1e-12)) + terms * np.log(off.size))

    def columns(self, view: BoardView, turn: Float64, move: Float64) -> tuple[Float64, Float64]:
        """Derivatives of a view's corners by its pose (n, 6), and (n, 9) by ``PARAMETERS`` and the board's stretch."""
        _, jacobian = cv2.projectPoints(view.board, turn, move, self.matrix, self.distortion)
        # a corner that moves along the board does as if the board moved
        stretch = (jacobian[:, 3:6] @ cv2.Rodrigues(turn)[0][:, :1]) * np.repeat(view.board[:, :1], 2, axis=0)
        by_aspect = jacobian[:, 7:8] * self.matrix[1, 1]
        focal = jacobian[:, 6:7] * self.matrix[0, 0] + by_aspect
        return np.asarray(jacobian[:, :6]), np.hstack([focal, jacobian[:, 8:14], by_aspect, stretch])

    def inverse(self, free: Sequence[int]) -> tuple[Float64, Float64]:
        """(9, 9) inverse of the information on columns ``free``, 0 elsewhere; (9,) half the slope of the squares."""
        information, gradient = np.zeros((len(free), len(free))), np.zeros(9)
        for view, turn, move, off in zip(self.views, self.turns, self.moves, self.off_px, strict=True):
            pose, lens = self.columns(view, turn, move)
            gradient += lens.T @ off.ravel()
            lens = lens[:, free]
            cross = pose.T @ lens
            information += lens.T @ lens - cross.T @ np.linalg.solve(pose.T @ pose, cross)
        scale = 1.0 / np.sqrt(np.diag(information))
        inverse = np.zeros((9, 9))
        solved = np.linalg.pinv(information * np.outer(scale, scale), hermitian=True)
        inverse[np.ix_(free, free)] = solved * np.outer(scale, scale)
        return inverse, gradient

    def covariance(self) -> Float64:
        """(8, 8) of ``PARAMETERS``, all else eliminated, with the corners' own scatter as their noise."""
        squares = float(sum(np.sum(off**2) for off in self.off_px))
        measured = sum(off.size - 6 for off in self.off_px) - len(self.free)
        return self.inverse(self.free)[0][:8, :8] * squares / max(measured, 1)


def _simplest(views: Sequence[BoardView], size_px: tuple[int, int]) -> _LensFit:
    """The lens with as many terms as the corners ask for.

    Raises CalibrationError("camera-lens-unlike") where they do not tell a stretched board from pixels not square.
    """
    fit = _fit(views, size_px)
    if fit.criterion(with_all=True) < fit.criterion():
        fit = min(fit, _fit(views, size_px, tuple(TERMS)), key=_LensFit.criterion)
    for name in fit.terms:
        less = _fit(views, size_px, tuple(term for term in fit.terms if term != name))
        fit = min(less, fit, key=_LensFit.criterion)
    if fit.covariance()[7, 7] < LARGEST_FOCAL_REL_SIGMA**2:
        return fit
    raise CalibrationError(
        "camera-lens-unlike",
        what="Either the camera's pixels are not square, or the board is longer on one side than the other.",
        remedy="Photograph the board turned by 90 degrees, too, so that the pictures tell which of the two it is.",
    )


def _growth(fit: _LensFit) -> float:
    """The factor of the covariance for corners that are off alike with their neighbours, and so are not independent.

    In each view, cubic functions of the board's coordinates hold such misfit. Raises
    CalibrationError("camera-lens-unlike").
    """
    alike, alone, whole, free = 0.0, 0.0, 0, 0
    for view, off in zip(fit.views, fit.off_px, strict=True):
        x, y = (view.board[:, axis] / SQUARES[axis] for axis in range(2))
        basis, _ = np.linalg.qr(np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1))
        part = float(np.sum((basis.T @ off) ** 2))
        alike, alone = alike + part, alone + float(np.sum(off**2)) - part
        whole, free = whole + off.size, free + off.size - CUBIC
    noise = alone / max(free, 1)
    own = (CUBIC - 6) * len(fit.views)
    bend = max(alike - own * noise, 0.0) / whole
    if bend > max(LARGEST_BEND_PX**2, noise):
        raise CalibrationError(
            "camera-lens-unlike",
            what="Focal lengths, radial and tangential distortion do not explain the corners: whole areas are off by "
            f"{math.sqrt(bend):.1f} px.",
            remedy="Give all photographs as the camera took them, unturned and uncropped, with the stabiliser off and "
            "the board flat. If the lens is very wide, use a longer one, or write focal_length_px and "
            "focal_length_rel_sigma = 0.02 into stage.toml.",
        )
    return (noise + bend * whole / own) / max(noise + bend, 1e-12)


CUBIC: Final = 20
"""Cubic functions of two coordinates, of x and of y; six of their sums are the board's pose."""


def _board() -> Any:
    dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARY)
    return cv2.aruco.CharucoBoard(SQUARES, 1.0, MARKER_SHARE, dictionary)


def _require_enough(views: Sequence[BoardView]) -> None:
    if len(views) < FEWEST_VIEWS:
        raise CalibrationError(
            "camera-too-few-views",
            what=f"Only {len(views)} photographs show the board well enough; {FEWEST_VIEWS} are needed.",
            remedy="Take ten to fifteen sharp and evenly lit photographs, with the board at different angles and "
            "places.",
        )


def _fit(views: Sequence[BoardView], size_px: tuple[int, int], terms: tuple[str, ...] = ()) -> _LensFit:
    fit = _fit_lens(views, size_px, terms)
    for _ in range(3 * ("aspect" in terms)):
        inverse, gradient = fit.inverse(fit.free)
        longer = np.array([np.clip(1 - inverse[8, 8] * gradient[8], 0.9, 1.1), 1, 1], np.float32)
        fit = _fit_lens([BoardView(view.board * longer, view.seen_px) for view in fit.views], size_px, terms)
    return fit


def _fit_lens(views: Sequence[BoardView], size_px: tuple[int, int], terms: tuple[str, ...]) -> _LensFit:
    flags = cv2.CALIB_FIX_K3 | sum(flag for name, (_, flag) in TERMS.items() if name not in terms)
    try:
        _, matrix, distortion, turns, moves = cv2.calibrateCamera(
            [view.board for view in views],
            [view.seen_px.reshape(-1, 1, 2) for view in views],
            size_px,
            np.eye(3),
            np.zeros(5),
            flags=flags,
        )
    except cv2.error as error:
        raise CalibrationError(
            "camera-fit-poor",
            what="No lens model explains the corners of the board.",
            remedy="Photograph the board from more angles, whole and in focus.",
        ) from error
    off = []
    for view, turn, move in zip(views, turns, moves, strict=True):
        corners, _ = cv2.projectPoints(view.board, turn, move, matrix, distortion)
        off.append(np.asarray(corners.reshape(-1, 2) - view.seen_px, dtype=np.float64))
    poses = [[np.asarray(one, np.float64) for one in part] for part in (turns, moves)]
    bent = np.asarray(distortion, np.float64).ravel()
    return _LensFit(views, terms, np.asarray(matrix, np.float64), bent, poses[0], poses[1], off)


def _trimmed(view: BoardView, off_px: Float64, most_px: float) -> BoardView:
    kept = np.linalg.norm(off_px, axis=1) < most_px
    return BoardView(view.board[kept], view.seen_px[kept])


def _tilt_degrees(turns: Sequence[Float64]) -> float:
    """The largest angle between the board's normals in two views."""
    normals = [cv2.Rodrigues(turn)[0][:, 2] for turn in turns]
    largest = min(float(a @ b) for a, b in combinations(normals, 2))
    return float(np.degrees(np.arccos(np.clip(largest, -1.0, 1.0))))


FOCAL_REL_SIGMA: Final = 0.03
"""Lenses report whole millimetres, and their focal length changes with focus."""
CONTRADICTION, CONTRADICTED_SIGMA = 0.08, 0.15
"""Two focal lengths of one photograph differ by this share; the standard deviation of the one that is taken."""
CENTRE_SHARE: Final = 0.005
K1_SIGMA: Final = 0.05
FULL_FRAME_DIAGONAL_MM: Final = 43.267
_EXIF, _FOCAL_MM, _FOCAL_35MM, _WIDTH = 0x8769, 0x920A, 0xA405, 0xA002
_PLANE_X, _PLANE_UNIT = 0xA20E, 0xA210
PICTURES: Final = (".jpg", ".jpeg", ".tif", ".tiff", ".png")
_MM_PER_UNIT: Final = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}


def intrinsics_from_exif(path: Path) -> CameraIntrinsics:
    """Read a JPEG, a TIFF or a RAW file built on TIFF (CR2, NEF, ARW, DNG).

    Raises WorkError("photograph-unreadable"), CalibrationError("camera-focal-length-unknown").
    """
    try:
        require_regular(path)
        with warnings.catch_warnings(), Image.open(path) as picture:
            # No pixel of it is decoded, so however many it has does no harm.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            tags = dict(picture.getexif().get_ifd(_EXIF))
            size = picture.size
        if path.suffix.lower() not in PICTURES:
            size = raw_size(path)  # the first picture of a RAW file is often a thumbnail
    except (OSError, UnidentifiedImageError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise WorkError(
            "photograph-unreadable",
            what=f"{path.name} has unreadable EXIF data.",
            remedy="Give a JPEG or RAW file as it came from the camera.",
        ) from error
    width, height = size
    focal_px, focal_sigma = _focal_px(tags, size)
    if focal_px is None:
        raise CalibrationError(
            "camera-focal-length-unknown",
            what=f"{path.name} does not contain both the focal length and the sensor's size.",
            remedy="Photograph the board of `velatura camera board`, or give focal_length_px in stage.toml.",
        )
    sigmas = np.array([focal_sigma, CENTRE_SHARE * width, CENTRE_SHARE * width, K1_SIGMA])
    return CameraIntrinsics(
        size_px=size,
        focal_px=focal_px,
        centre_px=((width - 1) / 2, (height - 1) / 2),
        k1=0.0,
        covariance=np.diag(sigmas**2),
        method="exif",
        views=1,
    )


def _focal_px(tags: dict[int, object], size: tuple[int, int]) -> tuple[float | None, float]:
    """Of the whole picture, and its relative standard deviation.

    The density of the sensor's pixels is often wrong: of another sensor, or of a picture that was made smaller. The
    focal length as on 35 mm film has no pixels in it, so it counts where both are there and contradict each other.
    """
    focal_mm, per_unit = _number(tags.get(_FOCAL_MM)), _number(tags.get(_PLANE_X))
    unit = _number(tags.get(_PLANE_UNIT)) or 2.0
    focal_35mm = _number(tags.get(_FOCAL_35MM))
    by_film = None if focal_35mm is None else focal_35mm / FULL_FRAME_DIAGONAL_MM * math.hypot(*size)
    if not (focal_mm and per_unit and unit in _MM_PER_UNIT):
        return by_film, FOCAL_REL_SIGMA
    smaller = size[0] / (_number(tags.get(_WIDTH)) or size[0])
    by_sensor = focal_mm * per_unit / _MM_PER_UNIT[int(unit)] * (smaller if smaller < 1 else 1)
    if by_film is None or abs(by_sensor / by_film - 1) < CONTRADICTION:
        return by_sensor, FOCAL_REL_SIGMA
    return by_film, CONTRADICTED_SIGMA


def _number(value: object) -> float | None:
    """A number above 0, or None; rational tags with a denominator of 0 are not numbers."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if 0 < number < math.inf else None


NAMED_PX: Final = 0.5
"""At the farthest corner: less is not seen."""


def bend_px(lens: Pinhole) -> float:
    """Pixels by which distortion displaces the corner that it displaces most."""
    width, height = lens.size_px
    corners = np.array([(x, y) for x in (0, width) for y in (0, height)], np.float64)
    focal = lens.matrix[[0, 1], [0, 1]]
    squared = np.sum(((corners - lens.matrix[:2, 2]) / focal) ** 2, axis=1)
    k1, k2 = lens.distortion[:2]
    return float(np.max(np.abs(k1 * squared + k2 * squared**2) * np.sqrt(squared)) * focal.mean())


def bent(name: str, lens: Pinhole) -> str | None:
    """What a technician should know of a projector's lens; None where its picture is as good as straight."""
    by_px = bend_px(lens)
    if by_px < NAMED_PX:
        return None
    return (
        f"The lens of projector {name} bends its picture, by up to {by_px:.1f} pixels at a corner. The geometry takes "
        "that into account. Nothing has to be done."
    )
