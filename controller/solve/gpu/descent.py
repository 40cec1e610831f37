"""Block coordinate descent on a graphics processor: the sweeps of ``bounded.descent``, all of them on the device.

Order, steps, momentum and restarts are those of the processor's loops. Only a few numbers come back, after every few
sweeps; the frames come back at the end.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Final

import numpy as np

from controller.core.arrays import FloatImage
from controller.core.errors import WorkError
from controller.solve.bounded.descent import MOST_GROWTH, OVERRELAXATION, RECOMPUTE_EVERY, IterationControl
from controller.solve.bounded.problem import Problem
from controller.solve.gpu.device import Buffer, Clear, Copy, Held, Work, spread
from controller.solve.gpu.transport import DeviceTransport, constants

MOST_AHEAD: Final = 16
"""Sweeps that are submitted before their numbers are asked for."""
ANSWER_S: Final = 0.25
"""Fewer are, if they would take longer than this: a stop request waits for them."""
_INERTIA, _LEAST, _KKT, _SWEEPS = 0, 3, 4, 6
_STATE_SIZE: Final = 12

Step = Work | Copy | Clear


@dataclass(frozen=True, slots=True, eq=False)
class _Frames:
    """One projector's numbers there, (3, its pixels) each; ``values``: the kernels' constants."""

    y: Buffer
    x: Buffer
    majoriser: Buffer
    edge_weights: Buffer
    step: Buffer
    values: Buffer
    pixels: int


class DeviceDescent:
    """A problem on a device."""

    def __init__(self, transport: DeviceTransport, problem: Problem, x: FloatImage, tolerance: float) -> None:
        """Copy it, with the start ``x`` (3, pixels). Raises DeviceRefused."""
        self._transport, self._device, self._problem = transport, transport.device, problem
        self._held = Held(self._device)
        groups = [int(np.prod(spread(rows * columns))) for rows, columns in transport.sizes]
        first = np.concatenate([[0], np.cumsum(groups)])
        try:
            self._partials = self._held.room(8 * int(first[-1]), "sums")
            self._state = self._held.put(self._begin(problem, tolerance), "sums")
            self._wanted = self._held.put(problem.target(), "target")
            self._weights = self._held.put(problem.weights, "weights")
            self._light, self._light_y, self._before = (
                self._held.room(4 * transport.sensor_count, "camera samples") for _ in range(3)
            )
            self._frames = [self._copied(n, x, int(first[n])) for n in range(len(transport.sizes))]
            self._sweep, self._recompute = self._swept(), [self._recomputed(which) for which in ("x", "y")]
        except BaseException:
            self.free()
            raise

    def free(self) -> None:
        """Give the memory back."""
        self._held.free()

    def sweep(self, sweeps: int, before: int) -> tuple[int, float]:
        """Do so many sweeps after ``before``, fewer where the tolerance is met; returns all there were, and KKT."""
        for number in range(before + 1, before + sweeps + 1):
            if number % RECOMPUTE_EVERY == 1:
                self._device.submit(self._recompute[0])
                self._device.submit([Copy(self._light, self._light_y)] if number == 1 else self._recompute[1])
            self._device.submit(self._sweep)
        state = self._device.read(self._state, _STATE_SIZE)
        return int(state[_SWEEPS]), float(state[_KKT])

    def point(self, out: FloatImage) -> None:
        """Write x (3, pixels)."""
        for n, frames in enumerate(self._frames):
            span = self._problem.transport.span(n)
            out[:, span] = self._device.read(frames.x, 3 * frames.pixels).reshape(3, -1)

    # what is copied

    @staticmethod
    def _begin(problem: Problem, tolerance: float) -> FloatImage:
        total = max(float(problem.majoriser.sum(dtype=np.float64)), np.finfo(np.float32).tiny)
        largest = np.finfo(np.float32).max
        return np.array([1, 0, 0, largest, largest, 0, 0, total, tolerance, MOST_GROWTH, OVERRELAXATION, 0], np.float32)

    def _copied(self, n: int, x: FloatImage, first: int) -> _Frames:
        problem, transport = self._problem, self._transport
        span = problem.transport.span(n)
        rows, columns = transport.sizes[n]
        edge_weights = problem.across[:, span].astype(np.uint32) | problem.down[:, span].astype(np.uint32) << 16
        start = np.ascontiguousarray(x[:, span])
        head = constants([columns, rows, rows * columns, first, 0, 0], transport.mixing[n])
        head[4:6] = np.array([problem.strength_per_step, problem.transport.segment(n)], np.float32).view(np.uint32)
        y, x_there, majoriser, packed = (
            self._held.put(part, "frames") for part in (start, start, problem.majoriser[:, span], edge_weights)
        )
        step = self._held.room(start.nbytes, "frames")
        return _Frames(y, x_there, majoriser, packed, step, self._device.uniform(head), rows * columns)

    # what is done

    def _swept(self) -> list[Step]:
        device, transport = self._device, self._transport
        steps: list[Step] = [Copy(self._light_y, self._before)]
        for n, frames in enumerate(self._frames):
            bound = [frames.values, frames.y, frames.x, frames.majoriser, frames.edge_weights, frames.step,
                     transport.shown, self._partials, self._state]  # fmt: skip
            steps += transport.residual_of(self._light_y, self._wanted, self._weights)
            steps += transport.adjoint(n, frames.step)
            steps.append(device.work(device.kernel("frame", "state", "step"), bound, frames.pixels))
            steps += transport.forward(n, self._light_y)
        steps.append(device.work(device.kernel("state", "finish_sweep"), [self._partials, self._state], (1, 1)))
        for frames in self._frames:
            bound = [frames.values, frames.y, frames.x, frames.step, self._state]
            steps.append(device.work(device.kernel("frame", "state", "extrapolate"), bound, frames.pixels))
        bound = [self._light_y, self._light, self._before, self._state]
        light = device.work(device.kernel("state", "extrapolate_light"), bound, transport.sensor_count)
        return [*steps, light]

    def _recomputed(self, which: str) -> list[Step]:
        """The light of x or y from the frames again: sums of steps drift."""
        device = self._device
        light = self._light if which == "x" else self._light_y
        steps: list[Step] = [Clear(light)]
        for n, frames in enumerate(self._frames):
            bound = [frames.values, frames.x if which == "x" else frames.y, self._transport.shown]
            steps.append(device.work(device.kernel("frame", "mix"), bound, frames.pixels))
            steps += self._transport.forward(n, light)
        return steps


def descend_there(
    transport: DeviceTransport, problem: Problem, x: FloatImage, control: IterationControl
) -> tuple[FloatImage, float, int]:
    """``bounded.descent.block_coordinate_descent`` on a device; ``x`` is overwritten at the end only.

    Progress is told, and a stop request asked for, every few sweeps. Raises DeviceRefused, and
    WorkError("solve-cancelled").
    """
    descent = DeviceDescent(transport, problem, x, control.tolerance)
    try:
        return _swept_until(descent, x, control)
    finally:
        descent.free()


def _swept_until(descent: DeviceDescent, x: FloatImage, control: IterationControl) -> tuple[FloatImage, float, int]:
    done, kkt, ahead = 0, np.inf, 1
    while done < control.most_iterations:
        if control.cancelled is not None and control.cancelled():
            raise WorkError("solve-cancelled", what="The solve was stopped.", remedy="Start it again to repeat it.")
        asked = 1 if control.on_iterate is not None else min(ahead, control.most_iterations - done)
        began_s = time.perf_counter()
        before = done
        done, kkt = descent.sweep(asked, before)
        each_s = (time.perf_counter() - began_s) / asked
        ahead = int(np.clip(ANSWER_S / max(each_s, 1e-9), 1, min(MOST_AHEAD, 2 * ahead)))
        if control.on_iterate is not None:
            now = np.empty_like(x)
            descent.point(now)
            control.on_iterate(done, now)
        if control.progress is not None:
            control.progress(done, kkt)
        if kkt <= control.tolerance or done < before + asked:
            break
    found = np.empty_like(x)
    descent.point(found)
    x[:] = found
    return x, kkt, done
