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
from controller.stage.artefacts.photographs import TakenPhotograph
from controller.stage.artefacts.published import has_photograph, read_photograph_of
from controller.stage.artefacts.solved import read_solved
from controller.stage.exchange.content import Content

SUMS, INDEX = "SHA256SUMS", "index.json"
MEASURED: Final = (
    StepKind.GEOMETRY, StepKind.RADIOMETRY, StepKind.PIXELS, StepKind.INDIRECT, StepKind.DOTS, StepKind.METAPIXELS,
    StepKind.CAMERA, StepKind.EXPOSURE, StepKind.DELAY, "verification",
)  # fmt: skip
"""Kinds of files that are copied to calibration/."""


@dataclass(frozen=True, slots=True)
class _Photograph:
    kind: str
    taken: TakenPhotograph


def write_dataset(content: Content, folder: Path) -> dict[str, int]:
    """Pack photographs, calibration, targets and results of the content's run into ``folder``.

    Raises UsageError("dataset-exists") where the folder holds something, WorkError("no-space", "cannot-write"), and as
    the reader of photographs.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(
            "dataset-exists", what=f"{folder} exists already.", remedy="Remove it, or name another folder with --out."
        )
    run = content.folder
    photographs = [_pack(photograph, run, folder) for photograph in _photographs(run)]
    measured = [_copy(path, folder / "calibration" / path.name) for path in _measured(run)]
    appearances = [_appearance(run, name, content.names, folder) for name in _solved(run)]
    index = {
        "run": run.name,
        "camera_px": list(content.camera_px),
        "projectors": [
            {"name": name, "projector_px": list(size_px), "stem": safe_name(name)}
            for name, size_px in zip(content.names, content.sizes_px, strict=True)
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
            taken = TakenPhotograph(row["name"], path, seconds, profile=profile, projector=row.get("projector"))
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


README: Final = """# A Velatura run as a dataset

Everything here opens with numpy (`.npz`, without pickle), OpenEXR (`.exr`), matplotlib (`.png`) and a JSON reader.
`SHA256SUMS` lists all other files: `sha256sum -c SHA256SUMS`. `index.json` lists photographs, projectors and results.

Light is linear everywhere. Pictures are (rows, columns, 3), red, green, blue. Positions are x, y in pixels, and the
centre of the first pixel is (0, 0). Lengths are metres, in the camera's frame: x right, y down, z forward.

## Photographs

| folder | what |
|---|---|
| `originals/KIND/` | the camera's own files |
| `photographs/KIND/` | the same as linear light: 0 black level, 1 full scale, NaN saturated; 16-bit floats |

KIND is the kind of the photographs, and the projector that was lit. In `index.json` each has its pattern (`name`), its
`projector` (null: none or all), its `exposure_s` (seconds, as measured), its `file` and its `original`. A picture
divided by its exposure is in full scales per second, the unit of all other light here.

`gray-x-N` and `gray-y-N` are Gray code of cells 12 projector pixels wide, coarsest bit first. `phase-*` are sinusoids
of 24 pixels in three steps; `blur-*` are finer ones. With few photographs (`patterns-NAME.json`), `gray-rgb-N` hold
three bits each, and sinusoids have two steps, a quarter of a period apart.
`mosaic-*` are coloured tiles. `random-*` pictures only check the
result.

## Calibration

A projector's name stands for NAME.

| file | arrays |
|---|---|
| `geometry.npz` | `points_m`, `normals` (camera rows, columns, 3), NaN unknown; `sigma_m` along the camera's ray |
| `geometry.json` | each view: `matrix`, `distortion` (k1, k2, p1, p2), `rotation`, `translation_m`, `size_px` |
| `radiometry-NAME.npz` | `white` of this projector alone, `black`; `response` (3, 256); `mixing` |
| `pixels-NAME.npz` | `projector_px` of camera pixels where `seen`; of projector pixels `centre_px`, `covariance_px2` |
| | `colours_px` (3, 2): how far red, green and blue lie to the right and below, where they do not lie on each other |
| `dots-NAME.npz` | the same spots, measured by dots, where the run has them |
| `camera.npz` | measurements of the camera |
| `indirect-NAME.npz` | light that came by way of other surfaces, where it was measured |
| `exposure.json`, `delay.json` | seconds: exposures of the photographs, delay of the projectors' pictures |
| `verification.json`, `verification.npz` | the grade: the error of a prediction for pictures that were not used |

A point X of the object lies in a view at K d([R | t] X), with OpenCV's d in normalised coordinates.

## Appearances

`appearances/NAME/target.exr` is the light that was wanted (alpha 1: it could be reached). `frame-PROJECTOR.png` is what
the projector showed, 8-bit device values. `photograph.exr` is the result in HDR, where one was taken. `figures` in
`index.json` are those of the solve.
"""
