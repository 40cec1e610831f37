"""A drift in words for the technician, and as JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from controller.optics.calibrate.verify.drift import Drift, DriftCause, ProjectorDrift
from controller.optics.calibrate.verify.registration import Motion

LARGEST_DIM = 0.5
"""A projector that lost more light than this needs service, not a correction."""


def advice(drift: Drift) -> str:
    """What to do: "nothing", "quick" (a correction or the codes of some projectors), "full", or "look" (a person)."""
    if any(projector.light_share < 1 - LARGEST_DIM for projector in drift.projectors if not projector.known):
        return "look"
    if drift.culprit is not DriftCause.NONE:
        return "full"
    return "nothing" if drift.nothing else "quick"


_DO = {
    "nothing": "The calibration is still valid; no action is needed.",
    "quick": "Run `velatura calibrate --quick` to correct this.",
    "full": "Run a full calibration to correct this: `velatura calibrate`.",
    "look": "Check the dark projector first (lamp, shutter, lens cap, cable), then check for drift again.",
}


def sentences(drift: Drift) -> list[str]:
    """What has changed, most important first, and at the end what to do."""
    lines = [*_whole(drift), *(line for projector in drift.projectors for line in _of_projector(projector))]
    if drift.ambient_changed:
        more = "more" if drift.ambient_share > 0 else "less"
        lines.append(
            f"There is {more} ambient light: {100 * abs(drift.ambient_share):.1f} % of white "
            f"({drift.ambient_ratio:.2g} times the black image of the calibration)."
        )
    return [*lines, _DO[advice(drift)]]


def _whole(drift: Drift) -> list[str]:
    camera = drift.camera
    if drift.culprit is DriftCause.NONE:
        return []
    if not camera.found:
        return [
            "The object was not recognised in the photograph with all projectors at white. It or the camera "
            "moved by more than a fifth of the picture, or light is missing."
        ]
    by = f"by {camera.rms_px:.2f} camera px rms ({_shift(camera)})"
    if drift.culprit is DriftCause.CAMERA:
        return [f"The camera has moved: the object and the projected light shifted together, {by}."]
    if drift.culprit is DriftCause.OBJECT:
        return [
            f"The object has moved: its picture shifted {by}, and every pattern lies elsewhere on it. (A common "
            "motion of camera and projectors would look the same.)"
        ]
    return [f"The object's picture shifted {by}; the check can't decide whether the camera or the object moved."]


def _shift(motion: Motion) -> str:
    x, y = motion.shift_px
    parts = [f"{x:+.2f}, {y:+.2f} ± {max(motion.sigma_px, 0.01):.2f} px in the middle"]
    if abs(motion.rotation_deg) > max(0.02, 3 * motion.rotation_sigma_deg):
        parts.append(f"rotated {motion.rotation_deg:+.2f}°")
    if abs(motion.scale - 1) > max(0.0005, 3 * motion.scale_sigma):
        parts.append(f"{100 * (motion.scale - 1):+.2f} % in size")
    return ", ".join(parts)


def _of_projector(projector: ProjectorDrift) -> list[str]:
    if not projector.known:
        if projector.light_share < 1 - LARGEST_DIM:
            return [
                f"Projector {projector.name} is dark: {100 * max(projector.light_share, 0):.0f} % of its light "
                "reaches the camera."
            ]
        return [
            f"The picture of projector {projector.name} was not recognised. It moved by more than a fifth of its "
            "size, is covered, or is out of focus."
        ]
    lines = []
    if projector.moved:
        motion = f"{projector.motion.rms_px:.2f} projector px rms ({_shift(projector.motion)})"
        parts = f", and not as a whole: parts of it moved up to {projector.local_px:.1f} px differently"
        lines.append(
            f"The picture of projector {projector.name} moved by {motion}{'' if projector.turned_only else parts}."
        )
    if projector.dimmed:
        changes = ", ".join(
            f"{colour} {100 * (gain - 1):+.1f} ± {max(100 * sigma, 0.1):.1f} %"
            for colour, gain, sigma in zip(("red", "green", "blue"), projector.gain, projector.gain_sigma, strict=True)
        )
        word = "dimmed" if np.mean(projector.gain) < 1 else "brighter"
        lines.append(f"Projector {projector.name} is {word}: {changes}.")
    return lines


def drift_to_json(drift: Drift, *, calibration: str, photographs: int) -> dict[str, Any]:
    """For ``drift.json``. A figure that is unknown is null; so is ``culprit`` where neither camera nor object moved."""
    content = {
        "calibration": calibration,
        "photographs": photographs,
        "advice": advice(drift),
        "sentences": sentences(drift),
        "culprit": None if drift.culprit is DriftCause.NONE else drift.culprit.value,
        "camera": {**_motion(drift.camera), "moved": drift.culprit in (DriftCause.CAMERA, DriftCause.UNKNOWN)},
        "ambient_share": drift.ambient_share,
        "ambient_ratio": drift.ambient_ratio,
        "projectors": {
            projector.name: {
                **_motion(projector.motion),
                "moved": projector.moved,
                "turned_only": projector.turned_only,
                "dimmed": projector.dimmed,
                "gain": list(projector.gain),
                "gain_sigma": list(projector.gain_sigma),
                "local_px": projector.local_px,
                "light_share": projector.light_share,
            }
            for projector in drift.projectors
        },
    }
    return {key: _plain(value) for key, value in content.items()}


def _motion(motion: Motion) -> dict[str, Any]:
    return {**asdict(motion), "matrix": motion.matrix.tolist()}


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _cause(said: str | None) -> DriftCause:
    return DriftCause.NONE if said in (None, "nobody") else DriftCause(said)  # ``nobody``: files from before 0.2.0


def drift_from_json(content: Mapping[str, Any]) -> Drift:
    """What ``drift_to_json`` made."""
    return Drift(
        projectors=tuple(
            ProjectorDrift(
                name, _motion_of(row), _three(row["gain"]), _three(row["gain_sigma"]),
                _number(row["local_px"]), _number(row["light_share"]),
            )
            for name, row in content["projectors"].items()
        ),
        camera=_motion_of(content["camera"]),
        culprit=_cause(content["culprit"]),
        ambient_share=_number(content["ambient_share"]),
        ambient_ratio=_number(content["ambient_ratio"]),
    )  # fmt: skip


def _motion_of(row: Mapping[str, Any]) -> Motion:
    x, y = row["middle_px"]
    across, down = row["shift_px"]
    return Motion(
        matrix=np.array(row["matrix"], np.float64),
        middle_px=(_number(x), _number(y)),
        shift_px=(_number(across), _number(down)),
        sigma_px=_number(row["sigma_px"]),
        rms_px=_number(row["rms_px"]),
        rotation_deg=_number(row["rotation_deg"]),
        rotation_sigma_deg=_number(row["rotation_sigma_deg"]),
        scale=_number(row["scale"]),
        scale_sigma=_number(row["scale_sigma"]),
        gain=tuple(_number(value) for value in row["gain"]),
        correlation=_number(row["correlation"]),
        found=bool(row["found"]),
    )


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _three(values: list[float | None]) -> tuple[float, float, float]:
    a, b, c = (_number(value) for value in values)
    return (a, b, c)
