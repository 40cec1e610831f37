"""What the camera sees, how well the projectors cover the object, and what a target asks too much of."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from controller.app import Checked, check_stage
from controller.calibrations import finished_calibration
from controller.errors import WorkError
from controller.panel.kiosk import Aiming, ProjectorAim
from controller.serve.devices import Devices
from hal.deadline import in_seconds
from hal.errors import DeviceError
from hal.interfaces import LiveViewCamera

if TYPE_CHECKING:
    from controller.session.solving import Calibrated

DARK = 0.1
"""Below this share of the median light of the object, a place is too dark to work with."""
_ANSWER_S = 5.0
_measured: dict[Path, Aiming] = {}
_lock = threading.Lock()


def camera_picture(devices: Devices) -> bytes | None:
    """The camera's live picture, decoded and encoded anew, as JPEG; None without live view, or while it works."""
    import cv2

    camera = devices.camera.device
    if not isinstance(camera, LiveViewCamera) or not camera.capabilities.live_view:
        return None
    if not devices.camera.lent.acquire(timeout=0.5):
        return None
    try:
        data = camera.live_view(deadline=in_seconds(_ANSWER_S))
    except DeviceError:
        return None
    finally:
        devices.camera.lent.release()
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        return None
    done, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])
    return encoded.tobytes() if done else None


def aiming(checked: Checked, devices: Devices) -> Aiming:
    """Coverage, overlap and focus as of the newest calibration. Raises UsageError("not-calibrated")."""
    from controller.session.solving import Calibrated

    run = finished_calibration(checked.stage.folder)
    with _lock:
        if run not in _measured:
            _measured.clear()
            _measured[run] = _of(Calibrated(run, checked.names))
        return _measured[run]


def _of(calibrated: Calibrated) -> Aiming:
    transport, calibration = calibrated.transport, calibrated.calibration
    mask = calibration.object_mask
    lit = np.stack([np.asarray(one, bool) & mask for one in transport.lit])
    white = sum(np.asarray(part.white, np.float32).mean(axis=2) for part in calibration.projectors)
    on_object = np.asarray(white)[mask]
    usual = float(np.median(on_object)) if on_object.size else 1.0
    area = max(1, int(np.count_nonzero(mask)))
    aims = []
    for number, part in enumerate(calibration.projectors):
        covariance = part.metapixels.covariance_px2[part.metapixels.valid]
        size_px = float(np.sqrt(np.median(covariance[:, 0] + covariance[:, 2]) / 2)) if len(covariance) else np.inf
        pitch_px = float(np.sqrt(max(1, int(lit[number].sum())) / max(1, len(covariance))))
        # A sharp pixel's light has a standard deviation of about a third of the distance to the next.
        focus = float(np.clip(pitch_px / max(3 * size_px, 1e-6), 0, 1))
        aims.append(ProjectorAim(part.name, float(lit[number].sum() / area), focus))
    overlap = float((lit.sum(axis=0) >= 2).sum() / area)
    dark = float((on_object < DARK * usual).mean()) if on_object.size else 0.0
    blur = max(calibration.camera_blur_px)
    hints = [f"{aim.projector} lights {aim.coverage:.0%} of the object: turn it, or move it further away."
             for aim in aims if aim.coverage < 0.5]  # fmt: skip
    hints += [f"{aim.projector} is out of focus." for aim in aims if aim.focus < 0.4]
    exposure = float(np.quantile(on_object, 0.99) / max(float(on_object.max()), 1e-9)) if on_object.size else 0.0
    grazing = float(1 - np.mean(np.max(lit, axis=0)[mask])) if area else 0.0
    camera_focus = float(np.clip(1 / (1 + blur), 0, 1))
    return Aiming(tuple(aims), overlap, dark, grazing, camera_focus, exposure, tuple(hints))


def feasibility_map(stage: Path, target: Path) -> Path:
    """A PNG of how far the target is out of reach. Raises UsageError("not-calibrated", "target-unreadable")."""
    import cv2

    from controller.session.solving import Calibrated
    from controller.solve.feasibility import choose_exposure, feasibility
    from controller.solve.targets import load_target

    checked = check_stage(stage)
    calibrated = Calibrated(finished_calibration(checked.stage.folder), checked.names)
    transport, black = calibrated.transport, calibrated.calibration.black
    asked = load_target(target, (black.shape[1], black.shape[0]))
    exposure = choose_exposure(transport, asked.image, black, share=checked.stage.tables.solve.exposure_share)
    found = feasibility(transport, np.float32(exposure) * asked.image, black)
    worst = np.maximum(found.too_bright, found.too_dark).max(axis=2)
    grey = np.where(calibrated.calibration.object_mask, np.clip(worst, 0, 1), 0)
    path = stage / "kiosk" / "feasibility" / f"{target.stem[:64]}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), (255 * grey).astype(np.uint8)):
        raise WorkError("cannot-write", what=f"{path.name} could not be written.", remedy="Look at the disk.")
    return path
