"""A run's measurements of each projector: light, metapixels, dots, indirect light."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64, FloatImage, Mask, load_arrays, save_arrays
from controller.optics.calibrate.values import Correspondence, Metapixels, PhaseMap, Radiometry, SurfaceSpread
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.names import json_path, npz_path, read_json, write_json


@dataclass(frozen=True, slots=True)
class Light:
    """``radiometry-PROJECTOR.npz``: light in full scales per second of the camera, linear.

    ``response`` (3, 256) and ``mixing`` (3, 3): see ``Radiometry``
    ``white`` (camera rows, columns, 3) float32: HDR white of this projector alone less ``black``, NaN where saturated
    ``black`` (camera rows, columns, 3) float32: all projectors at black, NaN where saturated
    ``camera_to_xyz`` (3, 3): linear camera RGB to CIE XYZ (D65)
    ``segment`` (1,): see ``Radiometry``; None where colours add; ``paint`` (3, 3, 3): see there, too
    """

    response: Float64
    mixing: Float64
    white: FloatImage
    black: FloatImage
    camera_to_xyz: Float64
    segment: Float64 | None = None
    paint: Float64 | None = None

    @property
    def radiometry(self) -> Radiometry:
        return Radiometry(self.response, self.mixing, _segment(self.segment), self.paint)

    @staticmethod
    def path(run: Path, projector: str) -> Path:
        return npz_path(run, StepKind.RADIOMETRY, projector)

    def write(self, run: Path, projector: str) -> Path:
        return _save(self.path(run, projector), self)

    @classmethod
    def read(cls, run: Path, projector: str) -> Self:
        arrays = load_arrays(cls.path(run, projector))
        return cls(**{name: arrays.get(name) for name in _names(cls)})  # type: ignore[arg-type]


def _segment(kept: Float64 | None) -> float:
    return 0.0 if kept is None else float(kept[0])


def write_drawn_by(run: Path, projector: str, response: Float64) -> Path:
    """``drawn-PROJECTOR.npz``: the response (3, 256) that patterns were drawn by, if it is not of this view."""
    path = npz_path(run, "drawn", projector)
    save_arrays(path, {"response": response})
    return path


def drawn_by(run: Path, projector: str) -> Float64:
    """The response (3, 256) by which a projector's sinusoids and random pattern were drawn."""
    path = npz_path(run, "drawn", projector)
    response: Float64 = load_arrays(path)["response"] if path.exists() else Light.read(run, projector).response
    return response


@dataclass(frozen=True, slots=True)
class Pixels:
    """``pixels-PROJECTOR.npz``: correspondences, metapixels and phase map from the sinusoids, in pixels.

    ``projector_px``, ``modulation``, ``seen``: see ``Correspondence``
    ``centre_px``, ``covariance_px2``, ``valid``: see ``Metapixels``
    ``shown_px``, ``spread_px2``: see ``PhaseMap``; None in runs from before there was one
    ``mosaic`` (2, 2) int: see ``Calibration``; of size 0 where each camera pixel has its own three colours
    ``colours_px`` (3, 2): see ``PhaseMap``; None where the colours lie on each other
    ``spread`` (3,): share, camera and projector pixels of ``SurfaceSpread``; None where none was seen
    """

    projector_px: FloatImage
    modulation: FloatImage
    seen: Mask
    centre_px: FloatImage
    covariance_px2: FloatImage
    valid: Mask
    shown_px: FloatImage | None
    spread_px2: FloatImage | None
    mosaic: npt.NDArray[np.int64] | None
    colours_px: Float64 | None = None
    spread: Float64 | None = None

    @property
    def correspondence(self) -> Correspondence:
        return Correspondence(self.projector_px, self.modulation, self.seen)

    @property
    def metapixels(self) -> Metapixels:
        return Metapixels(self.centre_px, self.covariance_px2, self.valid)

    @property
    def phase_map(self) -> PhaseMap | None:
        if self.shown_px is None or self.spread_px2 is None:
            return None
        return PhaseMap(self.shown_px, self.spread_px2, self.colours_px)

    @property
    def known_mosaic(self) -> npt.NDArray[np.int64] | None:
        """The camera's mosaic, None if it is unknown or there is none."""
        return self.mosaic if self.mosaic is not None and self.mosaic.size else None

    @property
    def surface_spread(self) -> SurfaceSpread | None:
        return None if self.spread is None else SurfaceSpread(*(float(number) for number in self.spread))

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """The existing ones, by name."""
        return {name: array for name in _names(Pixels) if (array := getattr(self, name)) is not None}

    @staticmethod
    def path(run: Path, projector: str) -> Path:
        return npz_path(run, StepKind.PIXELS, projector)

    def write(self, run: Path, projector: str) -> Path:
        return _save(self.path(run, projector), self)

    @classmethod
    def read(cls, run: Path, projector: str) -> Self:
        arrays = load_arrays(cls.path(run, projector))
        later: dict[str, Any] = {name: arrays.get(name) for name in _LATER}
        return cls(**{name: arrays[name] for name in _names(cls) if name not in later}, **later)


