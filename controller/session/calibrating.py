"""The steps from photographs to a calibration: radiometry, correspondences and metapixels, geometry, grade."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from controller.arrays import Float64, FloatImage, Mask, load_arrays, save_arrays
from controller.calibrate.decode import decode
from controller.calibrate.geometry import reconstruct
from controller.calibrate.pixels import fit_pixels
from controller.calibrate.radiometry import measure_radiometry
from controller.calibrate.reconstruction import CameraPrior
from controller.calibrate.values import (
    Calibration,
    Correspondence,
    Geometry,
    PhaseMap,
    Pinhole,
    ProjectorCalibration,
    Radiometry,
)
from controller.capture.brackets import merge_brackets
from controller.capture.patterns import PatternPlan, plan_patterns
from controller.capture.raw import CAMERA_BLUR_PX
from controller.errors import CalibrationError
from controller.session import costs
from controller.session.camera_steps import camera_step
from controller.session.capturing import capture_steps, code_step
from controller.session.modes import mode_of, read_metapixels
from controller.session.rig import Rig, RigProjector
from controller.session.runner import Context, Step
from controller.session.shots import Developed, Taken, read_index
from controller.storage import write_atomically

LIT_SHARE = 0.004
"""A camera pixel counts as lit where a projector's white is above this share of the brightest white there is."""


def calibration_steps(rig: Rig, prior: CameraPrior, *, longest_exposure_s: float) -> list[Step]:
    """Everything from the first photograph to ``calibration.npz`` and ``geometry.npz``."""
    steps = capture_steps(rig, longest_exposure_s=longest_exposure_s)
    steps.append(camera_step(rig))
    names = [projector.name for projector in rig.projectors]
    for projector in rig.projectors:
        steps.append(_radiometry_step(projector))
        steps.append(code_step(rig, projector))
        steps.append(_pixels_step(projector))
    steps.append(
        Step(
            "geometry",
            lambda context: _reconstruct(rig, prior, context),
            inputs={"prior": repr(prior)},
            after=tuple(f"pixels-{name}" for name in names),
            title="Reconstructing the object and the poses",
            weight=costs.geometry_s(costs.scale(projector.size_px for projector in rig.projectors)),
        )
    )
    return steps


def _radiometry_step(projector: RigProjector) -> Step:
    plan = plan_patterns(projector.size_px)
    return Step(
        f"radiometry-{projector.name}",
        lambda context: _radiometry(projector, plan, context),
        after=("black", f"light-{projector.name}", "camera"),
        title=f"Measuring the response of {projector.name}",
        weight=costs.RADIOMETRY_S * costs.scale([projector.size_px]),
    )


def _pixels_step(projector: RigProjector) -> Step:
    plan = plan_patterns(projector.size_px)
    return Step(
        f"pixels-{projector.name}",
        lambda context: _pixels(projector, plan, context),
        after=("black", f"radiometry-{projector.name}", f"codes-{projector.name}"),
        title=f"Decoding {projector.name} and fitting its metapixels",
        weight=costs.PIXELS_S * costs.scale([projector.size_px]),
    )


def _merge(taken: Sequence[Taken]) -> FloatImage:
    """HDR radiance in full scales per second from photographs of one picture."""
    noise = taken[0].profile.noise if taken and taken[0].profile is not None else None
    return merge_brackets([t.read().measured() for t in taken], [t.exposure_s for t in taken], noise=noise).radiance


def read_black(folder: Path) -> FloatImage:
    """The HDR black image of a run, merged from its photographs."""
    return _merge(list(read_index(folder, "black").values()))


