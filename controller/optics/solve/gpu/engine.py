"""Solves and scales on a graphics processor, and on the processor where the device can't."""

from __future__ import annotations

from collections.abc import Callable

from controller.core.arrays import FloatImage
from controller.optics.solve.bounded.descent import IterationControl
from controller.optics.solve.bounded.problem import Solution, SolveInput
from controller.optics.solve.engines.processor import Processor
from controller.optics.solve.gpu.descent import DeviceDescent, solve_there
from controller.optics.solve.gpu.device import Device, DeviceRefused
from controller.optics.solve.gpu.equations import DeviceEquations
from controller.optics.solve.gpu.scaling import DeviceScaling
from controller.optics.solve.gpu.transport import DeviceTransport
from controller.optics.transport import LightTransport

BaseArrays = tuple[FloatImage, FloatImage, FloatImage]


class GpuEngine:
    """An engine (``engines.processor.Engine``) with a device that it keeps the last transport and base on.

    What the device refuses, because it is lost or too small, is done by the processor from its start, and ``note`` gets
    a sentence about it. Not for two threads at once.
    """

    def __init__(self, device: Device, note: Callable[[str], None]) -> None:
        self.name = device.name
        self._device, self._note = device, note
        self._instead = Processor()
        self._stage: _Stage | None = None
        self._refused: LightTransport | None = None

    @property
    def worked(self) -> str:
        """As ``Engine.worked``."""
        return self.name if self._refused is None else self._instead.name

    def solve(self, given: SolveInput, control: IterationControl) -> Solution:
        """As ``Engine.solve``."""
        try:
            stage = self._on_device(given.transport)
            if stage is not None:
                return stage.solve(given, control)
        except DeviceRefused as refused:
            self._say(refused)
        return self._instead.solve(given, control)

    def scaled(
        self, transport: LightTransport, light: FloatImage, inverse: FloatImage, mixed: FloatImage, coverage: FloatImage
    ) -> FloatImage:
        """As ``Engine.scaled``."""
        try:
            stage = self._on_device(transport)
            if stage is not None:
                return stage.scaled(light, (inverse, mixed, coverage))
        except DeviceRefused as refused:
            self._say(refused)
        return self._instead.scaled(transport, light, inverse, mixed, coverage)

    def _on_device(self, transport: LightTransport) -> _Stage | None:
        """The stage of this transport; None if it was refused before."""
        if transport is self._refused:
            return None
        if self._stage is None or self._stage.transport.source is not transport:
            self._free()
            # until it is there, so that a failure is not repeated for each solve
            self._refused = transport
            self._stage = _Stage(DeviceTransport(self._device, transport))
            self._refused = None
            self._note(
                f"{self.name} solves; the light transport takes {self._device.held_bytes / 1e6:.0f} MB of its memory."
            )
        return self._stage

    def _say(self, refused: DeviceRefused) -> None:
        """Tell it, and leave this transport to the processor from now on."""
        if self._stage is not None:
            self._refused = self._stage.transport.source
        self._free()
        self._note(f"The processor solves instead of {self.name}: {refused}.")

    def _free(self) -> None:
        if self._stage is not None:
            self._stage.free()
        self._stage = None


class _Stage:
    """What is on the device for one light transport: room for solves from the first solve on, and the last base."""

    def __init__(self, transport: DeviceTransport) -> None:
        self.transport = transport
        self._equations: DeviceEquations | None = None
        self._descent: DeviceDescent | None = None
        self._base: BaseArrays | None = None
        self._scaling: DeviceScaling | None = None

    def solve(self, given: SolveInput, control: IterationControl) -> Solution:
        """Raises DeviceRefused and WorkError("solve-cancelled")."""
        if self._equations is None:
            self._equations = DeviceEquations(self.transport)
        if self._descent is None:
            self._descent = DeviceDescent(self._equations)
        return solve_there(self._equations, self._descent, given, control)

    def scaled(self, light: FloatImage, base: BaseArrays) -> FloatImage:
        """Raises DeviceRefused."""
        same = self._base is not None and all(a is b for a, b in zip(self._base, base, strict=True))
        if self._scaling is None or not same:
            if self._scaling is not None:
                self._scaling.free()
            self._scaling = None
            self._scaling, self._base = DeviceScaling(self.transport, *base), base
        return self._scaling.scaled(light)

    def free(self) -> None:
        """Give the memory back."""
        for part in (self._scaling, self._descent, self._equations, self.transport):
            if part is not None:
                part.free()