_LATER = ("shown_px", "spread_px2", "mosaic", "colours_px", "spread")
"""Arrays that older runs do not have, or aligned projectors."""


@dataclass(frozen=True, slots=True)
class DotMetapixels:
    """``dots-PROJECTOR.npz``: metapixels from dots, as ``Metapixels``; ``reason`` (rows, columns): why one is bad."""

    centre_px: FloatImage
    covariance_px2: FloatImage
    valid: Mask
    reason: npt.NDArray[Any]

    @property
    def metapixels(self) -> Metapixels:
        return Metapixels(self.centre_px, self.covariance_px2, self.valid)

    def write(self, run: Path, projector: str) -> Path:
        return _save(npz_path(run, StepKind.DOTS, projector), self)

    @classmethod
    def read(cls, run: Path, projector: str) -> Self:
        arrays = load_arrays(npz_path(run, StepKind.DOTS, projector))
        return cls(**{name: arrays[name] for name in _names(cls)})


@dataclass(frozen=True, slots=True)
class DotNotes:
    """``dots-PROJECTOR.json``: the dots' spacing in projector pixels and the exposure of their photographs."""

    spacing_px: int
    exposure_s: float

    def write(self, run: Path, kind: str, projector: str) -> Path:
        """``kind``: that of the step that takes the photographs."""
        return write_json(json_path(run, kind, projector), asdict(self))

    @classmethod
    def read(cls, run: Path, kind: str, projector: str) -> Self:
        row = read_json(json_path(run, kind, projector))
        return cls(int(row["spacing_px"]), float(row["exposure_s"]))


def write_radiometry_figures(run: Path, projector: str, figures: Mapping[str, Any]) -> Path:
    """``radiometry-PROJECTOR.json``: quality of the measured response (docs/reference/report.md)."""
    return write_json(json_path(run, StepKind.RADIOMETRY, projector), figures)


def read_radiometry_figures(run: Path, projector: str) -> Any:
    """The content of ``write_radiometry_figures``; {} if it is missing."""
    return _read_figures(json_path(run, StepKind.RADIOMETRY, projector))


@dataclass(frozen=True, slots=True)
class PixelFigures:
    """``pixels-PROJECTOR.json``: of ``pixels`` projector pixels ``fitted`` ones have a metapixel.

    ``camera_pixels``: how many camera pixels see the projector; ``colours_px``: x and y of how far red, green and blue
    lie apart, projector pixels, where that is corrected
    """

    fitted: int
    pixels: int
    camera_pixels: int
    colours_px: tuple[tuple[float, float], ...] | None = None

    def write(self, run: Path, projector: str) -> Path:
        return write_json(json_path(run, StepKind.PIXELS, projector), asdict(self))

    @classmethod
    def read(cls, run: Path, projector: str) -> Self | None:
        """None if there are none."""
        row = _read_figures(json_path(run, StepKind.PIXELS, projector))
        if not row:
            return None
        apart = row.get("colours_px")  # not in runs from before it was corrected
        colours_px = None if apart is None else tuple((float(x), float(y)) for x, y in apart)
        return cls(int(row["fitted"]), int(row["pixels"]), int(row["camera_pixels"]), colours_px)


def write_dot_figures(run: Path, projector: str, figures: Mapping[str, Any]) -> Path:
    """``metapixels-PROJECTOR.json``: figures of the fit to the dots; for people."""
    return write_json(json_path(run, StepKind.METAPIXELS, projector), figures)


def _read_figures(path: Path) -> Any:
    return read_json(path) if path.exists() else {}


def _names(kind: type[Light | Pixels | DotMetapixels]) -> list[str]:
    return [field.name for field in fields(kind)]


def _save(path: Path, value: Light | Pixels | DotMetapixels) -> Path:
    arrays = {name: getattr(value, name) for name in _names(type(value))}
    save_arrays(path, {name: array for name, array in arrays.items() if array is not None})
    return path