def _radiometry(projector: RigProjector, plan: PatternPlan, context: Context) -> Sequence[Path]:
    black = read_black(context.folder)
    taken = read_index(context.folder, f"light-{projector.name}")
    brackets = [item for name, item in taken.items() if name.startswith(f"{projector.name}-white-")]
    white = _merge(brackets)
    context.advance(0.5)
    captures = Developed(_unprefixed(taken, projector.name), {"black": black, "white": white})
    radiometry, report = measure_radiometry(captures, plan)
    path = context.folder / f"radiometry-{projector.name}.npz"
    matrix = brackets[0].read().camera_to_xyz
    save_arrays(
        path,
        {
            "response": radiometry.response,
            "mixing": radiometry.mixing,
            "white": np.maximum(white - black, 0).astype(np.float32),
            "black": black,
            "camera_to_xyz": _SRGB_TO_XYZ if matrix is None else matrix,
        },
    )
    figures = context.folder / f"radiometry-{projector.name}.json"
    write_atomically(figures, json.dumps(asdict(report), indent=1, default=list).encode())
    return [path, figures]


_SRGB_TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
"""IEC 61966-2-1; for a camera that does not tell its own colours."""


def _unprefixed(taken: dict[str, Taken], projector: str) -> dict[str, Taken]:
    return {name.removeprefix(f"{projector}-"): item for name, item in taken.items()}


def read_captures(folder: Path, projector: str) -> dict[str, Taken]:
    """All photographs of one projector's patterns, by the pattern's name."""
    both = {**read_index(folder, f"light-{projector}"), **read_index(folder, f"codes-{projector}")}
    return _unprefixed(both, projector)


def _pixels(projector: RigProjector, plan: PatternPlan, context: Context) -> Sequence[Path]:
    light = load_arrays(context.folder / f"radiometry-{projector.name}.npz")
    black = light["black"]
    taken = read_captures(context.folder, projector.name)
    captures = Developed(taken, {"black": black, "white": light["white"] + black})
    correspondence = decode(captures, plan, camera_blur_px=float(np.mean(np.square(CAMERA_BLUR_PX)) ** 0.5))
    if not correspondence.valid.any():
        raise CalibrationError(
            "projector-reaches-nothing",
            what=f"No pixel of projector {projector.name} was found on the object.",
            remedy="Check that it is aimed at the object, in focus, not blocked, and that the room is dark.",
        )
    context.advance(0.4, "correspondences")
    fitted = fit_pixels(captures, plan, correspondence)
    metapixels = fitted.metapixels
    path = context.folder / f"pixels-{projector.name}.npz"
    save_arrays(
        path,
        {
            "projector_px": correspondence.projector_px,
            "modulation": correspondence.modulation,
            "seen": correspondence.valid,
            "centre_px": metapixels.centre_px,
            "covariance_px2": metapixels.covariance_px2,
            "valid": metapixels.valid,
            "shown_px": fitted.phase_map.projector_px,
            "spread_px2": fitted.phase_map.spread_px2,
            "mosaic": np.zeros((0, 2), np.int64) if fitted.mosaic is None else fitted.mosaic,
        },
    )
    valid, seen = np.count_nonzero(metapixels.valid), np.count_nonzero(correspondence.valid)
    figures = context.folder / f"pixels-{projector.name}.json"
    content = {"fitted": int(valid), "pixels": int(metapixels.valid.size), "camera_pixels": int(seen)}
    write_atomically(figures, json.dumps(content, indent=1).encode())
    return [path, figures]


def read_correspondence(folder: Path, projector: str) -> Correspondence:
    """What the step ``pixels-NAME`` decoded."""
    arrays = load_arrays(folder / f"pixels-{projector}.npz")
    return Correspondence(arrays["projector_px"], arrays["modulation"], arrays["seen"])


