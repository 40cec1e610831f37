"""The opened stage for the steps of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from controller.core.arrays import ByteImage
from controller.core.errors import UsageError
from controller.optics.capture.acquire import Acquirer
from controller.stage.rig.ambient_light import AmbientLightLimit
from controller.stage.rig.lamp_guard import START_AGAIN, LampGuard, faulty
from controller.stage.rig.power import Circuit
from hal.deadline import Deadline
from hal.errors import DeviceRefused
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
class Rig:
    """All devices of a run. Created only by ``controller.stage.sessions.open``."""

    stage: Path
    projectors: tuple[RigProjector, ...]
    camera: Camera
    display: Display
    acquirer: Acquirer
    circuits: tuple[Circuit, ...] = ()
    ambient_limit: AmbientLightLimit | None = None

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
