"""Properties of the camera measured during a run, and their file beside the photographs."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64, load_arrays, save_arrays

FILE_NAME = "camera.npz"
SAME_EXPOSURE = 1e-6


@dataclass(frozen=True, slots=True)
class CameraNoise:
    """Variance of a full-scale value v: ``shot`` v + ``read`` squared. The defaults suit a 12-bit APS-C camera."""

    shot: float = 1 / 30_000
    read: float = 6 / 30_000

    def per_second(self, exposure_s: float) -> CameraNoise:
        """The same of values in full scales per second, from photographs of this exposure."""
        return CameraNoise(self.shot / exposure_s, self.read / exposure_s)


def _nothing_clips() -> Float64:
    return np.full((2, 2), np.inf)


def _nothing_added() -> Float64:
    return np.zeros((2, 2))


def _no_corrections() -> Float64:
    return np.empty((0, 2))


def _none_bad() -> npt.NDArray[np.int64]:
    return np.empty((0, 2), np.int64)


@dataclass(frozen=True, slots=True)
class CameraProfile:
    """Measured properties of the camera; with the defaults, the values of each file are used.

    ``noise`` of one raw sample (JPEG: of one value in linear light)
    ``black_offset`` (2, 2) raw steps by which each site's black level lies above the file's value
    ``clip`` (2, 2) raw value from which a site saturates or is no longer linear, inf where none was found
    ``exposures`` (n, 2) reported and true exposures in seconds; those that are not listed are true as reported
    ``bad_px`` (n, 2) column and row of samples that do not measure light
    ``response`` (3, 256) linear light of a JPEG value, 1 at 255; None for a camera that delivers RAW
    """

    noise: CameraNoise = field(default_factory=CameraNoise)
    black_offset: Float64 = field(default_factory=_nothing_added)
    clip: Float64 = field(default_factory=_nothing_clips)
    bad_px: npt.NDArray[np.int64] = field(default_factory=_none_bad)
    exposures: Float64 = field(default_factory=_no_corrections)
    response: Float64 | None = None

    def true_exposure(self, reported_s: float) -> float:
        """Seconds for which the shutter really opens when the camera reports ``reported_s``."""
        for reported, true in self.exposures:
            if abs(reported / reported_s - 1) < SAME_EXPOSURE:
                return float(true)
        return reported_s

    def knows(self, reported_s: float) -> bool:
        """Whether the time of an exposure that the camera reports as ``reported_s`` was measured, and is corrected."""
        return any(abs(reported / reported_s - 1) < SAME_EXPOSURE for reported in self.exposures[:, 0])

    def save(self, folder: Path) -> Path:
        """Write ``camera.npz`` into a run's folder."""
        arrays: dict[str, npt.NDArray[np.generic]] = {
            "noise": np.array([self.noise.shot, self.noise.read]),
            "black_offset": self.black_offset,
            "clip": self.clip,
            "bad_px": self.bad_px,
            "exposures": self.exposures,
        }
        if self.response is not None:
            arrays["response"] = self.response
        save_arrays(folder / FILE_NAME, arrays)
        return folder / FILE_NAME


def true_exposure(profile: CameraProfile | None, reported_s: float) -> float:
    """As ``CameraProfile.true_exposure``; as the camera reports where nothing was measured of it."""
    return reported_s if profile is None else profile.true_exposure(reported_s)


def load_profile(folder: Path) -> CameraProfile | None:
    """What a run measured of its camera, None before it has."""
    path = folder / FILE_NAME
    if not path.exists():
        return None
    arrays = load_arrays(path)
    shot, read = (float(value) for value in arrays["noise"])
    return CameraProfile(
        noise=CameraNoise(shot, read),
        black_offset=arrays["black_offset"],
        clip=arrays["clip"],
        bad_px=arrays["bad_px"],
        exposures=arrays["exposures"],
        response=arrays.get("response"),
    )
