"""Files of published appearances: bundle, thumbnails, photographs, playback."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from controller.core.arrays import FloatImage, Mask, load_arrays, save_arrays
from controller.core.storage import sha256_of, write_atomically
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.names import json_path, npz_path, read_json, write_json
from controller.stage.artefacts.solved import solved_figures_path

BUNDLE: Final = "bundle.vel"
BUNDLE_FIGURES: Final = "bundle"


@dataclass(frozen=True, slots=True)
class BundleFigures:
    """``bundle.json``: the bundle's size in bytes, its compression factor, its path."""

    bytes: int
    ratio: float
    file: str
    names: tuple[str, ...]

    def write(self, run: Path) -> Path:
        return write_json(json_path(run, BUNDLE_FIGURES), asdict(self))

    @classmethod
    def read(cls, run: Path) -> BundleFigures:
        row = read_json(json_path(run, BUNDLE_FIGURES))
        return cls(int(row["bytes"]), float(row["ratio"]), str(row["file"]), tuple(row["names"]))


def write_playback(run: Path, figures: Mapping[str, Any]) -> Path:
    """``playback.json``: regularity of the swaps (docs/reference/report.md)."""
    return write_json(json_path(run, StepKind.PLAYBACK), figures)


def read_playback(run: Path) -> Any:
    """The content of ``write_playback``."""
    return read_json(json_path(run, StepKind.PLAYBACK))


def write_photograph(run: Path, kind: StepKind, name: str, picture: FloatImage) -> Path:
    """``photograph-NAME.npz`` or ``traditional-NAME.npz``: an appearance in HDR, full scales per second, linear."""
    path = npz_path(run, kind, name)
    save_arrays(path, {"photograph": np.asarray(picture, np.float32)})
    return path


def has_photograph(run: Path, kind: StepKind, name: str) -> bool:
    """Whether the run has that photograph."""
    return npz_path(run, kind, name).exists()


def read_photograph_of(run: Path, kind: StepKind, name: str) -> FloatImage:
    """(camera rows, columns, 3) float32, as ``write_photograph`` wrote it."""
    picture: FloatImage = load_arrays(npz_path(run, kind, name))["photograph"]
    return picture


@dataclass(frozen=True, slots=True)
class Dimmed:
    """``dimmed-NAME.npz``: an appearance by one projector alone, as bright as this projector can make it.

    ``photograph``, ``target`` (camera rows, columns, 3) float32 radiance; ``reachable`` (rows, columns): where that
    projector can make the target; ``exposure``: radiance of the target's white
    """

    photograph: FloatImage
    target: FloatImage
    reachable: Mask
    exposure: float

    def write(self, run: Path, name: str) -> Path:
        path = npz_path(run, StepKind.DIMMED, name)
        save_arrays(path, {"photograph": self.photograph, "target": self.target, "reachable": self.reachable,
                           "exposure": np.array(self.exposure)})  # fmt: skip
        return path

    @classmethod
    def read(cls, run: Path, name: str) -> Dimmed | None:
        """None for a run from before there was such a photograph."""
        path = npz_path(run, StepKind.DIMMED, name)
        if not path.exists():
            return None
        arrays = load_arrays(path)
        return cls(arrays["photograph"], arrays["target"], arrays["reachable"], float(arrays["exposure"]))


def read_thumbnail(run: Path, name: str) -> bytes | None:
    """The PNG file of an appearance's latest solve; None if there is none yet."""
    path = _thumbnail(run, name)
    return path.read_bytes() if path.exists() else None


def write_thumbnail(run: Path, name: str, png: bytes) -> None:
    """Keep it until the appearance is solved again, and remove the older ones."""
    for older in run.glob(f"thumbnail-{name}-{'[0-9a-f]' * 16}.png"):
        older.unlink()
    write_atomically(_thumbnail(run, name), png)


def _thumbnail(run: Path, name: str) -> Path:
    return run / f"thumbnail-{name}-{sha256_of(solved_figures_path(run, name))[:16]}.png"
