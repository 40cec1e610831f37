"""A calibration's light at some of the camera's pixels, kept in memory: what a preview needs to come within a second.

All light of a preview but the indirect is a matter of each pixel alone, and the indirect is one of blocks of pixels. So
a preview calculates the same as a computation, at fewer places.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64, FloatImage, load_arrays, save_arrays
from controller.core.errors import UsageError
from controller.core.storage import write_atomically
from controller.stage.artefacts.outline import outline_digest

if TYPE_CHECKING:
    from controller.optics.solve.reach.drive_levels import DriveLevels
    from controller.optics.transport.indirect.indirect_light import IndirectLight
    from controller.stage.artefacts.calibrated import Calibrated

FOLDER: Final = "kiosk/preview"
LONGEST_PX: Final = 480
"""About the longer side of what is calculated; the pictures are for a screen."""
_known: dict[str, PreviewLight] = {}
_lock = threading.Lock()


@dataclass(frozen=True, slots=True, eq=False)
class PreviewLight:
    """``black`` (rows, columns, 3) and all else at the sampled pixels; ``camera_px`` (width, height) of the whole
    picture, of which every ``step``-th pixel is here.
    """

    drive: DriveLevels
    indirect: IndirectLight | None
    black: FloatImage
    camera_to_xyz: Float64
    camera_px: tuple[int, int]
    step: float


def preview_light(stage: Path, run: Path, names: tuple[str, ...]) -> PreviewLight:
    """Of a finished calibration: from memory, else from the stage's folder, else made of the run, which takes seconds.

    Raises what reading a calibration raises.
    """
    with _lock:
        name = _name(run)
        if name not in _known:
            file = stage / FOLDER / f"{name}.npz"
            found = _read(file)
            if found is None:
                from controller.stage.artefacts.calibrated import Calibrated

                calibrated = Calibrated(run, names)
                found = sampled(calibrated)
                file.parent.mkdir(parents=True, exist_ok=True)
                for old in file.parent.glob("*"):
                    old.unlink(missing_ok=True)
                save_arrays(file, _arrays(found))
                write_atomically(file.with_suffix(".png"), _in_white(calibrated))
            _known.clear()
            _known[name] = found
        return _known[name]


def _name(run: Path) -> str:
    """Of what is known of a run's light, for one outline of the object."""
    return "-".join(part for part in (run.name, outline_digest(run)) if part)


def view_picture(stage: Path, run: Path, names: tuple[str, ...]) -> Path:
    """A PNG of the object in white light, as large as the camera's picture. Seconds at the first time."""
    file = stage / FOLDER / f"{_name(run)}.png"
    if not file.exists():
        with _lock:
            _known.pop(_name(run), None)
            file.with_suffix(".npz").unlink(missing_ok=True)
    # A person who paints on it wants a preview next.
    preview_light(stage, run, names)
    return file


def sampled(calibrated: Calibrated) -> PreviewLight:
    """The light of a whole calibration at about ``LONGEST_PX`` pixels along its longer side."""
    from controller.optics.transport.indirect.indirect_light import IndirectLight

    indirect = calibrated.indirect
    rows, columns = calibrated.transport.camera_shape
    # Blocks of indirect light must have a whole number of samples along their side.
    side = 1 if indirect is None else indirect.side
    inside = max(1, round(side * min(1.0, LONGEST_PX / max(rows, columns))))
    step = side / inside if indirect is not None else max(1.0, max(rows, columns) / LONGEST_PX)
    at = _samples(rows, step), _samples(columns, step)
    kept = np.ix_(*at)
    coarse = None if indirect is None else IndirectLight(
        indirect.factors, indirect.scale[kept], indirect.lit[kept], indirect.grid, inside,
        paint=None if indirect.paint is None else indirect.paint[:, :, at[0]][..., at[1]],
    )  # fmt: skip
    calibration = calibrated.calibration
    black = np.ascontiguousarray(calibration.black[kept])
    drive = calibrated.drive.at(*at)
    return PreviewLight(drive, coarse, black, calibration.camera_to_xyz, (columns, rows), step)


def _samples(pixels: int, step: float) -> npt.NDArray[np.int64]:
    """The pixels in the middle of each step."""
    count = int(np.ceil(pixels / step))
    return np.minimum(((np.arange(count) + 0.5) * step).astype(np.int64), pixels - 1)


def _in_white(calibrated: Calibrated) -> bytes:
    from controller.bundle.describe import png
    from controller.stage.report.pictures import to_screen

    calibration = calibrated.calibration
    lit = np.asarray(sum((part.white for part in calibration.projectors), start=calibration.black), np.float32)
    level = float(np.nanpercentile(lit[calibration.object_mask], 99))
    return png(to_screen(lit, calibration.camera_to_xyz, white=level))


def _arrays(light: PreviewLight) -> dict[str, npt.NDArray[Any]]:
    own: dict[str, npt.NDArray[Any]] = {"black": light.black, "camera_to_xyz": light.camera_to_xyz}
    numbers = {"camera_px": np.array(light.camera_px), "step": np.array(light.step)}
    drive = light.drive
    levels = {"mask": drive.mask, "matrices": drive.matrices, "segment_share": drive.segment_share}
    indirect = {} if light.indirect is None else light.indirect.arrays()
    return own | numbers | levels | {f"indirect_{name}": part for name, part in indirect.items()}


def _read(file: Path) -> PreviewLight | None:
    """What an earlier service has kept; None if it is not there, damaged or of an earlier version."""
    from controller.optics.solve.reach.drive_levels import DriveLevels
    from controller.optics.transport.indirect.indirect_light import IndirectLight

    try:
        parts = load_arrays(file)
        drive = DriveLevels(parts["mask"], parts["matrices"], parts["segment_share"])
        width, height = map(int, parts["camera_px"])
        indirect = None
        if "indirect_grid" in parts:
            rows, columns, side = map(int, parts["indirect_grid"])
            indirect = IndirectLight(
                parts["indirect_factors"], parts["indirect_scale"], parts["indirect_lit"], (rows, columns), side,
                paint=parts.get("indirect_paint"),
            )  # fmt: skip
        return PreviewLight(
            drive, indirect, parts["black"], parts["camera_to_xyz"], (width, height), float(parts["step"])
        )
    except (UsageError, KeyError, ValueError):
        return None
