"""The calibrated stage as an experiment sees it: what the calibration found, and photographs of what is shown."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp

from controller.core.arrays import FloatImage, Mask
from controller.optics.calibrate.values import Calibration, Geometry, Metapixels
from controller.optics.calibrate.verify.drift import Drift
from controller.optics.solve.reach.drive_levels import DriveLevels
from controller.optics.solve.reach.feasibility import expose_target, target_radiance
from controller.optics.solve.targets.values import Target
from controller.optics.transport import LightTransport
from controller.optics.transport.indirect.indirect_light import IndirectLight
from controller.run.runner import Context
from controller.stage.steps.modes import DotOptions

Shares = sp.csr_matrix[np.float64]
BenchChange = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Dots:
    """A projector's pixels as photographs of dots show them (paper 4.1, 4.2).

    ``shares`` (camera pixels, projector pixels): the dots' light over white light, in [0, 1], with no model at all
    ``metapixels``: Gaussians fitted to them, not regularised; not valid where a fit failed
    """

    shares: Shares
    metapixels: Metapixels


class Photographer(Protocol):
    """Shows frames on the projectors and photographs them."""

    def photograph(self, name: str, frames: Sequence[FloatImage], *, white: float) -> FloatImage:
        """(rows, columns, 3) float32 HDR radiance of linear ``frames``, one (rows, columns, 3) a projector.

        ``name``: unique in its experiment; ``white``: the radiance of the target's white, by which it is exposed.
        """

    def dots(self, n: int, *, plain: bool = False) -> Dots:
        """Projector ``n`` as dots show it; ``plain``: photographed once, no longer than white."""


@dataclass(frozen=True, slots=True)
class SessionParts:
    """Access to the session: ``hand`` moves and calibrates the stage, ``context`` is of the step that runs."""

    hand: StageControl
    context: Context


@dataclass(slots=True)
class Subject:
    """A calibrated stage.

    ``transport``: of all projectors, as appearances are solved with; ``indirect``: light by way of other surfaces,
    where there is any that counts; ``size``: small, medium or paper; ``seed``
    """

    calibration: Calibration
    geometry: Geometry
    transport: LightTransport
    light: Photographer
    indirect: IndirectLight | None = None
    size: str = "small"
    seed: int = 1
    advance: Callable[[float, str], None] = lambda fraction, note: None
    _parts: SessionParts | None = field(default=None, repr=False)
    _drive: DriveLevels | None = field(default=None, repr=False)

    @property
    def parts(self) -> SessionParts:
        """Given to an experiment's subject by a session; a subject of arrays alone has none."""
        assert self._parts is not None
        return self._parts

    @parts.setter
    def parts(self, parts: SessionParts) -> None:
        self._parts = parts

    @property
    def drive(self) -> DriveLevels:
        if self._drive is None:
            self._drive = DriveLevels.of_transport(self.transport)
        return self._drive

    @property
    def mask(self) -> Mask:
        """(rows, columns): the object, where some projector lights it."""
        return self.transport.object_mask

    def with_projectors(self, which: Sequence[int]) -> Calibration:
        """The calibration as if there were only these projectors; the others stay black, which is in K."""
        return dataclasses.replace(self.calibration, projectors=tuple(self.calibration.projectors[n] for n in which))

    def frames_of(self, which: Sequence[int], frames: Sequence[FloatImage]) -> list[FloatImage]:
        """Frames for all projectors from those of some; the others are black."""
        whole = [np.zeros((*part.metapixels.valid.shape, 3), np.float32) for part in self.calibration.projectors]
        for n, frame in zip(which, frames, strict=True):
            whole[n] = frame
        return whole

    def wanted(
        self, target: Target, *, share: float = 0.95, transport: LightTransport | None = None
    ) -> ReachableTarget:
        """A target at the largest exposure that ``share`` of the object can reach.

        ``transport``: of the projectors that are to reach it alone; else all of them. The mask is what they reach.
        """
        black = self.calibration.black
        drive = self.drive if transport is None else DriveLevels.of_transport(transport)
        transport = self.transport if transport is None else transport
        found = expose_target(drive, target.image, black, share=share, indirect=self.indirect)
        mask: Mask = found.possible.reachable & target.mask
        radiance, direct = (target_radiance(image, black, 1.0) for image in (found.wanted, found.needed))
        return ReachableTarget(radiance, mask, found.exposure, direct, target.mask, target.softened)


@dataclass(frozen=True, slots=True)
class ReachableTarget:
    """A target as radiance.

    ``radiance`` (rows, columns, 3) float32, at least the black image; ``direct``: what of it projectors are to make
    directly, with the black image; ``mask`` (rows, columns): where it says something that is in reach; ``white``:
    radiance of a perfect white; ``valid``: where it says something; ``softened``: as of ``Target``
    """

    radiance: FloatImage
    mask: Mask
    white: float
    _direct: FloatImage | None = None
    _valid: Mask | None = None
    softened: str = ""

    @property
    def valid(self) -> Mask:
        return self.mask if self._valid is None else self._valid

    @property
    def as_asked(self) -> str:
        """Of a table's row: whether this is what was asked for."""
        return f"softened {self.softened}" if self.softened else "as asked"

    @property
    def direct(self) -> FloatImage:
        return self.radiance if self._direct is None else self._direct


@dataclass(frozen=True, slots=True)
class Recalibration:
    """A stage that was calibrated again. ``photographs`` it took; ``error_percent``: of each projector's grade."""

    subject: Subject
    photographs: int
    error_percent: Mapping[str, float]

    @property
    def worst_percent(self) -> float:
        return max(self.error_percent.values(), default=float("nan"))


class StageControl(Protocol):
    """What an experiment may do apart from taking photographs. ``name``: unique in its experiment."""

    def disturb(self, *changes: BenchChange) -> None:
        """Change the stage (``hal.interfaces.Bench.disturb``); without changes: as it was set up."""

    def drift(self, name: str) -> Drift:
        """Measure what has changed since the stage was calibrated."""

    def quickly(self, name: str) -> Recalibration:
        """Bring the calibration up to date, repeating only what has changed."""

    def again(self, name: str, options: DotOptions | None = None, *, beyond: str | None = None) -> Recalibration:
        """Calibrate from nothing, or beyond what ``again`` of that name took, on the same stage: only what is new.

        The photographs are counted with those that it began with.
        """
