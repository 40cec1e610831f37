"""The grade files of a run, and what else its steps found; ``steps.calibrate.grade`` computes the grade."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from controller.core.arrays import ByteImage, load_arrays, save_arrays
from controller.core.storage import write_atomically
from controller.optics.calibrate.verify.grade import grade_of
from controller.run.step_id import StepId
from controller.stage.artefacts.names import json_path, read_json, write_json
from controller.stage.artefacts.views import view_folders
from hal.notices import Notice

PICTURE: Final = "verification.png"
"""The map of errors and their reasons, the projectors in rows of ``ACROSS``."""
ACROSS: Final = 3
"""A screen is wider than high."""
LEGEND: Final = 0.5
"""More than the height of a projector's legend, by its width."""
FIGURES: Final = "verification.json"
LIGHT_SHARE: Final = "light_share"
"""Among a projector's figures: its white light of that of all projectors, over the pixels that it lights."""
BEFORE, RESOLUTION = "before.png", "resolution.png"
"""Pictures of the report, for the panel: all projectors at white, and the finest metapixel at each pixel."""
_MAPS: Final = "verification.npz"
_ACCEPTED: Final = "accepted.json"
_TROUBLES: Final = "troubles"


@dataclass(frozen=True, slots=True)
class ErrorMaps:
    """Of one projector, (camera rows, columns).

    ``error`` float32: difference of photograph and prediction over the local light, NaN where not compared
    ``reasons``: the reason for the error (``calibrate.verify.error_attribution``)
    """

    error: npt.NDArray[Any]
    reasons: npt.NDArray[Any]


def in_rows(pictures: Sequence[ByteImage]) -> ByteImage:
    """Pictures of one size (rows, columns, 3) beside and below each other, the rest of the last row black."""
    across = min(ACROSS, len(pictures))
    missing = -len(pictures) % across
    filled = [*pictures, *[np.zeros_like(pictures[0])] * missing]
    rows = [np.concatenate(filled[n : n + across], axis=1) for n in range(0, len(filled), across)]
    return np.concatenate(rows, axis=0)


def parts_of(picture: ByteImage, count: int, camera: tuple[int, ...]) -> list[ByteImage]:
    """The ``count`` pictures that ``in_rows`` has put together, each as high as wide as ``camera`` (rows, columns), or

    higher by a legend. Before 0.2.0 they were all below each other.
    """
    across = min(ACROSS, count)
    height = len(picture) / -(-count // across) / (picture.shape[1] / across)
    if height > camera[0] / camera[1] + LEGEND:
        across = 1
    rows = np.split(picture, -(-count // across), axis=0)
    return [np.ascontiguousarray(one) for row in rows for one in np.split(row, across, axis=1)][:count]


def write_grade(
    run: Path, figures: Mapping[str, Mapping[str, Any]], maps: Mapping[str, ErrorMaps], picture: bytes
) -> list[Path]:
    """``verification.json``, ``.npz`` and ``.png``; ``figures`` and ``maps`` by projector name, ``picture`` a PNG.

    ``relative_rms`` among a projector's figures is a share, not per cent.
    """
    arrays = {f"error-{name}": one.error for name, one in maps.items()}
    arrays |= {f"reasons-{name}": one.reasons for name, one in maps.items()}
    save_arrays(run / _MAPS, arrays)
    write_atomically(run / PICTURE, picture)
    return [write_json(run / FIGURES, figures), run / _MAPS, run / PICTURE]


def is_graded(run: Path) -> bool:
    """Whether the run was graded; its file may still be damaged."""
    return (run / FIGURES).exists()


def read_grade_figures(run: Path) -> Any:
    """The content of ``verification.json``, by projector name; {} for a run that was not graded."""
    return read_json(run / FIGURES) if is_graded(run) else {}


def read_error_maps(run: Path) -> dict[str, ErrorMaps]:
    """By projector name, of a graded run."""
    arrays = load_arrays(run / _MAPS)
    return {name: ErrorMaps(arrays[f"error-{name}"], arrays[f"reasons-{name}"]) for name in read_grade_figures(run)}


def graded(run: Path) -> dict[str, float] | None:
    """Per cent of relative error by projector; None for a run that was not graded."""
    if not is_graded(run):
        return None
    return {name: 100 * float(row["relative_rms"]) for name, row in read_grade_figures(run).items()}


def errors_by_view(run: Path) -> dict[str, dict[str, float]]:
    """Per cent of error of each projector, by view; of those that were graded.

    Related to its light where it has most: in a view that sees only how it grazes the sides, a large error of its own
    light is a small one of all.
    """
    figures = {view: read_grade_figures(folder) for view, folder in view_folders(run).items()}
    shares: dict[str, list[float | None]] = {}
    for rows in figures.values():
        for name, row in rows.items():
            shares.setdefault(name, []).append(row.get(LIGHT_SHARE))

    def percent(name: str, row: Mapping[str, Any]) -> float:
        known = [share for share in shares[name] if share is not None]
        related = row[LIGHT_SHARE] / max(known) if len(known) == len(shares[name]) else 1.0
        return 100 * float(row["relative_rms"]) * related

    return {view: {name: percent(name, row) for name, row in rows.items()} for view, rows in figures.items() if rows}


def worst_letter(run: Path) -> str:
    """The grade of the worst projector in any view, "A" being the best."""
    worst = worst_of(run)
    return grade_of(math.nan if worst is None else worst[1] / 100).value


def worst_of(run: Path) -> tuple[str, float] | None:
    """The projector with the largest error in any view, in per cent; None for a run that was not graded."""
    return max(map(_worst, errors_by_view(run).values()), key=_percent, default=None)


def worst_view(run: Path) -> tuple[str, Path]:
    """The view with the largest error, and its folder; the first one, if none was graded."""
    rows, folders = errors_by_view(run), view_folders(run)
    view = max(rows, key=lambda view: _percent(_worst(rows[view])), default=next(iter(folders)))
    return view, folders[view]


def _worst(errors: Mapping[str, float]) -> tuple[str, float]:
    return max(errors.items(), key=_percent)


def _percent(row: tuple[str, float]) -> float:
    return math.inf if math.isnan(row[1]) else row[1]


def write_accepted(run: Path, projector: str, percent: float) -> Path:
    """``accepted.json``: a person accepted the run with this projector's error, in per cent."""
    return write_json(run / _ACCEPTED, {"projector": projector, "percent": percent})


def passes(run: Path, worst_grade: float) -> bool:
    """Whether a run's calibration may be used: good enough in each view, accepted by a person, or not graded yet."""
    worst = worst_of(run)
    return worst is None or worst[1] <= worst_grade or (run / _ACCEPTED).exists()


def write_troubles(run: Path, step: StepId, troubles: Iterable[Notice]) -> Path:
    """``troubles-STEP.json``; written without any, too, because an earlier try may have found some.

    Each notice has a code of ``TroubleCode``, and is about a projector, or "" for camera, object or several.
    """
    return write_json(json_path(run, _TROUBLES, str(step)), [trouble_row(trouble) for trouble in troubles])


def read_troubles(run: Path) -> list[Notice]:
    """Of all steps of a run, by the names of their files; none of a run of an earlier version."""
    rows = [row for path in sorted(run.glob(f"{_TROUBLES}-*.json")) for row in read_json(path)]
    return [Notice.warning(row.get("code") or "", row["sentence"], about=row["projector"] or "") for row in rows]


def trouble_row(trouble: Notice) -> dict[str, str | None]:
    """As in ``troubles-STEP.json`` and in report.json."""
    return {"sentence": trouble.what, "projector": trouble.about or None, "code": trouble.code or None}