def _reconstruct(rig: Rig, prior: CameraPrior, context: Context) -> Sequence[Path]:
    correspondences = [read_correspondence(context.folder, projector.name) for projector in rig.projectors]
    rows, columns = correspondences[0].valid.shape
    found = reconstruct(
        correspondences,
        (columns, rows),
        [projector.size_px for projector in rig.projectors],
        prior,
        progress=lambda fraction: context.advance(fraction, "geometry"),
    )
    geometry = found.geometry
    arrays, figures = context.folder / "geometry.npz", context.folder / "geometry.json"
    save_arrays(arrays, {"points_m": geometry.points_m, "normals": geometry.normals, "sigma_m": found.sigma_m})
    poses = {
        "camera": _pinhole(geometry.camera),
        "projectors": {p.name: _pinhole(q) for p, q in zip(rig.projectors, geometry.projectors, strict=True)},
        "reprojection_rms_px": geometry.reprojection_rms_px,
        "scale_known": geometry.scale_known,
        "noise_px": found.noise_px,
        "shape_rel_sigma": found.shape_rel_sigma,
        "inlier_share": found.inlier_share,
        "scale_rel_sigma": found.scale_rel_sigma if geometry.scale_known else None,
        "parameters": list(found.parameter_names),
        "covariance": found.covariance.tolist(),
    }
    write_atomically(figures, json.dumps(poses, indent=1).encode())
    return [arrays, figures]


def _pinhole(pinhole: Pinhole) -> dict[str, object]:
    return {
        "matrix": pinhole.matrix.tolist(),
        "distortion": pinhole.distortion.tolist(),
        "rotation": pinhole.rotation.tolist(),
        "translation_m": pinhole.translation_m.tolist(),
        "size_px": list(pinhole.size_px),
    }


def read_geometry(folder: Path) -> Geometry:
    """The geometry that a finished run left in ``folder``."""
    arrays = load_arrays(folder / "geometry.npz")
    poses = json.loads((folder / "geometry.json").read_text())

    def pinhole(row: dict[str, Any]) -> Pinhole:
        keys = ("matrix", "distortion", "rotation", "translation_m")
        matrix, distortion, rotation, translation_m = (np.array(row[key], np.float64) for key in keys)
        width, height = row["size_px"]
        return Pinhole(matrix, distortion, rotation, translation_m, (int(width), int(height)))

    return Geometry(
        camera=pinhole(poses["camera"]),
        projectors=tuple(pinhole(row) for row in poses["projectors"].values()),
        points_m=arrays["points_m"],
        normals=arrays["normals"],
        reprojection_rms_px=float(poses["reprojection_rms_px"]),
        scale_known=bool(poses["scale_known"]),
    )


def read_calibration(folder: Path, projectors: Sequence[str]) -> Calibration:
    """The calibration that a finished run left in ``folder``."""
    parts = []
    for name in projectors:
        light = load_arrays(folder / f"radiometry-{name}.npz")
        metapixels = read_metapixels(folder, name)
        radiometry = Radiometry(light["response"], light["mixing"])
        phase_map, mosaic = read_phase_map(folder, name)
        parts.append(ProjectorCalibration(name, metapixels, radiometry, np.nan_to_num(light["white"]), phase_map))
    black = np.nan_to_num(light["black"])
    camera_to_xyz: Float64 = light["camera_to_xyz"]
    red, green, blue = CAMERA_BLUR_PX
    camera_blur_px = (red, green, blue)
    return Calibration(tuple(parts), black, object_mask(parts), camera_to_xyz, camera_blur_px, mosaic)


def read_phase_map(folder: Path, projector: str) -> tuple[PhaseMap | None, npt.NDArray[np.int64] | None]:
    """A projector's phase map and the camera's mosaic; None where the run has none, or its metapixels are from dots."""
    pixels = load_arrays(folder / f"pixels-{projector}.npz")
    if mode_of(folder) == "paper" or "spread_px2" not in pixels:
        return None, None
    mosaic = pixels["mosaic"] if pixels["mosaic"].size else None
    return PhaseMap(pixels["shown_px"], pixels["spread_px2"]), mosaic


def object_mask(parts: Sequence[ProjectorCalibration]) -> Mask:
    """Camera pixels that some projector lights noticeably in every channel."""
    brightest = max(float(np.percentile(part.white, 99.9)) for part in parts)
    masks = [part.white.min(axis=2) > LIT_SHARE * brightest for part in parts]
    lit: Mask = np.logical_or.reduce(masks)
    return lit