LEAST_MEDIAN: Final = 0.005
LEAST_P95: Final = 0.02
"""With less indirect light than both, a stage is taken as one without."""


@dataclass(frozen=True, slots=True)
class Indirect:
    """``indirect-PROJECTOR.npz``: the share of its white that is indirect, and its radiometry in direct light.

    ``share`` (camera rows, columns, 3), 0 to 1, float16 in the file; ``response``, ``mixing``, ``segment``,
    ``paint``: as of ``Light``; ``stripes``: as of ``ProjectorCalibration``; ``white_gain`` like ``share``: the white
    image with less noise over that of ``Light``, None where there is no better one
    """

    share: npt.NDArray[np.floating]
    response: Float64
    mixing: Float64
    segment: Float64 | None = None
    stripes: FloatImage | None = None
    white_gain: npt.NDArray[np.floating] | None = None
    paint: Float64 | None = None

    @property
    def radiometry(self) -> Radiometry:
        return Radiometry(self.response, self.mixing, _segment(self.segment), self.paint)

    def write(self, run: Path, projector: str) -> Path:
        path = npz_path(run, StepKind.INDIRECT, projector)
        kept: dict[str, npt.NDArray[Any]] = {"response": self.response, "mixing": self.mixing}
        kept["share"] = self.share.astype(np.float16)
        gain = None if self.white_gain is None else self.white_gain.astype(np.float16)
        more = {"segment": self.segment, "stripes": self.stripes, "white_gain": gain, "paint": self.paint}
        save_arrays(path, kept | {name: array for name, array in more.items() if array is not None})
        return path

    @classmethod
    def read(cls, run: Path, projector: str) -> Self:
        arrays = load_arrays(npz_path(run, StepKind.INDIRECT, projector))
        found = arrays["share"], arrays["response"], arrays["mixing"]
        more = (arrays.get(name) for name in ("segment", "stripes", "white_gain", "paint"))
        return cls(*found, *more)


@dataclass(frozen=True, slots=True)
class IndirectFigures:
    """``indirect-PROJECTOR.json``: indirect light as a share of a projector's white, ``median`` and ``p95`` of pixels.

    ``response`` (3,): relative change of the response at value 64 by being fitted to direct light
    ``flicker``: standard deviation of the lamp's light from photograph to photograph, relative; 0 where not known
    """

    median: float
    p95: float
    response: tuple[float, ...] = ()
    flicker: float = 0.0

    @property
    def matters(self) -> bool:
        return self.median >= LEAST_MEDIAN or self.p95 >= LEAST_P95

    def write(self, run: Path, projector: str) -> Path:
        row = {"median": self.median, "p95": self.p95, "response": list(self.response), "flicker": self.flicker}
        return write_json(json_path(run, StepKind.INDIRECT, projector), row)

    @classmethod
    def read(cls, run: Path, projector: str) -> Self | None:
        """None for a run that did not measure it."""
        path = json_path(run, StepKind.INDIRECT, projector)
        if not path.exists():
            return None
        row = read_json(path)
        response = tuple(float(value) for value in row["response"])
        return cls(float(row["median"]), float(row["p95"]), response, float(row.get("flicker", 0.0)))


def read_indirect(run: Path, projectors: Sequence[str]) -> list[Indirect] | None:
    """Of each of these projectors; None where it was not measured, or is too little to count."""
    figures = [IndirectFigures.read(run, name) for name in projectors]
    if any(one is None for one in figures) or not any(one is not None and one.matters for one in figures):
        return None
    return [Indirect.read(run, name) for name in projectors]


def read_white_gain(run: Path, projector: str) -> npt.NDArray[np.floating] | None:
    """See ``Indirect``; None for a run that did not measure it."""
    if not npz_path(run, StepKind.INDIRECT, projector).exists():
        return None
    return Indirect.read(run, projector).white_gain


def write_mode(run: Path, mode: Mapping[str, str]) -> Path:
    """``mode.json``: how the metapixels of a run are measured (``steps.modes``)."""
    return write_json(json_path(run, StepKind.MODE), mode)


def mode_of(folder: Path) -> str:
    """The mode of a run; "fast" if it is not stored."""
    path = json_path(folder, StepKind.MODE)
    return str(read_json(path)["mode"]) if path.exists() else "fast"


def read_metapixels(folder: Path, projector: str) -> Metapixels:
    """The metapixels that a run uses: from dots in the paper's mode, else from the sinusoids."""
    if mode_of(folder) == "paper":
        return DotMetapixels.read(folder, projector).metapixels
    return Pixels.read(folder, projector).metapixels
