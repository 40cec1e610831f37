"""What the documentation's scripts read, small and made up: a calibrated run, photographs of patterns, a bracket."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from controller.core.arrays import save_arrays
from controller.stage.artefacts.photographs import BLACK, TakenPhotograph, captures_folder, light_of
from controller.stage.artefacts.solved import Solved
from controller.stage.services.export import export
from tests.controller.api.test_photographs import write_captures
from tests.controller.optics.capture.test_raw import RGGB, mosaic_of, write_dng
from tests.controller.optics.solve.conftest import plane_calibration

CAMERA = (60, 80)
"""(rows, columns), as ``plane_calibration`` has it."""


def write_run(run: Path) -> None:
    """The folder of a finished, graded calibration with two projectors before a wall."""
    run.mkdir(parents=True)
    calibration = plane_calibration(camera=CAMERA)
    names = ["left", "right"]
    for name, part in zip(names, calibration.projectors, strict=True):
        light: dict[str, npt.NDArray[Any]] = {
            "response": part.radiometry.response,
            "mixing": part.radiometry.mixing,
            "white": part.white,
        }
        light |= {"black": calibration.black, "camera_to_xyz": calibration.camera_to_xyz}
        save_arrays(run / f"radiometry-{name}.npz", light)
        pixels = part.metapixels
        arrays = {"centre_px": pixels.centre_px, "covariance_px2": pixels.covariance_px2, "valid": pixels.valid}
        arrays |= {"projector_px": np.zeros((*CAMERA, 2), np.float32), "modulation": np.ones(CAMERA, np.float32)}
        save_arrays(run / f"pixels-{name}.npz", arrays | {"seen": np.ones(CAMERA, np.bool_)})
    y, x = np.mgrid[0 : CAMERA[0], 0 : CAMERA[1]]
    points = np.stack([(x - 40) / 90, (y - 30) / 90, np.ones(CAMERA)], axis=-1).astype(np.float32)
    normals = np.broadcast_to(np.array([0, 0, -1], np.float32), points.shape)
    save_arrays(run / "geometry.npz", {"points_m": points, "normals": np.ascontiguousarray(normals)})
    poses = {"camera": _pinhole(0.0), "projectors": {name: _pinhole(0.1 * n) for n, name in enumerate(names)}}
    (run / "geometry.json").write_text(json.dumps(poses | {"reprojection_rms_px": 0.03, "scale_known": True}))
    grade = {name: {"relative_rms": 0.012, "grade": "A", "reasons": []} for name in names}
    (run / "verification.json").write_text(json.dumps(grade))


def write_full_run(run: Path) -> None:
    """``write_run`` with photographs (one black, two exposures of the left projector's white) and an appearance."""
    write_run(run)
    y, x = np.mgrid[0 : CAMERA[0], 0 : CAMERA[1]]
    scene = np.stack([0.5 + x / 96, 1 + 0.5 * y / 64, np.full(x.shape, 0.8)], axis=-1)
    for of, names in ((BLACK, {"black": (0.01, 1.0)}), (light_of("left"), {"white-0": (1, 0.1), "white-1": (1, 0.4)})):
        taken = []
        for name, (light, exposure_s) in names.items():
            folder = captures_folder(run, of.shot(name))
            folder.mkdir(parents=True, exist_ok=True)
            write_dng(folder / f"{name}.dng", mosaic_of(np.minimum(light * scene * exposure_s, 1.0), RGGB))
            taken.append(TakenPhotograph(name, folder / f"{name}.dng", exposure_s, projector=of.projector))
        of.write(run, taken)
    rng = np.random.default_rng(5)
    frames = {name: rng.integers(0, 256, (20, 26, 3), dtype=np.uint8) for name in ("left", "right")}
    linear = {name: np.asarray(frame / 255, np.float32) for name, frame in frames.items()}
    reachable = (y * CAMERA[1] + x) % 3 > 0
    target = np.full((*CAMERA, 3), 0.5, np.float32)
    Solved(frames, linear, target, reachable, {"name": "gold", "title": "Gold", "exposure": 2.0}).write(run, "gold")


def _pinhole(right_m: float) -> dict[str, object]:
    return {
        "matrix": [[90.0, 0.0, 40.0], [0.0, 90.0, 30.0], [0.0, 0.0, 1.0]],
        "distortion": [0.0, 0.0],
        "rotation": np.eye(3).tolist(),
        "translation_m": [-right_m, 0.0, 0.0],
        "size_px": [CAMERA[1], CAMERA[0]],
    }


def write_all(folder: Path) -> None:
    """Everything, at the places that the scripts name."""
    stage = folder / "demo" / "first" / "stage"
    run = stage / "runs" / "20260101-000000-recalibrate"
    write_run(run)
    write_captures(folder / "photographs")
    write_full_run(folder / "packed" / "run")
    export(run=folder / "packed" / "run", kind="dataset", out=folder / "dataset", step=None)
    (folder / "bracket").mkdir()
    y, x = np.mgrid[0:64, 0:96]
    scene = np.stack([0.5 + 4 * x / 96, 1 + 2 * y / 64, np.full(x.shape, 1.5)], axis=-1)
    for name, exposure_s in (("short", 1 / 60), ("middle", 1 / 15), ("long", 1 / 4)):
        write_dng(folder / "bracket" / f"{name}.dng", mosaic_of(np.minimum(scene * exposure_s, 1.0), RGGB))
