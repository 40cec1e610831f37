"""A run as a research dataset: open formats only, a list of checksums, and a README that explains every file."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from controller.bundle.describe import png
from controller.core.errors import UsageError
from controller.core.storage import sha256_of, write_atomically
from controller.optics.capture.linear_files import exr_bytes
from controller.optics.capture.profile import load_profile, true_exposure
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.names import read_json, safe_name
from controller.stage.artefacts.photographs import Taken
from controller.stage.artefacts.published import has_photograph, read_photograph_of
from controller.stage.artefacts.solved import read_solved
from controller.stage.exchange.content import Content
from controller.stage.exchange.dataset_readme import README

SUMS, INDEX = "SHA256SUMS", "index.json"
MEASURED: Final = (
    StepKind.GEOMETRY, StepKind.RADIOMETRY, StepKind.PIXELS, StepKind.INDIRECT, StepKind.DOTS, StepKind.METAPIXELS,
    StepKind.EDGES, StepKind.EDGE_TERMS, StepKind.CAMERA, StepKind.EXPOSURE, StepKind.DELAY, "verification",
)  # fmt: skip
"""Kinds of files that are copied to calibration/."""


@dataclass(frozen=True, slots=True)
class _Photograph:
    kind: str
    taken: Taken


def write_dataset(content: Content, folder: Path) -> dict[str, int]:
    """Pack photographs, calibration, targets and results of the content's run into ``folder``.

    Raises UsageError("dataset-exists") where the folder holds something, WorkError("no-space", "cannot-write"), and as
    the reader of photographs.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(
            "dataset-exists",
            what=f"{folder} exists already.",
            remedy="Remove it, or name another folder with --out.",
        )
    run = content.folder
    photographs = [_pack(photograph, run, folder) for photograph in _photographs(run)]
    measured = [_copy(path, folder / "calibration" / path.name) for path in _measured(run)]
    appearances = [_appearance(run, name, content.names, folder) for name in _solved(run)]
    index = {
        "run": run.name,
        "camera_px": list(content.geometry.camera.size_px),
        "projectors": [
            {"name": name, "projector_px": list(own.size_px), "stem": safe_name(name)}
            for name, own in zip(content.names, content.geometry.projectors, strict=True)
        ],
        "photographs": photographs,
        "calibration": [str(path.relative_to(folder)) for path in measured],
        "appearances": appearances,
    }
    write_atomically(folder / INDEX, (json.dumps(index, indent=1, ensure_ascii=False) + "\n").encode())
    write_atomically(folder / "README.md", README.encode())
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    lines = [f"{sha256_of(path)}  {path.relative_to(folder)}\n" for path in files]
    write_atomically(folder / SUMS, "".join(lines).encode())
    return {"photographs": len(photographs), "appearances": len(appearances), "files": len(files) + 1}


def _photographs(run: Path) -> Iterator[_Photograph]:
    """All photographs that an index in the run lists, each once."""
    profile, known = load_profile(run), set[Path]()
    for file in sorted(run.glob("*.json")):
        rows = read_json(file)
        if not isinstance(rows, list) or not all(isinstance(row, dict) and "path" in row for row in rows):
            continue
        for row in rows:
            path = run / row["path"]
            if path in known:
                continue
            known.add(path)
            seconds = true_exposure(profile, float(row["exposure_s"]))
            taken = Taken(row["name"], path, seconds, profile=profile, projector=row.get("projector"))
            yield _Photograph(path.parent.name, taken)


def _pack(photograph: _Photograph, run: Path, folder: Path) -> Mapping[str, Any]:
    """The camera's own file, and its linear light as an EXR of 16-bit floats."""
    taken = photograph.taken
    original = _copy(taken.path, folder / "originals" / photograph.kind / taken.path.name)
    light = folder / "photographs" / photograph.kind / f"{taken.path.stem}.exr"
    write_atomically(light, exr_bytes({"RGB": taken.measured()}, half=True))
    return {
        "name": taken.name,
        "kind": photograph.kind,
        "projector": taken.projector,
        "exposure_s": taken.exposure_s,
        "file": str(light.relative_to(folder)),
        "original": str(original.relative_to(folder)),
    }


def _measured(run: Path) -> list[Path]:
    files = sorted(path for suffix in ("npz", "json") for path in run.glob(f"*.{suffix}"))
    return [path for path in files if any(path.stem == kind or path.stem.startswith(f"{kind}-") for kind in MEASURED)]


def _solved(run: Path) -> list[str]:
    """Names of the appearances in the run, as their figures say them."""
    found = (read_json(path) for path in sorted(run.glob(f"{StepKind.APPEARANCE}-*.json")))
    return [str(figures["name"]) for figures in found if "name" in figures]


def _appearance(run: Path, name: str, projectors: Sequence[str], folder: Path) -> Mapping[str, Any]:
    solved = read_solved(run, name, projectors)
    own = folder / "appearances" / safe_name(name)
    target = dict(zip("RGB", np.moveaxis(solved.target, 2, 0), strict=True))
    write_atomically(own / "target.exr", exr_bytes(target | {"A": solved.reachable}))
    frames = {}
    for projector in projectors:
        path = own / f"frame-{safe_name(projector)}.png"
        write_atomically(path, png(solved.frames[projector]))
        frames[projector] = str(path.relative_to(folder))
    photograph = None
    if has_photograph(run, StepKind.PHOTOGRAPH, name):
        path = own / "photograph.exr"
        write_atomically(path, exr_bytes({"RGB": read_photograph_of(run, StepKind.PHOTOGRAPH, name)}))
        photograph = str(path.relative_to(folder))
    return {
        "name": name,
        "target": str((own / "target.exr").relative_to(folder)),
        "frames": frames,
        "photograph": photograph,
        "figures": solved.figures,
    }


def _copy(path: Path, to: Path) -> Path:
    to.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, to)
    return to
