"""Where each projector stands around the object, seen from the camera: from the poses of the newest calibration."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from controller.core.arrays import Float64
from controller.core.errors import VelaturaError
from controller.kiosk.state import Place
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.names import json_path, read_json
from controller.stage.sessions.calibrations import finished_calibrations

ASIDE_DEG: Final = 12.0
"""Nearer to the camera's direction than this, a projector is in front, neither left nor right."""
BEHIND_DEG: Final = 110.0
LEAST_CROSSING: Final = 0.02
"""Of the axes: camera and one projector 12 degrees apart. Nearly parallel ones meet anywhere."""
_UNREADABLE: Final = (VelaturaError, OSError, ValueError, KeyError, TypeError, AttributeError, np.linalg.LinAlgError)


def places(stage: Path) -> tuple[Place, ...]:
    """One for each projector, in the run's order; empty without a finished calibration that can be read."""
    try:
        run = next(iter(finished_calibrations(stage)), None)
        return () if run is None else _placed(read_json(json_path(run, StepKind.GEOMETRY)))
    except _UNREADABLE:
        return ()


def _placed(figures: Mapping[str, Any]) -> tuple[Place, ...]:
    centres, axes = [np.zeros(3)], [np.array([0.0, 0.0, 1.0])]
    for row in figures["projectors"].values():
        rotation, shift = np.array(row["rotation"], float), np.array(row["translation_m"], float)
        width, height = row["size_px"]
        middle = np.linalg.solve(np.array(row["matrix"], float), np.array([width / 2, height / 2, 1.0]))
        centres.append(-rotation.T @ shift)
        axes.append(rotation.T @ middle / np.linalg.norm(middle))
    on = _where_they_meet(centres, axes)
    if on is None or not np.isfinite([on, *centres]).all():
        return ()
    return tuple(
        _place(name, centre - on, -on) for name, centre in zip(figures["projectors"], centres[1:], strict=True)
    )


def _where_they_meet(centres: list[Float64], axes: list[Float64]) -> Float64 | None:
    """The point (3,) nearest to all axes: all devices look at the object. None where the axes do not say where."""
    across = [np.eye(3) - np.outer(axis, axis) for axis in axes]
    right = sum((part @ centre for part, centre in zip(across, centres, strict=True)), np.zeros(3))
    whole = np.sum(across, axis=0)
    if np.linalg.eigvalsh(whole)[0] < LEAST_CROSSING:
        return None
    on = np.asarray(np.linalg.solve(whole, right), np.float64)
    in_front = all((on - centre) @ axis > 0 for centre, axis in zip(centres, axes, strict=True))
    return on if in_front else None


def _place(name: str, from_object: Float64, camera: Float64) -> Place:
    """``from_object`` (3,) and ``camera`` (3,): both from the object, metres, in the camera's frame (y down)."""
    turned = math.atan2(camera[0], -camera[2])
    aside = math.degrees(math.atan2(from_object[0], -from_object[2]) - turned)
    aside = (aside + 180) % 360 - 180
    up = math.degrees(math.atan2(-from_object[1], math.hypot(from_object[0], from_object[2])))
    return Place(name, _word(aside, up), aside, up)


def _word(aside_deg: float, up_deg: float) -> str:
    depth = "behind" if abs(aside_deg) > BEHIND_DEG else ""
    side = "" if abs(aside_deg) < ASIDE_DEG else "left" if aside_deg < 0 else "right"
    height = "" if abs(up_deg) < ASIDE_DEG else "above" if up_deg > 0 else "below"
    return " ".join(filter(None, (depth, side, height))) or "in front"
