"""The light transport on a graphics processor: T p, T' r and means over projector pixels, on buffers that stay there.

The sensor's buffer holds a number for each camera site. Products have the windows and tables of ``transport.windows``;
nothing is approximated further.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage
from controller.optics.solve.bounded.initial_estimate import BLOCK_PX
from controller.optics.solve.gpu.device import GROUP, Buffer, Device, DeviceRefused, Held, Work
from controller.optics.solve.gpu.records import BLOCK, RECORD_BYTES, bands_of, place_columns, reach_of
from controller.optics.transport import LightTransport
from controller.optics.transport.planes import CameraBox
from controller.optics.transport.windows.transport import WindowTransport

SQUARE: Final = 8
"""Threads of a group along each side, of the kernels over a projector's pixels in two dimensions."""
_IDENTITY: Final = np.eye(3, dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class _Windows:
    """A ``Band`` there, of windows that are small or not; ``most`` of its own in a row of places."""

    rows: tuple[int, int]
    place_row: int
    own: tuple[int, int]
    most: int
    small: bool
    records: Buffer
    shapes: Buffer
    first: Buffer
    even: Buffer


class DeviceTransport:
    """T on a device. The sensor's buffer holds ``sensor_count`` numbers.

    ``shown`` has room for one projector's mixed frame (3, its pixels), ``residual`` for a picture (3, rows, columns)
    """

    def __init__(self, device: Device, transport: LightTransport, *, band_bytes: int | None = None) -> None:
        """Copy what the products need.

        ``band_bytes``: most of the windows in one piece; None: as much as the device can use.
        Raises DeviceRefused where the device has no room, or the transport no windows.
        """
        if not isinstance(transport, WindowTransport):
            raise DeviceRefused("the graphics processor needs phase maps, and one view alone")
        self._held = Held(device)
        self._band_bytes = band_bytes or device.most_bytes
        try:
            self._copy(device, transport)
        except BaseException:
            self.free()
            raise

    def free(self) -> None:
        """Give the memory back."""
        self._held.free()

    def _copy(self, device: Device, windowed: WindowTransport) -> None:
        held = self._held
        self.device, self.source = device, windowed
        self.sizes, self.mixing = windowed.sizes, windowed.mixing
        self.box = box = _box_of(windowed)
        self.rows, self.columns = box.bottom - box.top, box.right - box.left
        self.mosaic = windowed.colours.size > 0
        pixels = self.rows * self.columns
        self.sensor_count = pixels if self.mosaic else 3 * pixels
        table, small = windowed.table, windowed.small
        kinds = np.stack([table.first, table.size], 1).astype(np.uint32)
        self._tables = {
            True: [held.put(small.table, "tables"), held.put(small.skews, "tables")],
            False: [held.put(table.table, "tables"), held.put(kinds, "tables")],
        }
        self._windows = [self._copied(windowed, n) for n in range(len(self.sizes))]
        most = max(part.records.size for parts in self._windows for part in parts)
        self._weighed = held.room(most // RECORD_BYTES * 4, "windows")
        self._reach = [held.put(reach_of(windowed.windows, n, table), "reaches") for n in range(len(self.sizes))]
        largest = max(rows * columns for rows, columns in self.sizes)
        self.shown = held.room(12 * largest, "frames")
        self.residual = held.room(12 * pixels, "camera pictures")
        self._sites = held.room(4 * pixels, "camera samples") if self.mosaic else self.residual
        self._per_sum = windowed.per_sum
        self._camera = device.uniform(self._camera_values(windowed.colours))

    def _copied(self, windowed: WindowTransport, n: int) -> list[_Windows]:
        tables = windowed.table, windowed.small
        found = []
        for small in (True, False):
            for band in bands_of(windowed.windows, n, small=small, tables=tables, most=self._band_bytes):
                # all rows get something of the small windows, if only zeros
                if small or len(band.records):
                    band.records[:, 0] = self._inside(band.records[:, 0])
                    buffers = [
                        self._held.put(part, "windows")
                        for part in (band.records, band.records[:, 2:], band.first, band.even)
                    ]
                    of_rows = band.first[:: place_columns(self.sizes[n][1])].astype(np.int64)
                    most = int(np.diff(of_rows[band.own[0] : band.own[1] + 1]).max(initial=0))
                    found.append(_Windows(band.rows, band.place_row, band.own, most, small, *buffers))
        return found

    def _inside(self, sites: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
        """Sites of the camera, row by row, by their numbers in the box; of three colours, one plane after the other."""
        rows, columns = self.source.camera_shape
        plane, place = np.divmod(sites.astype(np.int64), rows * columns)
        y, x = np.divmod(place, columns)
        return np.asarray((plane * self.rows + y - self.box.top) * self.columns + x - self.box.left)

    @property
    def bands(self) -> int:
        """In how many pieces the windows are."""
        return sum(len(parts) for parts in self._windows)

    # work

    def forward(self, n: int, sensor: Buffer) -> list[Work]:
        """Adds T_n p_n to ``sensor``; ``shown`` holds the mixed frame M p_n."""
        work = []
        for part in self._windows[n]:
            begin, end = part.own
            if not part.most:
                continue
            kind = "small" if part.small else "other"
            kernel = self.device.kernel("band", "records", f"{kind}_shares", f"forward_{kind}")
            bound = [self._band(n, part, _IDENTITY), part.records, part.first, *self._tables[part.small]]
            work.append(self.device.work(kernel, [*bound, self.shown, sensor], (-(-part.most // GROUP), end - begin)))
        return work

    def adjoint(self, n: int, out: Buffer, *, absolute: bool = False) -> list[Work]:
        """Writes T_n' r to ``out`` (3, pixels of n); ``collect`` has brought r, in ``residual``, to the sites.

        ``absolute``: with magnitudes in T.
        """
        mixing = self.mixing[n]
        return self._gather(n, abs(mixing) if absolute else mixing, out, even=False)

    def sums(self, n: int, out: Buffer) -> list[Work]:
        """Writes the sums under the metapixels of the picture in ``residual``, gains left out, to ``out``.

        Times ``per_sum`` they are the means of ``LightTransport.gaussian_mean``.
        """
        return self._gather(n, _IDENTITY, out, even=True)

    def per_sum(self, n: int) -> FloatImage:
        """(3, pixels of n): what makes means of ``sums``."""
        return self._per_sum[:, self.source.span(n)]

    def _gather(self, n: int, mixing: FloatImage, out: Buffer, *, even: bool) -> list[Work]:
        work = []
        for part in self._windows[n]:
            kind = "small" if part.small else "other"
            weigh = self.device.kernel("records", "even_gain" if even else "own_gain", "weigh")
            given = {1: part.records, 5: self._sites, 6: self._weighed, **({8: part.even} if even else {})}
            work.append(self.device.work(weigh, given, part.records.size // RECORD_BYTES))
            kernel = self.device.kernel("band", "shapes", f"{kind}_shares", f"adjoint_{kind}")
            tables = self._tables[part.small]
            bound = [self._band(n, part, mixing), part.shapes, part.first, *tables, self._weighed, out]
            numbered = dict(enumerate(bound))
            if not part.small:
                numbered[7] = self._reach[n]
            begin, end = part.rows
            groups = -(-self.sizes[n][1] // SQUARE), -(-(end - begin) // SQUARE)
            work.append(self.device.work(kernel, numbered, groups))
        return work

    def residual_of(self, sensor: Buffer, wanted: Buffer, weights: Buffer) -> list[Work]:
        """Writes w (D s - wanted) to ``residual``, and what ``adjoint`` needs of it."""
        return self._picture(sensor, wanted, weights) + self.collect()

    def counted_of(self, sensor: Buffer, weights: Buffer) -> list[Work]:
        """Writes w D s to ``residual``, and what ``adjoint`` needs of it."""
        return self._picture(sensor, None, weights) + self.collect()

    def picture_of(self, sensor: Buffer) -> list[Work]:
        """Writes the camera's picture D s to ``residual``, everywhere."""
        return self._picture(sensor, None, None)

    def _picture(self, sensor: Buffer, wanted: Buffer | None, weights: Buffer | None) -> list[Work]:
        name = "residual_mosaic" if self.mosaic else "residual_plain"
        less = "less_wanted" if wanted is not None else "less_nothing"
        times = "times_weight" if weights is not None else "times_one"
        given = {1: sensor, 2: wanted, 3: weights, 4: self.residual}
        bound = {0: self._camera, **{number: buffer for number, buffer in given.items() if buffer is not None}}
        return [self.device.work(self.device.kernel("camera", less, times, name), bound, self.rows * self.columns)]

    def collect(self) -> list[Work]:
        """Brings the picture in ``residual`` to the sites: D'."""
        if not self.mosaic:
            return []
        kernel = self.device.kernel("camera", "collect")
        return [self.device.work(kernel, [self._camera, self.residual, self._sites], self.rows * self.columns)]

    # constants

    def _band(self, n: int, part: _Windows, mixing: FloatImage) -> Buffer:
        rows, columns = self.sizes[n]
        blocks = -(-columns // BLOCK)
        numbers = [
            columns,
            rows,
            *part.rows,
            part.place_row,
            place_columns(columns),
            part.own[0],
            rows * columns,
            blocks,
        ]
        return self.device.uniform(constants(numbers, mixing))

    def _camera_values(self, colours: npt.NDArray[np.int64]) -> npt.NDArray[np.uint32]:
        four = colours.ravel() if colours.size else np.zeros(4, np.int64)
        numbers = [self.rows, self.columns, self.rows * self.columns, 0, *four]
        return np.array(numbers, np.uint32)


def _box_of(transport: WindowTransport) -> CameraBox:
    """The camera pixels that solves are about: the object and all that is lit, with dark pixels around.

    It begins at a block of the initial estimate, and so at the same colour of the mosaic as the picture does.
    """
    rows, columns = transport.camera_shape
    seen = transport.object_mask.copy()
    seen.reshape(-1)[transport.windows.site % (rows * columns)] = True
    ends = []
    for axis, most in ((1, rows), (0, columns)):
        found = np.flatnonzero(seen.any(axis=axis))
        begin, end = (int(found[0]), int(found[-1]) + 1) if found.size else (0, most)
        ends.append((max(begin // BLOCK_PX - 1, 0) * BLOCK_PX, min((end // BLOCK_PX + 2) * BLOCK_PX, most)))
    (top, bottom), (left, right) = ends
    return CameraBox(top, left, bottom, right)


def constants(numbers: list[int], matrix: FloatImage) -> npt.NDArray[np.uint32]:
    """A kernel's structure: whole numbers, then a matrix (3, 3) in rows of four, from a multiple of 16 bytes on."""
    rows = np.zeros((3, 4), np.float32)
    rows[:, :3] = matrix
    head = np.array(numbers, np.int64).astype(np.uint32)
    return np.concatenate([head, np.zeros(-len(head) % 4, np.uint32), rows.ravel().view(np.uint32)])
