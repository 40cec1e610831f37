"""The equations of solves, and where they start, on a graphics processor: what ``bounded.equations`` does.

What depends on the light transport alone is calculated once: each projector's white light under its pixels and by
blocks of camera pixels. Only sums come back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from controller.core.arrays import FloatImage
from controller.optics.solve.bounded.equations import EDGE_WEIGHT_STEPS, SolveInput
from controller.optics.solve.bounded.initial_estimate import BLOCK_PX, FAINTEST
from controller.optics.solve.gpu.device import Array, Buffer, Clear, Copy, Device, Held, Step, Work, groups_of
from controller.optics.solve.gpu.transport import DeviceTransport, constants

_STRENGTH, _SEGMENT, _FAINT = 4, 5, 6
"""Where these are among the constants of a projector's kernels."""

_SUMS = 7
"""The number of the sums among the buffers of ``sum_pixels``."""


@dataclass(frozen=True, slots=True, eq=False)
class ProjectorBuffers:
    """One projector's numbers there, (3, its pixels) each but where said.

    ``x``, ``y``, ``step``: the frames of a solve, the extrapolated ones, and the last step
    ``observed``: the projector's white light under its pixels; ``per_sum`` makes means of sums under them
    ``beside``: 1 for pixels that stay dark, (pixels,); ``sums``: of the groups of a kernel
    ``values``, ``white``: the kernels' constants; ``white`` has magnitudes for the mixing of colours
    """

    y: Buffer
    x: Buffer
    step: Buffer
    majoriser: Buffer
    edge_weights: Buffer
    observed: Buffer
    per_sum: Buffer
    beside: Buffer | None
    sums: Buffer
    values: Buffer
    head: Array
    white: Buffer
    pixels: int

    def set(self, device: Device, at: int, value: float) -> None:
        """Change a number among ``values``."""
        self.head[at : at + 1] = np.array([value], np.float32).view(np.uint32)
        device.write(self.values, self.head)


