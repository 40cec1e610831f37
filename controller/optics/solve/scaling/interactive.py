"""Base times scale at interactive speed, on the processor (paper 3, eqs 4-6; ``bundle.live_maps`` is the definition).

What the reference gathers pixel by pixel is prepared: each projector pixel's Gaussian as sixteen 8-bit shares of the
blocks around it, what these add up to in the factor of its base, the response as a table over the square root of light.
A block is a target pixel, or several where these are much finer than the projectors' (paper 3.3: the scale has no
detail finer than a projector pixel).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from controller.bundle.live_maps import (
    FULL,
    LiveMaps,
    OutputMaps,
    base_light,
    brightness_factor,
    device_level,
    light_table,
    sigma_table,
    thresholds,
)
from controller.core import channels
from controller.core.arrays import ByteImage, FloatImage
from controller.core.checks import check_shape, not_finite
from controller.optics.calibrate.values import Radiometry
from controller.optics.solve.appearance import Base, StageLight
from controller.optics.solve.bounded.solver import check_target
from controller.optics.solve.scaling.kernels import (
    MARGIN,
    scale_picture,
    scale_plainly,
    scale_twos,
    shares_of,
    show,
    small_picture,
    sums_of,
)
from controller.optics.solve.scaling.reflected import NOTHING, ReflectedLight, Surfaces
from controller.optics.solve.scaling.stage_maps import reduction, scaling_maps
from controller.optics.transport import LightTransport
from controller.optics.transport.indirect.indirect_light import IndirectLight
from controller.optics.transport.simd.scaling import STEPS

BLOCK_SIGMA_PX: Final = 0.56
"""Standard deviation of a projector pixel's Gaussian in blocks, about: four blocks contain it."""


@dataclass(frozen=True, slots=True, eq=False)
class _Output:
    """One projector, ready.

    ``at`` (pixels,) int32: first block of the window, -1 for a pixel that stays dark; ``shares`` (pixels x 16) uint8
    ``gain`` (3 pixels + 1,) float32; ``unmix`` (12,) float32, by columns of four; ``segment``: as of ``OutputMaps``
    ``levels`` (3 x (STEPS + 1),) uint16: 256 times the device value; ``noise`` (64 x 64 x 3,) uint8
    """

    rows: int
    columns: int
    at: npt.NDArray[np.int32]
    shares: ByteImage
    gain: FloatImage
    unmix: FloatImage
    segment: np.float32
    levels: npt.NDArray[np.uint16]
    noise: ByteImage


