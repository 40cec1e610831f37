"""What the camera sees, and how well the projectors cover the object."""

from __future__ import annotations

import json
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from controller.core.arrays import Mask
from controller.core.errors import VelaturaError
from controller.kiosk.store.runs import began_s
from controller.kiosk.supervisors.devices import Devices
from controller.kiosk.values import Aiming, ProjectorAim, Sharpness
from controller.stage.sessions.calibrations import finished_calibrations
from controller.stage.sessions.check import Checked
from hal.deadline import in_seconds
from hal.errors import DeviceError
from hal.interfaces import LiveViewCamera

if TYPE_CHECKING:
    from controller.optics.calibrate.values import Geometry, Metapixels
    from controller.stage.artefacts.calibrated import Calibrated

GRAZING: Final = 0.25
"""Below this cosine of the angle to the surface normal, light is grazing."""
LEAST_COVERAGE, SOFT_FOCUS, MUCH = 0.5, 0.4, 0.1
DIM, BURNT = 0.25, 0.98
CAMERA_SPREAD_PX: Final = 0.5
"""Standard deviation of a point of light in the camera's picture: its samples, its colour filters, a good lens."""
DARK, CLIPPED = 0.1, 0.02
"""Below this share of the object's median light, a place is too dark."""
FOLDER, FIGURES, PICTURE = "kiosk/aiming", "aiming.json", "overview.png"
"""Names as in ``controller.stage.steps.capture.aiming``, which is loaded only to photograph."""
_ANSWER_S = 5.0
_UNREADABLE: Final = (OSError, ValueError, KeyError, TypeError, AttributeError)
_measured: dict[Path, Aiming] = {}
_lock = threading.Lock()


def camera_picture(devices: Devices) -> bytes | None:
    """The camera's live picture, decoded and encoded again, as JPEG; None without live view, or while a job uses it."""
    import cv2

    if not devices.camera.lent.acquire(timeout=0.5):
        return None
    try:
        # Only with the lock: before that, its supervisor may close and reopen it.
        camera = devices.camera.device
        if not isinstance(camera, LiveViewCamera) or not camera.capabilities.live_view:
            return None
        data = camera.live_view(deadline=in_seconds(_ANSWER_S))
    except DeviceError:
        return None
    finally:
        devices.camera.lent.release()
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    if picture is None:
        return None
    done, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])
    return encoded.tobytes() if done else None


def aiming(checked: Checked) -> Aiming:
    """Coverage, overlap and focus from the test shots or the calibration, whichever is newer.

    If the calibration can't be read, from the test shots; without any, the hint says what is wrong.
    """
    folder = checked.stage.folder
    shots = _of_shots(folder / FOLDER)
    try:
        run = next(iter(finished_calibrations(folder)), None)
        if run is None or (shots is not None and shots.measured_unix_s > began_s(run.name)):
            return shots or Aiming()
        return _cached(run, checked.names)
    except VelaturaError as error:
        return shots or Aiming(hints=(f"{error.what} {error.remedy}",))
    except _UNREADABLE as error:
        return shots or Aiming(hints=(f"The calibration can't be read ({type(error).__name__}). Calibrate again.",))


def _cached(run: Path, names: Sequence[str]) -> Aiming:
    from controller.stage.artefacts.calibrated import Calibrated

    with _lock:
        if run not in _measured:
            _measured.clear()
            _measured[run] = _of_calibration(Calibrated(run, names))
        return _measured[run]


def _of_shots(folder: Path) -> Aiming | None:
    try:
        return _judged(folder, json.loads((folder / FIGURES).read_text()))
    except _UNREADABLE:
        # Damaged shots must not block the page on which new ones are taken in seconds.
        return None


def _judged(folder: Path, figures: dict[str, Any]) -> Aiming:
    aims = tuple(ProjectorAim(**row) for row in figures["projectors"])
    exposure, camera = figures["exposure"], figures["camera_focus"]
    hints = [*_hints(aims, min(1.0, camera)), *_shared_hints(figures["too_dark"], figures["too_soft"])]
    if exposure < DIM or exposure > BURNT:
        word = "dark" if exposure < DIM else "bright"
        hints.append(f"The camera's picture is too {word}: change the aperture, or the ISO in stage.toml.")
    if camera < SOFT_FOCUS:
        hints.append("No pattern is sharp anywhere: focus the camera first.")
    clipped = figures.get("clipped")
    if clipped is not None and clipped > CLIPPED:
        hints.append(f"{clipped:.0%} of the object is too bright for the camera: a shorter exposure is needed.")
    # Test shots of an older version have none of the last four.
    return Aiming(
        aims, figures["overlap"], figures["too_dark"], figures["too_soft"], camera, exposure, tuple(hints),
        "test shots", figures["measured_unix_s"], folder / PICTURE, clipped is not None, clipped,
        tuple(map(float, figures.get("histogram", ()))), tuple(Sharpness(**row) for row in figures.get("history", ())),
    )  # fmt: skip


