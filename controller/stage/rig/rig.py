"""The opened stage for the steps of a run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from controller.config.models import ONLY_CAMERA
from controller.core.arrays import ByteImage, Float64
from controller.core.errors import UsageError
from controller.optics.capture.acquire import Acquirer
from controller.stage.rig.ambient_light import AmbientLightLimit
from controller.stage.rig.lamp_guard import START_AGAIN, LampGuard, faulty
from controller.stage.rig.power import Circuit
from controller.stage.rig.shared_display import Seat
from hal.deadline import Deadline
from hal.errors import CodedError, DeviceRefused
from hal.interfaces import BundleDisplay, Camera, Display
from hal.values import Power


@dataclass(frozen=True, slots=True)
class RigProjector:
    """A projector and its picture: ``size_px`` (width, height) of its output."""

    name: str
    output: str
    size_px: tuple[int, int]
    guard: LampGuard

    def black(self) -> ByteImage:
        """(rows, columns, 3) uint8 zeros."""
        return np.zeros((self.size_px[1], self.size_px[0], 3), np.uint8)

    def white(self) -> ByteImage:
        """The same of 255."""
        return np.full((self.size_px[1], self.size_px[0], 3), 255, np.uint8)


@dataclass(frozen=True, slots=True)
class RigCamera:
    """A further camera: the ``name`` of its view, what photographs with it, and its place at the display."""

    name: str
    camera: Camera
    acquirer: Acquirer
    seat: Seat


@dataclass(frozen=True, slots=True)
class Rig:
    """All devices of a run. Created only by ``controller.stage.sessions.open``.

    ``view``: the name of the view of ``camera``; ``seat``: its place at the display, if there are ``others``
    ``absent``: cameras that could not be opened, by the names of their views
    ``drawn_by``: the response by which a projector's patterns are drawn (3, 256), if it is not the view's own; it waits
    until that is measured, and is None where it can't be
    """

    stage: Path
    projectors: tuple[RigProjector, ...]
    camera: Camera
    display: Display
    acquirer: Acquirer
    circuits: tuple[Circuit, ...] = ()
    ambient_limit: AmbientLightLimit | None = None
    view: str = ONLY_CAMERA
    seat: Seat | None = None
    others: tuple[RigCamera, ...] = ()
    absent: Mapping[str, CodedError] = field(default_factory=dict)
    drawn_by: Callable[[str, Deadline], Float64 | None] | None = None

    @property
    def is_first(self) -> bool:
        """Whether this is the view of the run's own folder."""
        return self.drawn_by is None

    def seen_by(self, other: RigCamera) -> Rig:
        """The same stage with another camera alone; what concerns the room is left to the first one."""
        return replace(
            self, view=other.name, camera=other.camera, acquirer=other.acquirer, seat=other.seat, others=(), absent={},
            ambient_limit=None,
        )  # fmt: skip

    @property
    def guards(self) -> tuple[LampGuard, ...]:
        return tuple(projector.guard for projector in self.projectors)

    def check_light(self, *, deadline: Deadline, stable: bool = True) -> None:
        """Check every projector: a photograph is valid only if each lamp is on and ``stable``.

        Raises DeviceRefused("projector-fault" or "lamp-went-off"), and what the drivers raise.
        """
        for guard in self.guards:
            status = guard.status(deadline=deadline.within(guard.answer_s))
            if status.power is Power.FAULT:
                raise faulty(guard.name, status, then=START_AGAIN)
            if status.power is not Power.ON or (stable and guard.stable_left_s() > 0):
                raise DeviceRefused(
                    "lamp-went-off",
                    what=f"The lamp of projector {guard.name} went off during the work.",
                    remedy=f"Check whether it was switched off or overheated. {START_AGAIN}",
                )

    def on_outputs(self, frames: Mapping[str, ByteImage]) -> dict[str, ByteImage]:
        """Frames by output from frames by projector; projectors without a frame show black."""
        return {projector.output: frames.get(projector.name, projector.black()) for projector in self.projectors}

    def bundle_display(self) -> BundleDisplay:
        """The display, if it plays bundles. Raises UsageError("display-plays-no-bundles")."""
        if not isinstance(self.display, BundleDisplay):
            raise UsageError(
                "display-plays-no-bundles",
                what="The display driver of this stage can't play bundles.",
                remedy='Write driver = "player" under [display] in stage.toml.',
            )
        return self.display
