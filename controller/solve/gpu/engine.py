"""Solves and scales on a graphics processor, and on the processor where the device can't."""

from __future__ import annotations

from collections.abc import Callable

from controller.core.arrays import FloatImage
from controller.solve.bounded.descent import IterationControl
from controller.solve.bounded.problem import Problem
from controller.solve.engines.processor import Processor
from controller.solve.gpu.descent import descend_there
from controller.solve.gpu.device import Device, DeviceRefused
from controller.solve.gpu.scaling import DeviceScaling
from controller.solve.gpu.transport import DeviceTransport
from controller.transport import LightTransport


class GpuEngine:
    """An engine (``engines.processor.Engine``) with a device that it keeps the last transport and base on.

    What the device refuses, because it is lost or too small, is done by the processor from its start, and ``note`` gets
    a sentence about it. Not for two threads at once.
    """

    def __init__(self, device: Device, note: Callable[[str], None]) -> None:
        self.name = device.name
        self._device, self._note = device, note
        self._instead = Processor()
        self._transport: DeviceTransport | None = None
        self._refused: LightTransport | None = None
        self._base: tuple[FloatImage, FloatImage, FloatImage] | None = None
        self._scaling: DeviceScaling | None = None

    def descend(self, problem: Problem, x: FloatImage, control: IterationControl) -> tuple[FloatImage, float, int]:
        """As ``Engine.descend``."""
        try:
            there = self._there(problem.transport)
            if there is not None:
                return descend_there(there, problem, x, control)
        except DeviceRefused as refused:
            self._say(refused)
        return self._instead.descend(problem, x, control)

    def scaled(
        self, transport: LightTransport, light: FloatImage, inverse: FloatImage, mixed: FloatImage, coverage: FloatImage
    ) -> FloatImage:
        """As ``Engine.scaled``."""
        try:
            there = self._there(transport)
            if there is not None:
                return self._scaling_of(there, inverse, mixed, coverage).scaled(light)
        except DeviceRefused as refused:
            self._say(refused)
        return self._instead.scaled(transport, light, inverse, mixed, coverage)

    def _there(self, transport: LightTransport) -> DeviceTransport | None:
        """The transport on the device; None if it was refused before."""
        if transport is self._refused:
            return None
        if self._transport is None or self._transport.source is not transport:
            self._free()
            # until it is there, so that a failure is not repeated for each solve
            self._refused = transport
            self._transport = DeviceTransport(self._device, transport)
            self._refused = None
            self._note(
                f"{self.name} solves; the light transport takes {self._device.held_bytes / 1e6:.0f} MB of its memory."
            )
        return self._transport

    def _scaling_of(
        self, there: DeviceTransport, inverse: FloatImage, mixed: FloatImage, coverage: FloatImage
    ) -> DeviceScaling:
        base = inverse, mixed, coverage
        same = self._base is not None and all(a is b for a, b in zip(self._base, base, strict=True))
        if self._scaling is None or not same:
            if self._scaling is not None:
                self._scaling.free()
            self._scaling = None
            self._scaling, self._base = DeviceScaling(there, *base), base
        return self._scaling

    def _say(self, refused: DeviceRefused) -> None:
        """Tell it, and leave this transport to the processor from now on."""
        if self._transport is not None:
            self._refused = self._transport.source
        self._free()
        self._note(f"The processor solves instead of {self.name}: {refused}.")

    def _free(self) -> None:
        for part in (self._scaling, self._transport):
            if part is not None:
                part.free()
        self._scaling = self._transport = self._base = None
