"""Solves and scales on a graphics processor, and on the processor where the device can't.

The sweeps are those of ``bounded.engine``, all of them on the device: order, steps, momentum and restarts are the same.
Only a few numbers come back, after every few sweeps; the frames come back at the end.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

import numpy as np

from controller.core.arrays import FloatImage
from controller.core.errors import WorkError
from controller.optics.solve.bounded.engine import (
    MOST_GROWTH,
    OVERRELAXATION,
    RECOMPUTE_EVERY,
    IterationControl,
    Processor,
    corrected,
)
from controller.optics.solve.bounded.equations import Solution, SolveInput
from controller.optics.solve.gpu.device import Buffer, Clear, Copy, Device, DeviceRefused, Held, Step, Work, groups_of
from controller.optics.solve.gpu.equations import DeviceEquations
from controller.optics.solve.gpu.transport import DeviceTransport, constants
from controller.optics.transport import LightTransport

MOST_AHEAD: Final = 16
"""Sweeps that are submitted before their numbers are asked for."""
ANSWER_S: Final = 0.25
"""Fewer are, if they would take longer than this: a stop request waits for them."""
_KKT, _SWEEPS = 4, 6
_STATE_SIZE: Final = 12


class DeviceDescent:
    """The sweeps of one solve after the other, on the equations of a device."""

    def __init__(self, equations: DeviceEquations) -> None:
        """Make room. Raises DeviceRefused."""
        self._equations, self._transport, self._device = equations, equations.transport, equations.device
        self._held = Held(self._device)
        groups = sum(groups_of(one.pixels) for one in equations.projectors)
        try:
            self._partials = self._held.room(8 * groups, "sums")
            self._state = self._held.room(4 * _STATE_SIZE, "sums")
            self._light_y, self._before = (
                self._held.room(4 * self._transport.sensor_count, "camera samples") for _ in range(2)
            )
            self._sweep, self._recompute = self._swept(), [self._recomputed(which) for which in ("x", "y")]
        except BaseException:
            self.free()
            raise

    def free(self) -> None:
        """Give the memory back."""
        self._held.free()

    def begin(self, tolerance: float) -> None:
        """Before the first sweep from the start of the equations."""
        total = max(self._equations.total, float(np.finfo(np.float32).tiny))
        largest = np.finfo(np.float32).max
        state = [1, 0, 0, largest, largest, 0, 0, total, tolerance, MOST_GROWTH, OVERRELAXATION, 0]
        self._device.write(self._state, np.array(state, np.float32))

    def sweep(self, sweeps: int, before: int) -> tuple[int, float]:
        """Do so many sweeps after ``before``, fewer where the tolerance is met; returns all there were, and KKT."""
        for number in range(before + 1, before + sweeps + 1):
            if number % RECOMPUTE_EVERY == 1:
                self._device.submit(self._recompute[0])
                light = self._equations.light
                self._device.submit([Copy(light, self._light_y)] if number == 1 else self._recompute[1])
            self._device.submit(self._sweep)
        state = self._device.read(self._state, _STATE_SIZE)
        return int(state[_SWEEPS]), float(state[_KKT])

    def see(self) -> None:
        """Write the picture of x to the transport's ``residual``."""
        self._device.submit([*self._recompute[0], *self._transport.picture_of(self._equations.light)])

    # what is done

    def _swept(self) -> list[Step]:
        device, transport, equations = self._device, self._transport, self._equations
        steps: list[Step] = [Copy(self._light_y, self._before)]
        for n, one in enumerate(equations.projectors):
            bound = [one.values, one.y, one.x, one.majoriser, one.edge_weights, one.step, transport.shown,
                     self._partials, self._state]  # fmt: skip
            steps += transport.residual_of(self._light_y, equations.wanted, equations.weights)
            steps += transport.adjoint(n, one.step)
            steps.append(device.work(device.kernel("frame", "state", "group_sum", "step"), bound, one.pixels))
            steps += transport.forward(n, self._light_y)
        steps.append(device.work(device.kernel("state", "finish_sweep"), [self._partials, self._state], (1, 1)))
        for one in equations.projectors:
            bound = [one.values, one.y, one.x, one.step, self._state]
            steps.append(device.work(device.kernel("frame", "state", "extrapolate"), bound, one.pixels))
        bound = [self._light_y, equations.light, self._before, self._state]
        light = device.work(device.kernel("state", "extrapolate_light"), bound, transport.sensor_count)
        return [*steps, light]

    def _recomputed(self, which: str) -> list[Step]:
        """The light of x or y from the frames again: sums of steps drift."""
        device = self._device
        light = self._equations.light if which == "x" else self._light_y
        steps: list[Step] = [Clear(light)]
        for n, one in enumerate(self._equations.projectors):
            bound = [one.values, one.x if which == "x" else one.y, self._transport.shown]
            steps.append(device.work(device.kernel("frame", "mix"), bound, one.pixels))
            steps += self._transport.forward(n, light)
        return steps


