"""Base times scale on a graphics processor (paper 3, eqs 4-6)."""

from __future__ import annotations

import numpy as np

from controller.core.arrays import FloatImage
from controller.optics.solve.gpu.device import Buffer, Held, Work
from controller.optics.solve.gpu.transport import DeviceTransport, constants


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
