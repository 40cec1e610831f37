"""Base times scale (paper eqs 4-6): what is kept of a stage for it, and the frames of a target computed from that.

This is the definition (docs/reference/bundle-format.md, "Live section"), light by way of other surfaces included: what
of it falls on blocks of the target is found by samples. ``compensate`` is the reference in numpy; what makes frames at
speed is held against it: ``solve.scaling.interactive`` on the processor, ``play.display.live_targets`` in shaders.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt

from controller.bundle.format import damaged
from controller.bundle.reader import Bundle
from controller.core.channels import own_light

ROUNDS: Final = 3
"""Each leaves about a fifth of the previous error: a surface throws back less than it gets."""
SAMPLES: Final = 64
"""Target pixels that stand for a block."""


@dataclass(frozen=True, slots=True, eq=False)
class LiveIndirect:
    """The maps of indirect light.

    ``factors`` (blocks, blocks) float32: light that falls on a block (row) from the mean light of another (column)
    ``grid``: (rows, columns) of the blocks; ``side``: target pixels along a block
    ``places`` (samples, blocks, 2) uint16: (row, column) of the target pixels that stand for each block
    ``sampled`` (3, samples, blocks, 3) float32: what a sample makes of falling light, its black image, and the most
    direct light that it can have (0 where no projector lights it)
    ``surface`` (height, width, 3) float16: what a target pixel makes of falling light, over its base light
    """

    factors: Float
    grid: tuple[int, int]
    side: float
    places: npt.NDArray[np.uint16]
    sampled: Float
    surface: npt.NDArray[np.float16]

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """As a bundle holds them, by key."""
        return {
            "factors": self.factors, "grid": np.array(self.grid, np.uint16), "side": np.array([self.side], np.float32),
            "places": self.places, "sampled": self.sampled, "surface": self.surface,
        }  # fmt: skip

    def samples(self, image: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """(samples, blocks, channels): the pixels of a target (height, width, channels) that stand for blocks."""
        flat = self.places[..., 0].astype(np.int64) * image.shape[1] + self.places[..., 1]
        return np.asarray(image.reshape(-1, image.shape[-1]).take(flat, axis=0))

    def falling(self, light: Float) -> Float:
        """(grid rows, columns, 3): light that falls on blocks, of the wanted radiance (samples, blocks, 3) of samples.

        What falls is part of the wanted light, so that projectors make less.
        """
        surface, black, most = self.sampled
        above = light - black
        falling: Float = np.zeros((len(self.factors), 3), np.float32)
        for _ in range(ROUNDS):
            direct = surface * falling
            np.subtract(above, direct, out=direct)
            np.clip(direct, 0, most, out=direct)
            falling = self.factors @ direct.mean(axis=0)
        return falling.reshape(*self.grid, 3)

    def spread(self, falling: Float) -> Float:
        """``falling`` (grid rows, columns, 3) at all target pixels: (height, width, 3), between blocks' middles."""
        rows = self.across(falling)
        up, part = between(self.surface.shape[0], self.grid[0], self.side)
        return np.asarray(rows[up] + part[:, None, None] * (rows[np.minimum(up + 1, len(rows) - 1)] - rows[up]))

    def across(self, falling: Float) -> Float:
        """The same in the rows of blocks' middles: (grid rows, width, 3)."""
        left, part = between(self.surface.shape[1], self.grid[1], self.side)
        right = np.minimum(left + 1, self.grid[1] - 1)
        return np.asarray(falling[:, left] + part[:, None] * (falling[:, right] - falling[:, left]), np.float32)


def between(pixels: int, blocks: int, side: float) -> tuple[npt.NDArray[np.int32], Float]:
    """For each pixel of a row or column: the block before it, and the part of the way to the next; (pixels,) each."""
    at = np.clip((np.arange(pixels) - (side - 1) / 2) / side, 0, blocks - 1).astype(np.float32)
    first = np.minimum(at.astype(np.int32), max(blocks - 2, 0)).astype(np.int32)
    return first, (at - first).astype(np.float32)