class Interactive:
    """Frames of a stage for one target after another. Not for two threads at once: working memory is kept.

    ``maps``: those of the stage; ``camera``: (rows, columns) of the radiances that ``frames`` takes
    """

    def __init__(self, maps: LiveMaps, camera: tuple[int, int] | None = None) -> None:
        self.maps = maps
        rows, columns = maps.present.shape
        self.camera = (rows, columns) if camera is None else camera
        self._factor = reduction(self.camera, max(rows, columns)) if camera is not None else 1
        self._block = _block(maps)
        self._size = -(-rows // self._block), -(-columns // self._block)
        self._side = self._size[1] + 2 * MARGIN
        blocks = (self._size[0] + 2 * MARGIN) * self._side
        self._scale = np.zeros(4 * blocks + 16, np.float32)
        # radiance to scale; one float more, because four are read where three are meant
        gain = maps.gain.astype(np.float32)
        self._gain = _padded(gain * brightness_factor(maps, 1.0))
        self._offset = _padded(maps.offset.astype(np.float32))
        self._paint = np.zeros(0, np.float32) if maps.paint is None else maps.paint.astype(np.float32).ravel()
        self._used = _used(maps)
        self._surfaces = None if maps.indirect is None else Surfaces(maps.indirect, gain)
        self._outputs = tuple(self._prepared(output) for output in maps.outputs)
        self._table = light_table()

    def frames(self, target: FloatImage) -> list[ByteImage]:
        """Device values (rows, columns, 3) uint8 of each projector for a radiance (rows, columns, 3) float32.

        Raises UsageError("image-wrong-size", "target-not-finite").
        """
        check_shape("target", target.shape, (*self.camera, 3))
        picture = np.ascontiguousarray(target, np.float32)
        factor, block = self._factor, self._block
        maps = self._gain, self._offset, self._used
        even = not (self.camera[0] % 2 or self.camera[1] % 2)
        plain = self.maps.indirect is None and self.maps.paint is None
        if plain and factor == 2 and block == 1 and even:
            finite = scale_twos(picture.ravel(), *maps, self.camera[1], self._side, self._scale)
        else:
            small = picture if factor == 1 else small_picture(picture, factor)
            finite = scale_plainly(small, block, *maps, self._side, self._scale, self._of(small), self._paint)
        if not finite:
            raise not_finite("target")
        made = self.blank()
        self._show(made)
        return made

    def blank(self) -> list[ByteImage]:
        """Frames of the projectors' sizes for ``show_picture`` to write to; their content is not defined."""
        return [np.empty((output.rows, output.columns, 3), np.uint8) for output in self._outputs]

    def show_picture(self, picture: ByteImage, brightness: float, into: Sequence[ByteImage]) -> None:
        """Write the frames for a picture (height, width, 3) uint8 sRGB of the targets' size.

        ``brightness``: the radiance of its white. Raises UsageError("image-wrong-size").
        """
        width, height = self.maps.target_px
        check_shape(
            "target", picture.shape, (height, width, 3), "Make it as large as the targets of this stage's live mode."
        )
        light = np.float32(brightness) * self._table
        pixels = np.ascontiguousarray(picture, np.uint8)
        surfaces = self._surfaces
        reflected = NOTHING if surfaces is None else surfaces.reflect(light[surfaces.samples(pixels)])
        maps = self._gain, self._offset, self._used
        scale_picture(pixels, light, self._block, *maps, self._side, self._scale, reflected, self._paint)
        self._show(into)

    def _of(self, light: FloatImage) -> ReflectedLight:
        """What surfaces throw back where a radiance (height, width, 3) of the targets' size is seen."""
        surfaces = self._surfaces
        return NOTHING if surfaces is None else surfaces.reflect(surfaces.samples(light))

    def _show(self, into: Sequence[ByteImage]) -> None:
        for output, frame in zip(self._outputs, into, strict=True):
            show(self._scale, self._side, output.at, output.shares, output.gain, output.unmix,
                 output.segment, output.levels, output.noise, output.columns, frame.reshape(-1))  # fmt: skip

    def _prepared(self, output: OutputMaps) -> _Output:
        width, height = self.maps.target_px
        sides = np.array([width - 1, height - 1], np.float32)
        centre = (output.centre.reshape(-1, 2).astype(np.float32) / FULL * sides).astype(np.float32)
        pixels = len(centre)
        at, shares = np.empty(pixels, np.int32), np.zeros((pixels, 16), np.uint8)
        lit = np.ascontiguousarray(self.maps.present)
        shares_of(centre, output.shape.reshape(-1, 3), sigma_table(), self._block, lit, self._side, at, shares)
        present = self._present()
        whole = np.zeros(pixels, np.float32)
        sums_of(present, self._side, at, shares, whole)
        at[whole <= 0] = -1
        gain = np.divide(base_light(output).reshape(-1, 3), whole[:, None],
                         out=np.zeros((pixels, 3), np.float32), where=whole[:, None] > 0)  # fmt: skip
        unmix = np.zeros((3, 4), np.float32)
        unmix[:, :3] = output.unmix.T
        noise = np.stack([thresholds(self.maps.noise, output, c) for c in range(3)], -1)
        return _Output(
            output.size_px[1], output.size_px[0], at, shares.ravel(), _padded(gain), unmix.ravel(),
            np.float32(output.segment), _levels(output.response),
            np.asarray(255 - np.floor(256 * noise), np.uint8).ravel(),
        )  # fmt: skip

    def _present(self) -> FloatImage:
        """The blocks' shares of base light, flat, in the memory order of their scale."""
        rows, columns = self.maps.present.shape
        padded = np.zeros((self._size[0] * self._block, self._size[1] * self._block), np.float32)
        padded[:rows, :columns] = self.maps.present / np.float32(255)
        means = padded.reshape(self._size[0], self._block, self._size[1], self._block).mean(axis=(1, 3))
        return np.pad(means, MARGIN).astype(np.float32).ravel()


def interactive(
    transport: LightTransport,
    base: Base,
    black: FloatImage,
    radiometries: Sequence[Radiometry],
    indirect: IndirectLight | None = None,
) -> Interactive:
    """Prepare ``base`` to be scaled on the clock, by radiances of the camera's size.

    ``black`` (rows, columns, 3); one radiometry a projector. Raises UsageError("response-not-rising"), and as
    ``check_target`` for ``black``.
    """
    check_target(transport.camera_shape, black)
    maps = scaling_maps(StageLight(transport, black, indirect), base, radiometries)
    return Interactive(maps, transport.camera_shape)


def _block(maps: LiveMaps) -> int:
    """How many target pixels a block is wide."""
    shapes = np.concatenate([output.shape.reshape(-1, 3) for output in maps.outputs])
    lit = shapes[shapes[:, 0] > 0, :2]
    sigma = float(np.exp2((np.median(lit) - 96) / 32)) if lit.size else 1.0
    return max(1, min(round(sigma / BLOCK_SIGMA_PX), *maps.target_px))


def _used(maps: LiveMaps) -> npt.NDArray[np.int32]:
    """(height, 2): the first column with base light in each row, and the one after the last."""
    lit = channels.largest(maps.gain) > 0
    found = lit.any(axis=1)
    first, last = lit.argmax(axis=1), lit.shape[1] - lit[:, ::-1].argmax(axis=1)
    return np.stack([np.where(found, first, 0), np.where(found, last, 0)], 1).astype(np.int32)


def _padded(values: FloatImage) -> FloatImage:
    """Flat, with room for one more."""
    return np.append(values.ravel(), np.float32(0)).astype(np.float32)


def _levels(response: FloatImage) -> npt.NDArray[np.uint16]:
    """Flat, by channel: 256 times the device value, with its fraction, whose light is (i / STEPS) squared."""
    light = ((np.arange(STEPS + 1) / STEPS) ** 2).astype(np.float32)
    levels = np.concatenate([device_level(light, channel) for channel in response])
    return np.asarray(np.rint(256 * levels), np.uint16)