class DeviceEquations:
    """The equations of one solve after the other, on one transport. ``total``: the sum of the majoriser's numbers."""

    def __init__(self, transport: DeviceTransport) -> None:
        """Make room, and calculate what all solves on the transport share. Raises DeviceRefused."""
        self.transport, self.device = transport, transport.device
        self._held = Held(self.device)
        self._black: FloatImage | None = None
        self.total = 0.0
        try:
            self._make_room()
            self._see_white()
            self._build, self._smooth, self._start, self._judge = (
                steps() for steps in (self._built, self._smoothed, self._estimate, self._judged)
            )
        except BaseException:
            self.free()
            raise

    def free(self) -> None:
        """Give the memory back."""
        self._held.free()

    def build(self, given: SolveInput) -> None:
        """Put the equations of a solve in place of the last one's."""
        device, transport = self.device, self.transport
        if self._black is not given.black:
            device.write(self._black_there, np.asarray(given.black, np.float32)[self._window])
            self._black = given.black
        device.write(transport.residual, np.asarray(given.target, np.float32)[self._window])
        if given.weights is None:
            device.submit([Copy(self._mask, self.weights)])
        else:
            device.write(self.weights, np.asarray(given.weights, np.float32)[self._window])
        device.submit(self._build)
        squares = self._sum(self._camera_sums, self._camera_pixels)
        lit = sum(self._sum(one.sums, one.pixels) for one in self.projectors)
        strength = given.smoothness * squares / max(lit, 1) / EDGE_WEIGHT_STEPS
        for one in self.projectors:
            one.set(device, _STRENGTH, strength)
        device.submit(self._smooth)
        self.total = sum(self._sum(one.sums, one.pixels) for one in self.projectors)

    def start(self, frames: Sequence[FloatImage] | None) -> None:
        """Let the solve begin with these frames (rows, columns, 3), or with ``initial_estimate``'s for the target."""
        if frames is None:
            self.device.submit(self._start)
            return
        for one, frame in zip(self.projectors, frames, strict=True):
            self.device.write(one.step, np.asarray(frame, np.float32))
            bound = [one.majoriser, one.x, one.step]
            start = self._over_pixels(one, "given_start", "start_frame", bound=bound)
            self.device.submit([start, Copy(one.x, one.y)])

    def objective(self) -> float:
        """At x, whose picture is in the transport's ``residual``."""
        self.device.submit(self._judge)
        misfit = self._sum(self._camera_sums, self._camera_pixels)
        return misfit + sum(self._sum(one.sums, one.pixels) for one in self.projectors)

    def frames(self) -> tuple[FloatImage, ...]:
        """x, one image (rows, columns, 3) a projector. Overwrites the steps."""
        for one in self.projectors:
            self.device.submit([self._over_pixels(one, "join_planes", bound=[one.x, one.step])])
        sizes = zip(self.projectors, self.transport.sizes, strict=True)
        return tuple(self.device.read(one.step, 3 * one.pixels).reshape(*size, 3) for one, size in sizes)

    # what is there

    def _make_room(self) -> None:
        held, transport, source = self._held, self.transport, self.transport.source
        self._window = transport.box.window
        self._camera_pixels = pixels = transport.rows * transport.columns
        self.wanted, self._black_there = (held.room(12 * pixels, "camera pictures") for _ in range(2))
        self.weights = held.room(4 * pixels, "weights")
        self._mask = held.put(source.object_mask[self._window].astype(np.float32), "weights")
        self.light, self._reach = (held.room(4 * transport.sensor_count, "camera samples") for _ in range(2))
        self._camera_sums = held.room(8 * groups_of(pixels), "sums")
        numbers = [transport.columns, transport.rows, pixels, 0, 0, 0, 0, 0]
        self._camera = self.device.uniform(constants(numbers, np.eye(3, dtype=np.float32)))
        count = len(transport.sizes)
        self._blocks = -(-transport.rows // BLOCK_PX), -(-transport.columns // BLOCK_PX)
        block_bytes = 12 * self._blocks[0] * self._blocks[1]
        self._white_blocks, self._shown_blocks = (held.room(count * block_bytes, "blocks") for _ in range(2))
        self._wanted_blocks = held.room(block_bytes, "blocks")
        self._block_values = [
            self.device.uniform(np.array([*numbers[:3], self._blocks[1], self._blocks[0], count, n, 0], np.uint32))
            for n in range(count)
        ]
        self._mixing = held.put(np.pad(transport.mixing, ((0, 0), (0, 0), (0, 1))), "colours")
        self.projectors = [self._of_projector(n) for n in range(count)]

    def _of_projector(self, n: int) -> ProjectorBuffers:
        held, source = self._held, self.transport.source
        rows, columns = self.transport.sizes[n]
        pixels, span = rows * columns, source.span(n)
        y, x, step, majoriser, edge_weights, observed = (held.room(12 * pixels, "frames") for _ in range(6))
        per_sum = held.put(self.transport.per_sum(n), "frames")
        beside = None
        if source.beside is not None and source.beside[span].any():
            beside = held.put(source.beside[span].astype(np.float32), "frames")
        first = sum(groups_of(r * c) for r, c in self.transport.sizes[:n])
        head = constants([columns, rows, pixels, first, 0, 0, 0, 0], self.transport.mixing[n])
        head[_SEGMENT : _SEGMENT + 1] = np.array([source.segment(n)], np.float32).view(np.uint32)
        white = self.device.uniform(constants([columns, rows, pixels, 0, 0, 0, 0, 0], abs(self.transport.mixing[n])))
        sums = held.room(8 * groups_of(pixels), "sums")
        return ProjectorBuffers(
            y, x, step, majoriser, edge_weights, observed, per_sum, beside, sums, self.device.uniform(head), head,
            white, pixels,
        )  # fmt: skip

    def _see_white(self) -> None:
        """Each projector's white light: means under its pixels, its faintest, and means over blocks."""
        device, transport = self.device, self.transport
        blocks = self._blocks[0] * self._blocks[1]
        for n, one in enumerate(self.projectors):
            steps: list[Step] = [Clear(self.light), self._over_pixels(one, "fill_white", bound=[transport.shown])]
            steps += transport.forward(n, self.light)
            steps += transport.picture_of(self.light)
            steps.append(self._over_blocks("block_means", n, [transport.residual, self._white_blocks], blocks))
            steps += [*transport.collect(), *transport.sums(n, one.observed)]
            steps.append(self._over_pixels(one, "times", bound=[one.observed, one.per_sum]))
            device.submit(steps)
            one.set(device, _FAINT, FAINTEST * float(device.read(one.observed, 3 * one.pixels).max(initial=0)))

    # what is done

    def _over_pixels(self, one: ProjectorBuffers, *names: str, bound: Sequence[Buffer], white: bool = False) -> Work:
        values = one.white if white else one.values
        return self.device.work(self.device.kernel("frame", *names), [values, *bound], one.pixels)

    def _over_camera(self, *names: str, bound: Sequence[Buffer]) -> Work:
        return self.device.work(self.device.kernel("frame", *names), [self._camera, *bound], self._camera_pixels)

    def _summed(self, one: ProjectorBuffers | None, name: str, bound: Sequence[Buffer]) -> Work:
        """A kernel that adds up over a projector's pixels, or over the camera's; ``_sum`` reads it."""
        values, sums, pixels = (
            (self._camera, self._camera_sums, self._camera_pixels)
            if one is None
            else (one.values, one.sums, one.pixels)
        )
        kernel = self.device.kernel("frame", name, "group_sum", "sum_pixels")
        return self.device.work(kernel, {**dict(enumerate([values, *bound])), _SUMS: sums}, pixels)

    def _over_blocks(self, name: str, n: int, bound: Sequence[Buffer], threads: int) -> Work:
        kernel = self.device.kernel("blocks", name)
        return self.device.work(kernel, [self._block_values[n], *bound], threads)

    def _built(self) -> list[Step]:
        """From a picture in ``residual`` and weights to the smoothness and the data's part of the majoriser."""
        transport = self.transport
        steps: list[Step] = [
            self._over_camera("above", bound=[transport.residual, self._black_there, self.wanted]),
            self._over_camera("times_mask", bound=[self.weights, self._mask]),
            Copy(self.wanted, transport.residual),
            *transport.collect(),
        ]
        for n, one in enumerate(self.projectors):
            steps += transport.sums(n, one.step)
            bound = [one.step, one.per_sum, one.observed, one.edge_weights]
            steps.append(self._over_pixels(one, "edge_weights", bound=bound))
        steps.append(Clear(self._reach))
        for n, one in enumerate(self.projectors):
            steps += [Clear(self.light), self._over_pixels(one, "fill_white", bound=[transport.shown], white=True)]
            steps += transport.forward(n, self.light)
            kernel = self.device.kernel("add")
            steps.append(self.device.work(kernel, [self._reach, self.light], transport.sensor_count))
            steps += transport.counted_of(self.light, self.weights)
            steps += transport.adjoint(n, one.majoriser, absolute=True)
            steps.append(self._summed(one, "count_lit", [one.majoriser]))
        steps += transport.counted_of(self._reach, self.weights)
        return [*steps, self._summed(None, "light_squared", [transport.residual, self.weights])]

    def _smoothed(self) -> list[Step]:
        """Adds the smoothness to the majoriser, beside dark pixels none."""
        steps: list[Step] = []
        for one in self.projectors:
            if one.beside is not None:
                steps.append(self._over_pixels(one, "leave_dark", bound=[one.majoriser, one.beside]))
            steps.append(self._over_pixels(one, "dark_edges", bound=[one.majoriser, one.edge_weights]))
            steps.append(self._summed(one, "smooth_majoriser", [one.majoriser, one.edge_weights]))
        return steps

    def _estimate(self) -> list[Step]:
        """As ``initial_estimate``, to x and y."""
        transport, blocks = self.transport, self._blocks[0] * self._blocks[1]
        bound = [self._white_blocks, self._wanted_blocks, self._mixing, self._shown_blocks]
        steps: list[Step] = [
            self._over_blocks("block_means", 0, [self.wanted, self._wanted_blocks], blocks),
            self._over_blocks("solve_blocks", 0, bound, blocks),
        ]
        for n, one in enumerate(self.projectors):
            bound = [self._shown_blocks, transport.residual]
            steps.append(self._over_blocks("upsample", n, bound, self._camera_pixels))
            steps += [*transport.collect(), *transport.sums(n, one.step)]
            bound = [one.majoriser, one.x, one.step, one.per_sum]
            start = self._over_pixels(one, "estimated_start", "start_frame", bound=bound)
            steps += [start, Copy(one.x, one.y)]
        return steps

    def _judged(self) -> list[Step]:
        misfit = self._summed(None, "misfit", [self.transport.residual, self.wanted, self.weights])
        return [misfit, *(self._summed(one, "roughness", [one.x, one.edge_weights]) for one in self.projectors)]

    def _sum(self, sums: Buffer, pixels: int) -> float:
        """What the groups of a kernel over so many pixels have added up."""
        groups = groups_of(pixels)
        return float(self.device.read(sums, 2 * groups)[::2].sum(dtype=np.float64))