def read_indirect(
    shaped: Callable[[str, tuple[int, ...], str], npt.NDArray[Any]], size: tuple[int, int]
) -> LiveIndirect:
    """From a bundle's arrays; ``shaped(key, shape, dtype)`` gives one of them, checked.

    ``size``: (height, width) of targets. Raises what ``shaped`` raises, and ValueError where numbers do not fit.
    """
    high, wide = (int(value) for value in shaped("grid", (2,), "u2"))
    side, blocks = float(shaped("side", (1,), "f4")[0]), high * wide
    places = shaped("places", (SAMPLES, blocks, 2), "u2")
    if not side > 0 or (places >= np.array(size)).any():
        raise ValueError("blocks or samples of indirect light lie outside the target")
    return LiveIndirect(
        shaped("factors", (blocks, blocks), "f4"), (high, wide), side, places,
        shaped("sampled", (3, SAMPLES, blocks, 3), "f4"), shaped("surface", (*size, 3), "f2"),
    )  # fmt: skip


MOST_RADIUS_PX: Final = 12
REACH: Final = np.float32(3)
"""Standard deviations at which a Gaussian is cut."""
MOST_CORRELATION: Final = np.float32(0.96)
TILE: Final = 64
FULL: Final = np.float32(65535)

Float = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class OutputMaps:
    """One output's maps.

    ``base`` (rows, columns, 3) uint16 over ``base_range``; ``centre`` (rows, columns, 2) uint16; ``shape``
    (rows, columns, 3) uint8; ``unmix`` (3, 3); ``response`` (3, 256); ``dither`` (rows, columns) into the tile;
    ``segment``: share of white that a white segment makes, 0 without one, below 1.
    """

    name: str
    base: npt.NDArray[np.uint16]
    base_range: tuple[float, float]
    centre: npt.NDArray[np.uint16]
    shape: Bytes
    unmix: Float
    response: Float
    dither: tuple[int, int]
    segment: float = 0.0

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height)."""
        rows, columns, _ = self.base.shape
        return columns, rows

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """As a bundle holds them, by key."""
        arrays: dict[str, npt.NDArray[Any]] = {
            "base": self.base, "range": np.array(self.base_range, np.float32), "centre": self.centre,
            "shape": self.shape, "unmix": self.unmix, "response": self.response,
            "dither": np.array(self.dither, np.uint16),
        }  # fmt: skip
        return arrays | ({"segment": np.array([self.segment], np.float32)} if self.segment else {})


@dataclass(frozen=True, slots=True, eq=False)
class LiveMaps:
    """A stage's maps. ``gain``, ``offset`` (height, width, 3) float16, ``present`` (height, width) uint8.

    ``indirect``: light by way of other surfaces; None where there is none that counts
    ``paint`` (height, width, 3, 3) float16: what is added to the scale of a colour (third axis) of each of them, where
    a lamp's colours depend on the paint; None where they do not
    """

    target_px: tuple[int, int]
    gain: npt.NDArray[np.float16]
    offset: npt.NDArray[np.float16]
    present: Bytes
    unit: float
    noise: Float
    outputs: tuple[OutputMaps, ...]
    indirect: LiveIndirect | None = None
    paint: npt.NDArray[np.float16] | None = None

    @classmethod
    def read(cls, bundle: Bundle) -> Self:
        """Raises BundleError("bundle-not-live" or "bundle-damaged")."""
        gain = bundle.live_array("gain")
        live = bundle.index.live
        assert live is not None
        width, height = live.target_px
        outputs = tuple(
            _output(bundle, o.name, (o.width_px, o.height_px), segmented=f"{o.name}.segment" in live.arrays)
            for o in bundle.index.outputs
        )
        maps = cls(
            (width, height), gain, bundle.live_array("offset"), bundle.live_array("present"),
            float(_shaped(bundle.live_array("unit"), (1,), "f4", "unit")[0]),
            _shaped(bundle.live_array("noise"), (TILE, TILE), "f4", "noise"), outputs,
            _indirect(bundle, (height, width)) if "indirect.factors" in live.arrays else None,
            bundle.live_array("paint") if "paint" in live.arrays else None,
        )  # fmt: skip
        _shaped(maps.gain, (height, width, 3), "f2", "gain")
        _shaped(maps.offset, (height, width, 3), "f2", "offset")
        _shaped(maps.present, (height, width), "u1", "present")
        if maps.paint is not None:
            _shaped(maps.paint, (height, width, 3, 3), "f2", "paint")
        return maps

    def arrays(self) -> Mapping[str, npt.NDArray[Any]]:
        """The bundle's live section: every array by its name in it."""
        parts = {f"{output.name}.{key}": values for output in self.outputs for key, values in output.arrays().items()}
        whole: dict[str, npt.NDArray[Any]] = {"gain": self.gain, "offset": self.offset, "present": self.present}
        if self.indirect is not None:
            parts |= {f"indirect.{key}": values for key, values in self.indirect.arrays().items()}
        if self.paint is not None:
            whole["paint"] = self.paint
        return whole | {"unit": np.array([self.unit], np.float32), "noise": self.noise} | parts


