"""A run's settings for photographs: exposures, the stage's delay, and figures of the camera.

Measurements of the camera itself, ``camera.npz``, are in ``capture.profile.CameraProfile``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from controller.core.storage import write_atomically
from controller.optics.capture.profile import FILE_NAME
from controller.stage.artefacts.names import read_json, write_json

_EXPOSURES: Final = "exposure.json"
_DELAY, _RAISED = "delay.json", "delay-raised.json"
_FIGURES: Final = "camera.json"
_RESPONSE_FIGURES: Final = "camera-response-figures.json"


@dataclass(frozen=True, slots=True)
class Exposures:
    """In seconds: ``base_s``, where a projector's white is well exposed; ``white_s``, the bracket of its HDR white."""

    base_s: float
    white_s: tuple[float, ...]

    @staticmethod
    def write(run: Path, found: Mapping[str, Exposures]) -> Path:
        """``exposure.json``, by projector name."""
        return write_json(run / _EXPOSURES, {name: asdict(exposures) for name, exposures in found.items()})

    @staticmethod
    def read(run: Path) -> dict[str, Exposures]:
        """The exposures by projector name."""
        rows = read_json(run / _EXPOSURES)
        return {name: Exposures(float(row["base_s"]), tuple(map(float, row["white_s"]))) for name, row in rows.items()}


@dataclass(frozen=True, slots=True)
class Delay:
    """``delay.json``, in seconds: ``wait_s`` after its presentation a picture is completely visible.

    ``delay_s`` after which it starts to appear; ``tries`` as in ``capture.latency``, each of ``exposure_s``
    """

    wait_s: float
    delay_s: float
    tries: tuple[tuple[float, float], ...]
    exposure_s: float

    def write(self, run: Path) -> Path:
        return write_json(run / _DELAY, asdict(self))

    @staticmethod
    def read(run: Path) -> Delay:
        row = read_json(run / _DELAY)
        tries = tuple((float(delay_s), float(share)) for delay_s, share in row["tries"])
        return Delay(float(row["wait_s"]), float(row["delay_s"]), tries, float(row["exposure_s"]))


def raise_delay(run: Path, wait_s: float) -> None:
    """Store that a longer delay than measured was needed, in seconds. This is not an artefact of a step."""
    write_json(run / _RAISED, {"wait_s": wait_s})


def longest_wait_s(run: Path) -> float | None:
    """The delay between presentation and photograph that the run needs, in seconds; None before it is measured."""
    waits = [float(read_json(path)["wait_s"]) for path in (run / _DELAY, run / _RAISED) if path.exists()]
    return max(waits, default=None)


def inherit_camera(calibrated: Path, run: Path) -> None:
    """Copy the measurements of camera and delay from the run in ``calibrated`` to another run.

    The run's own measurements stay.
    """
    for name in (FILE_NAME, _DELAY, _RAISED):
        if (calibrated / name).exists() and not (run / name).exists():
            write_atomically(run / name, (calibrated / name).read_bytes())


def write_camera_figures(run: Path, figures: Mapping[str, Any]) -> Path:
    """``camera.json``: black level and limits in raw steps, noise in full scale, ratios of exposures; for people."""
    return write_json(run / _FIGURES, figures)


def write_response_figures(run: Path, figures: Mapping[str, Any]) -> Path:
    """``camera-response-figures.json``: how well a JPEG camera's response fits its bracket series; for people."""
    return write_json(run / _RESPONSE_FIGURES, figures)
