"""Block coordinate descent on a graphics processor: the sweeps of ``bounded.descent``, all of them on the device.

Order, steps, momentum and restarts are those of the processor's loops. Only a few numbers come back, after every few
sweeps; the frames come back at the end.
"""

from __future__ import annotations

import time
from typing import Final

import numpy as np

from controller.core.errors import WorkError
from controller.optics.solve.bounded.descent import MOST_GROWTH, OVERRELAXATION, RECOMPUTE_EVERY, IterationControl
from controller.optics.solve.bounded.problem import Solution, SolveInput
from controller.optics.solve.gpu.device import Clear, Copy, Held, Step, groups_of
from controller.optics.solve.gpu.equations import DeviceEquations

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