def _indirect(bundle: Bundle, size: tuple[int, int]) -> LiveIndirect:
    def array(key: str, shape: tuple[int, ...], dtype: str) -> npt.NDArray[Any]:
        return _shaped(bundle.live_array(f"indirect.{key}"), shape, dtype, f"indirect.{key}")

    try:
        return read_indirect(array, size)
    except ValueError as wrong:
        raise damaged(str(wrong)) from wrong


def _output(bundle: Bundle, name: str, size_px: tuple[int, int], *, segmented: bool) -> OutputMaps:
    def array(key: str, shape: tuple[int, ...], dtype: str) -> npt.NDArray[Any]:
        return _shaped(bundle.live_array(f"{name}.{key}"), shape, dtype, key)

    columns, rows = size_px
    low, high = map(float, array("range", (2,), "f4"))
    down, along = (int(value) % TILE for value in array("dither", (2,), "u2"))
    segment = float(array("segment", (1,), "f4")[0]) if segmented else 0.0
    if not 0 <= segment < 1:
        raise damaged(f"the array {name}.segment of its live section is {segment:g}, not 0 or more and below 1")
    return OutputMaps(
        name, array("base", (rows, columns, 3), "u2"), (low, high), array("centre", (rows, columns, 2), "u2"),
        array("shape", (rows, columns, 3), "u1"), array("unmix", (3, 3), "f4"), array("response", (3, 256), "f4"),
        (down, along), segment,
    )  # fmt: skip


def _shaped(values: npt.NDArray[Any], shape: tuple[int, ...], dtype: str, name: str) -> npt.NDArray[Any]:
    if values.shape != shape or values.dtype != np.dtype(f"<{dtype}"):
        raise damaged(f"the array {name} of its live section is {values.dtype} {values.shape}, not {dtype} {shape}")
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        raise damaged(f"the array {name} of its live section has values that are not numbers")
    return values


def light_table() -> Float:
    """(256,) linear light of the sRGB values in which targets come (IEC 61966-2-1)."""
    value = np.arange(256) / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)


def sigma_table() -> Float:
    """(256,) standard deviation, in target pixels, of each value in ``shape``; 0 for 0."""
    table = np.exp2((np.arange(256) - 96) / 32).astype(np.float32)
    table[0] = 0
    return table


def packed_shape(sigma: Float, correlation: Float) -> Bytes:
    """Standard deviations (pixels, 2), 0 where a pixel lights nothing, and correlations (pixels,), as ``shape``."""
    lit = sigma[:, :1] > 0
    logarithm = 96 + 32 * np.log2(sigma, out=np.zeros_like(sigma), where=sigma > 0)
    packed = np.concatenate([np.clip(np.rint(logarithm), 1, 255), 128 + np.rint(127 * correlation[:, None])], axis=1)
    return np.asarray(np.where(lit, packed, 0), np.uint8)


def brightness_factor(maps: LiveMaps, brightness: float) -> np.float32:
    """What a target's linear light is multiplied with before ``gain``."""
    return np.float32(brightness / maps.unit)


def compensate(maps: LiveMaps, target: Bytes, brightness: float) -> tuple[Bytes, ...]:
    """The frames, one an output, for a target (height, width, 3) uint8 sRGB; ``brightness``: radiance of its white."""
    return compensate_light(maps, light_table()[target] * np.float32(brightness))