def solve_there(
    equations: DeviceEquations, descent: DeviceDescent, given: SolveInput, control: IterationControl
) -> Solution:
    """``Engine.solve`` on a device. Progress is reported, and a stop request asked for, every few sweeps.

    Raises DeviceRefused, and WorkError("solve-cancelled").
    """
    began_s = time.perf_counter()
    equations.build(given)
    equations.start(given.start)
    descent.begin(control.tolerance)
    done, kkt = _swept_until(descent, control)
    descent.see()
    objective = equations.objective()
    frames = equations.frames()
    return Solution(frames, objective, kkt, done, time.perf_counter() - began_s, kkt <= control.tolerance)


def _swept_until(descent: DeviceDescent, control: IterationControl) -> tuple[int, float]:
    done, kkt, ahead = 0, np.inf, 1
    while done < control.most_iterations:
        if control.cancelled is not None and control.cancelled():
            raise WorkError("solve-cancelled", what="The solve was stopped.", remedy="Start it again to repeat it.")
        asked = min(ahead, control.most_iterations - done)
        began_s = time.perf_counter()
        before = done
        done, kkt = descent.sweep(asked, before)
        each_s = (time.perf_counter() - began_s) / asked
        ahead = int(np.clip(ANSWER_S / max(each_s, 1e-9), 1, min(MOST_AHEAD, 2 * ahead)))
        if control.progress is not None:
            control.progress(done, kkt)
        if kkt <= control.tolerance or done < before + asked:
            break
    return done, kkt


class DeviceScaling:
    """A base there, ready to be scaled; ``base`` are the arrays ``inverse``, ``mixed`` and ``coverage`` of ``Base``."""

    def __init__(
        self, transport: DeviceTransport, inverse: FloatImage, mixed: FloatImage, coverage: FloatImage
    ) -> None:
        """Copy the base. Raises DeviceRefused."""
        self._transport = transport
        self._held = Held(transport.device)
        try:
            self._frames: list[tuple[Buffer, int]] = []
            self._work = self._prepared(inverse, mixed, coverage)
        except BaseException:
            self.free()
            raise

    def free(self) -> None:
        """Give the memory back."""
        self._held.free()

    def scaled(self, light: FloatImage) -> FloatImage:
        """Frames (3, pixels of all projectors) in [0, 1] for a target's ``light`` (3, rows, columns).

        Raises DeviceRefused.
        """
        transport = self._transport
        _write_planes(transport, transport.residual, light)
        transport.device.submit(self._work)
        parts = [transport.device.read(buffer, 3 * pixels).reshape(3, pixels) for buffer, pixels in self._frames]
        return np.concatenate(parts, axis=1)

    def _prepared(self, inverse: FloatImage, mixed: FloatImage, coverage: FloatImage) -> list[Work]:
        transport, device = self._transport, self._transport.device
        values_count = 3 * transport.rows * transport.columns
        image = self._held.room(4 * values_count, "base image")
        _write_planes(transport, image, inverse)
        bound = [transport.residual, image]
        work = [device.work(device.kernel("divide_by_base"), bound, values_count), *transport.collect()]
        for n, (rows, columns) in enumerate(transport.sizes):
            pixels, span = rows * columns, transport.source.span(n)
            frames = self._held.room(12 * pixels, "frames")
            base = self._held.put(mixed[:, span] * coverage[:, span] * transport.per_sum(n), "frames")
            unmix = np.linalg.inv(transport.mixing[n].astype(np.float64)).astype(np.float32)
            values = constants([columns, rows, pixels, 0, 0, 0], unmix)
            values[5:6] = np.array([transport.source.segment(n)], np.float32).view(np.uint32)
            work += transport.sums(n, frames)
            work.append(
                device.work(device.kernel("frame", "scale_base"), [device.uniform(values), frames, base], pixels)
            )
            self._frames.append((frames, pixels))
        return work


def _write_planes(transport: DeviceTransport, to: Buffer, planes: FloatImage) -> None:
    """Write what the transport's box has of (3, rows, columns)."""
    for c, plane in enumerate(planes):
        transport.device.write(to, plane[transport.box.window], 4 * c * transport.rows * transport.columns)


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
        given = corrected(self, given, control)
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
