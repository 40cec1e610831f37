"""Reads from the runs' folders how well photographed appearances match their targets.

``steps.appearance.compare`` writes them.

It imports little: the kiosk uses it while it plays, without the calibration code.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from controller.stage.artefacts.names import json_path, npz_path, read_json, write_json

if TYPE_CHECKING:
    import numpy.typing as npt

COMPARE: Final = "compare"
"""Name of such runs; their folders' names end with it."""
PICTURES: Final = ("before", "target", "achieved", "error", "resolution")
MOST: Final = 50
"""Number of newest runs that are read."""
_KIND: Final = "compared"


@dataclass(frozen=True, slots=True)
class Compared:
    """One appearance in one run: when it was photographed, the run of its ``calibration``, and the differences.

    ``delta_e00_median``, ``delta_e00_p95``: CIEDE2000; ``rmse`` of the target's white; ``sharpness_lambda`` 0 to 1
    (paper 6, eq. 9), all over the reachable pixels of the object; ``reachable_share`` of its pixels, if it is known;
    ``window_px`` the side of the resolution map's windows, camera pixels; ``refined`` what refining it achieved;
    ``pixels`` the differences by sets of pixels, ``ghosting`` the object's own pattern in it, ``adapted`` how near it
    is to its adapted target, ``held_back`` how many times as bright white could be without the darkest small part of
    the object (docs/reference/report.md); None in runs from before they were measured
    """

    run: str
    name: str
    title: str
    calibration: str
    photographed_unix_s: float
    delta_e00_median: float
    delta_e00_p95: float
    rmse: float
    sharpness_lambda: float
    reachable_share: float | None
    window_px: int
    refined: Any = None
    pixels: Any = None
    ghosting: Any = None
    adapted: Any = None
    held_back: Any = None

    @property
    def whole(self) -> tuple[float, float] | None:
        """Median and 95th percentile on the whole visible object; None in runs from before they were measured."""
        try:
            seen = self.pixels["visible"]
            return float(seen["delta_e00_median"]), float(seen["delta_e00_p95"])
        except (TypeError, KeyError, ValueError):
            return None

    @property
    def headline(self) -> tuple[float, float]:
        """``whole``, or else those of the pixels in reach."""
        return self.whole or (self.delta_e00_median, self.delta_e00_p95)


@dataclass(frozen=True, slots=True)
class ComparedImages:
    """``compared-NAME.npz``, of the camera's picture.

    ``photograph`` (rows, columns, 3) float32: full scales per second, linear
    ``error`` (rows, columns) float16: CIEDE2000, NaN where not compared
    ``resolution``: the resolution map, one value for each of its windows
    """

    photograph: npt.NDArray[Any]
    error: npt.NDArray[Any]
    resolution: npt.NDArray[Any]


def write_compared(run: Path, one: Compared, images: ComparedImages) -> list[Path]:
    """``compared-NAME.json`` and ``.npz``."""
    from controller.core.arrays import save_arrays

    figures = {key: value for key, value in asdict(one).items() if key != "run"}
    parts = {"photograph": images.photograph, "error": images.error, "resolution": images.resolution}
    arrays = npz_path(run, _KIND, one.name)
    save_arrays(arrays, parts)
    return [write_json(json_path(run, _KIND, one.name), figures), arrays]


def read_images(run: Path, name: str) -> ComparedImages:
    """The result of ``write_compared`` for an appearance."""
    from controller.core.arrays import load_arrays

    return ComparedImages(**load_arrays(npz_path(run, _KIND, name)))


def picture_path(run: Path, name: str, picture: str) -> Path:
    """``picture``: one of ``PICTURES``."""
    return run / f"{_KIND}-{name}-{picture}.jpg"


def compared_in(run: Path) -> tuple[Compared, ...]:
    """The results of a run, by name; unreadable files are skipped."""
    found = []
    for path in sorted(run.glob(f"{_KIND}-*.json")):
        try:
            content: dict[str, Any] = read_json(path)
            found.append(Compared(run=run.name, **content))
        except (OSError, ValueError, TypeError):
            continue
    return tuple(found)


def all_compared(stage: Path) -> dict[Path, tuple[Compared, ...]]:
    """The newest runs with photographs, oldest first, at most ``MOST``, each with its results.

    A run is read again only when its folder has changed, because the kiosk asks every few seconds.
    """
    folders = sorted((stage / "runs").glob(f"*-{COMPARE}"))[-MOST:]
    held = {folder: _remembered(folder, folder.stat().st_mtime_ns) for folder in folders}
    return {folder: found for folder, found in held.items() if found}


@lru_cache(maxsize=4 * MOST)
def _remembered(run: Path, changed_ns: int) -> tuple[Compared, ...]:
    return compared_in(run)


def history_of(stage: Path, names: Collection[str]) -> dict[str, tuple[Compared, ...]]:
    """Each of these appearances with its results, oldest first; without those that were never photographed."""
    found: dict[str, list[Compared]] = {}
    for known in all_compared(stage).values():
        for comparison in known:
            if comparison.name in names:
                found.setdefault(comparison.name, []).append(comparison)
    return {name: tuple(found[name]) for name in names if name in found}


def pictures_of(stage: Path, one: Compared) -> dict[str, Path]:
    """Its pictures in the run, by ``PICTURES``."""
    run = stage / "runs" / one.run
    files = {picture: picture_path(run, one.name, picture) for picture in PICTURES}
    return {picture: file for picture, file in files.items() if file.exists()}