def compensate_light(maps: LiveMaps, light: Float) -> tuple[Bytes, ...]:
    """The frames for a radiance (height, width, 3)."""
    gain = maps.gain.astype(np.float32) * brightness_factor(maps, 1.0)
    above = light * gain - maps.offset.astype(np.float32)
    if maps.indirect is not None:
        falling = maps.indirect.falling(maps.indirect.samples(light))
        above -= maps.indirect.surface.astype(np.float32) * maps.indirect.spread(falling / np.float32(maps.unit))
    if maps.paint is not None:
        above += np.einsum("yxck,yxk->yxc", maps.paint.astype(np.float32), above)
    scale = np.maximum(above, 0)
    return tuple(_frame(maps, output, scale) for output in maps.outputs)


def base_light(output: OutputMaps) -> Float:
    """M p_b, (rows, columns, 3)."""
    low, high = (np.float32(value) for value in output.base_range)
    return np.asarray(low + output.base.astype(np.float32) / FULL * (high - low), np.float32)


def _frame(maps: LiveMaps, output: OutputMaps, scale: Float) -> Bytes:
    frame: Bytes = np.empty(output.base.shape, np.uint8)
    means = _means(maps, output, scale) * base_light(output)
    rows, columns = frame.shape[:2]
    own = own_light(np.clip(means @ output.unmix.T, 0, 1), output.segment)
    for channel in range(3):
        level = device_level(own[..., channel], output.response[channel])
        below = np.floor(level)
        limit = thresholds(maps.noise, output, channel)[np.ix_(np.arange(rows) % TILE, np.arange(columns) % TILE)]
        frame[..., channel] = np.where(level - below > limit, below + 1, below)
    return frame


def thresholds(noise: Float, output: OutputMaps, channel: int) -> Float:
    """(64, 64): the dither's tile as a channel of an output reads it from its upper left corner on."""
    down, along = output.dither
    # Channels read the tile at different places, or colours would speckle together as grey does.
    return np.roll(noise, (-(down + 21 * channel), -(along + 43 * channel)), (0, 1))


def device_level(light: Float, response: Float) -> Float:
    """The device value whose light it is, between two of them the part of the way; ``response`` (256,)."""
    value = np.clip(light, response[0], response[255])
    below = np.clip(np.searchsorted(response, value, side="right") - 1, 0, 254)
    gap = response[below + 1] - response[below]
    part = np.divide(value - response[below], gap, out=np.zeros_like(value), where=gap > 0)
    return np.asarray(below + part, np.float32)


def _means(maps: LiveMaps, output: OutputMaps, scale: Float) -> Float:
    """P_s: (rows, columns, 3), the mean of C_s under each pixel's Gaussian where there is base light."""
    width, height = maps.target_px
    present = maps.present.astype(np.float32) / np.float32(255)
    lit = output.shape[..., 0] > 0
    sides = np.array([width - 1, height - 1], np.float32)
    middle = output.centre[lit].astype(np.float32) / FULL * sides
    sigma = sigma_table()[output.shape[..., :2][lit]]
    correlation = (output.shape[..., 2][lit].astype(np.float32) - np.float32(128)) / np.float32(127)
    correlation = np.clip(correlation, -MOST_CORRELATION, MOST_CORRELATION)
    reach = np.minimum(np.maximum(REACH * sigma, np.float32(0.5)), np.float32(MOST_RADIUS_PX))
    first = np.maximum(np.ceil(middle - reach), 0).astype(np.int64)
    last = np.minimum(np.floor(middle + reach), sides).astype(np.int64)
    total, weight = np.zeros((len(middle), 3), np.float32), np.zeros(len(middle), np.float32)
    for row, column in np.ndindex(*((last - first).max(axis=0, initial=-1) + 1)[::-1]):
        here = np.flatnonzero((first[:, 0] + column <= last[:, 0]) & (first[:, 1] + row <= last[:, 1]))
        x, y = first[here, 0] + column, first[here, 1] + row
        dx = (x.astype(np.float32) - middle[here, 0]) / sigma[here, 0]
        dy = (y.astype(np.float32) - middle[here, 1]) / sigma[here, 1]
        r = correlation[here]
        share = np.exp(np.float32(-0.5) * (dx * dx - 2 * r * dx * dy + dy * dy) / (1 - r * r))
        total[here] += share[:, None] * scale[y, x]
        weight[here] += share * present[y, x]
    means = np.zeros((*lit.shape, 3), np.float32)
    means[lit] = np.divide(total, weight[:, None], out=np.zeros_like(total), where=weight[:, None] > 0)
    return means