def _hints(aims: Sequence[ProjectorAim], camera: float = 1.0) -> list[str]:
    """``camera``: the sharpest that it sees anywhere, 0..1; no projector can look sharper."""
    hints = [f"{aim.projector} lights {aim.coverage:.0%} of the object: turn it, or move it farther away."
             for aim in aims if aim.coverage < LEAST_COVERAGE]  # fmt: skip
    return hints + [f"{aim.projector} is out of focus." for aim in aims if aim.focus < SOFT_FOCUS * camera]


def _shared_hints(dark: float, grazing: float) -> list[str]:
    hints = []
    if dark > MUCH:
        hints.append(f"{dark:.0%} of the object is too dark: turn a projector towards it, or remove obstacles.")
    if grazing > MUCH:
        hints.append(f"Light is grazing or soft on {grazing:.0%} of the object: move a projector further to the front.")
    return hints


def _of_calibration(calibrated: Calibrated) -> Aiming:
    from controller.stage.artefacts.geometry import known_geometry

    transport, calibration = calibrated.transport, calibrated.calibration
    mask = calibration.object_mask
    lit = np.stack([np.asarray(part, bool) & mask for part in transport.lit])
    white = sum(np.asarray(part.white, np.float32).mean(axis=2) for part in calibration.projectors)
    on_object = np.asarray(white)[mask]
    usual = float(np.median(on_object)) if on_object.size else 1.0
    area = max(1, int(np.count_nonzero(mask)))
    aims = []
    for number, part in enumerate(calibration.projectors):
        aims.append(ProjectorAim(part.name, float(lit[number].sum() / area), focus_of(part.metapixels)))
    dark = float((on_object < DARK * usual).mean()) if on_object.size else 0.0
    geometry = known_geometry(calibrated.folder, calibrated.projectors)
    grazing = 0.0 if geometry is None else grazing_share(geometry, lit, mask)
    return Aiming(
        tuple(aims), float((lit.sum(axis=0) >= 2).sum() / area), dark, grazing,
        None, None, (*_hints(aims), *_shared_hints(dark, grazing)), "calibration", began_s(calibrated.folder.name),
    )  # fmt: skip


def focus_of(pixels: Metapixels) -> float:
    """How sharp a projector's pixels are, 0..1: 1 where their light spreads no more than that of a sharp pixel does at
    this distance and slant, seen by this camera.
    """
    centres = np.where(pixels.valid[..., None], pixels.centre_px, np.nan).astype(np.float64)
    across, down = np.diff(centres, axis=1)[:-1], np.diff(centres, axis=0)[:, :-1]
    area_px2 = np.abs(across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0])
    xx, xy, yy = np.moveaxis(pixels.covariance_px2[:-1, :-1].astype(np.float64), -1, 0)
    known = np.isfinite(area_px2) & np.isfinite(xx + xy + yy)
    if not known.any():
        return 0.0
    spread_px2 = np.sqrt(np.maximum((xx * yy - xy**2)[known], 1e-12))
    # A sharp pixel's light has a standard deviation of about a third of its side; the camera adds its own.
    sharp_px2 = area_px2[known] / 9 + CAMERA_SPREAD_PX**2
    return float(np.clip(np.median(np.sqrt(sharp_px2 / spread_px2)), 0, 1))


def grazing_share(geometry: Geometry, lit: npt.NDArray[np.bool_], mask: Mask) -> float:
    """The share of the object that is lit only at cosines below ``GRAZING``."""
    steepest = np.zeros(mask.shape)
    for part, pinhole in zip(lit, geometry.projectors, strict=True):
        centre_m = -pinhole.rotation.T @ pinhole.translation_m
        towards = centre_m - geometry.points_m
        cosine = np.einsum("ijk,ijk->ij", towards, geometry.normals) / np.maximum(np.linalg.norm(towards, axis=2), 1e-9)
        steepest = np.maximum(steepest, np.where(part, np.nan_to_num(cosine), 0))
    known = lit.any(axis=0) & mask & np.isfinite(geometry.normals).all(axis=2)
    return float((steepest[known] < GRAZING).mean()) if known.any() else 0.0
