"""The photographs of a run: their paths, their index, and the note for each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from controller.core.arrays import FloatImage
from controller.optics.capture.profile import CameraNoise, CameraProfile, load_profile, true_exposure
from controller.optics.capture.raw import Photograph, read_photograph
from controller.run.step_id import ShotId
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.names import CAPTURES, read_json, safe_name, stem, write_json

PATTERN: Final = "pattern"
"""The name of a projector's photograph, if each projector has one."""


@dataclass(frozen=True, slots=True)
class TakenPhotograph:
    """A photograph on disk, with the exposure that the camera confirmed, in seconds.

    ``fresh``: it was taken by this run, not by an earlier one.
    """

    name: str
    path: Path
    exposure_s: float
    fresh: bool = False
    profile: CameraProfile | None = field(default=None, compare=False, repr=False)
    """The run's measurements of the camera, if any."""
    projector: str | None = None
    """The only lit projector; None for several, or none."""

    def read(self) -> Photograph:
        return read_photograph(self.path, profile=self.profile)

    def measured(self) -> FloatImage:
        """(rows, columns, 3) float32: full scales, NaN where saturated."""
        photograph = self.read()
        # not ``Photograph.measured``, which copies: this photograph has no other use
        photograph.image[photograph.saturated] = np.nan
        return photograph.image

    def per_second(self) -> FloatImage:
        """(rows, columns, 3) float32: full scales per second, NaN where saturated."""
        image = self.measured()
        image /= np.float32(self.exposure_s)
        return image


@dataclass(frozen=True, slots=True)
class PhotographSet:
    """Photographs in one index: KIND.json, KIND-PROJECTOR.json or KIND.NNN-PROJECTOR.json.

    ``projector``: the only one lit in all of them; ``batch``: the part of a long list, from 0
    """

    kind: str
    projector: str | None = None
    batch: int | None = None

    def index(self, run: Path) -> Path:
        """The file that lists them."""
        return run / f"{stem(self.kind, self.projector, part=self.batch)}.json"

    def shot(self, name: str, projector: str | None = None) -> ShotId:
        """The identity of one of them; ``projector`` if the set itself has none."""
        return ShotId(str(self.kind), name, projector or self.projector)

    def write(self, run: Path, taken: Sequence[TakenPhotograph]) -> Path:
        """Write the index, in the order in which they were taken."""
        rows = [
            {
                "name": photograph.name,
                "projector": photograph.projector,
                "path": str(photograph.path.relative_to(run)),
                "exposure_s": photograph.exposure_s,
            }
            for photograph in taken
        ]
        return write_json(self.index(run), rows)

    def read(self, run: Path) -> tuple[TakenPhotograph, ...]:
        """The photographs in the index, with the run's corrected exposure times."""
        profile = load_profile(run)
        return tuple(self._taken(run, row, profile) for row in read_json(self.index(run)))

    def by_name(self, run: Path) -> dict[str, TakenPhotograph]:
        """As ``read``, by name; for a set of one projector or of none, whose names differ."""
        return {photograph.name: photograph for photograph in self.read(run)}

    def by_projector(self, run: Path, name: str = PATTERN) -> dict[str | None, TakenPhotograph]:
        """As ``read``, those of this name by their lit projector."""
        return {photograph.projector: photograph for photograph in self.read(run) if photograph.name == name}

    @staticmethod
    def _taken(run: Path, row: Mapping[str, Any], profile: CameraProfile | None) -> TakenPhotograph:
        exposure_s = true_exposure(profile, float(row["exposure_s"]))
        return TakenPhotograph(row["name"], run / row["path"], exposure_s, profile=profile, projector=row["projector"])


def noise_of(taken: TakenPhotograph) -> CameraNoise:
    """Noise of a photograph's samples in full scales per second; as measured, or as cameras have it."""
    noise = CameraNoise() if taken.profile is None else taken.profile.noise
    return noise.per_second(taken.exposure_s)


def light_of(projector: str) -> PhotographSet:
    """White, Gray code and colour tiles of one projector."""
    return PhotographSet(StepKind.LIGHT, projector)


def codes_of(projector: str) -> PhotographSet:
    """The sinusoids and the random pattern of one projector."""
    return PhotographSet(StepKind.CODES, projector)


def white_again_of(projector: str) -> PhotographSet:
    """White of one projector, photographed again by a quick recalibration."""
    return PhotographSet("white", projector)


BLACK: Final = PhotographSet(StepKind.BLACK)
CAMERA_RESPONSE: Final = PhotographSet(StepKind.CAMERA_RESPONSE)
DRIFT: Final = PhotographSet(StepKind.DRIFT_PHOTOGRAPHS)
"""One photograph of each projector's pattern, one of white and one of black."""
SKEW: Final = PhotographSet("skew-photographs")
VERIFICATION: Final = PhotographSet(StepKind.VERIFICATION_PHOTOGRAPHS)
"""One photograph of each projector's random pattern."""

WHITE: Final = "white"


def white_name(number: int) -> str:
    """One exposure of the bracket of white."""
    return f"{WHITE}-{number}"


def white_bracket(taken: Sequence[TakenPhotograph]) -> list[TakenPhotograph]:
    """The bracket of white among the photographs of a projector's light."""
    found = {photograph.name: photograph for photograph in taken}
    names = (white_name(number) for number in range(len(found)))
    return [found[name] for name in names if name in found]


def captures_folder(run: Path, shot: ShotId) -> Path:
    """The photograph's folder: one for each kind and projector, so that all names differ."""
    return run / CAPTURES / stem(shot.kind, shot.projector)


def captured(run: Path, of: PhotographSet) -> int:
    """Number of photographs of a set's kind and projector in the run, listed or not."""
    folder = captures_folder(run, of.shot(""))
    if not folder.is_dir():
        return 0
    return sum(1 for path in folder.iterdir() if path.suffix != NOTE_SUFFIX and not path.name.startswith("."))


def capture_name(shot: ShotId) -> str:
    """The photograph's name in its folder, without suffix."""
    return safe_name(shot.name)


def write_exposure(photograph: Path, exposure_s: float) -> None:
    """Write the note with the exposure that the camera confirmed, in seconds."""
    write_json(_note(photograph), {"exposure_s": exposure_s})


def read_exposure(photograph: Path) -> float:
    """The exposure that the camera confirmed for a photograph, in seconds."""
    return float(read_json(_note(photograph))["exposure_s"])


def delete_photograph(photograph: Path) -> None:
    """Delete a photograph with its note, and what else the camera wrote for it; harmless if they are gone."""
    for file in list(photograph.parent.glob("*")):
        if file.stem == photograph.stem:
            file.unlink(missing_ok=True)


def _note(photograph: Path) -> Path:
    return photograph.with_suffix(NOTE_SUFFIX)


NOTE_SUFFIX: Final = ".json"
"""Suffix of the photographs' notes."""


class Developed(Mapping[str, FloatImage]):
    """Photographs by pattern name, in full scales per second, read at each access.

    ``ready`` holds images in memory (HDR black and white), which take precedence over the photographs.
    """

    def __init__(self, taken: Mapping[str, TakenPhotograph], ready: Mapping[str, FloatImage]) -> None:
        self._taken = taken
        self._ready = ready

    def __getitem__(self, name: str) -> FloatImage:
        if name in self._ready:
            return self._ready[name]
        return self._taken[name].per_second()

    def __iter__(self) -> Iterator[str]:
        yield from self._ready
        yield from (name for name in self._taken if name not in self._ready)

    def __len__(self) -> int:
        return sum(1 for _ in self)
