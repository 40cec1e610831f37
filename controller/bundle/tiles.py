"""Images as bands of tiles: compressed, and decoded on several threads, only where they differ from what is there.

A band is a table (``format.TILE_ENTRY``), then its tiles from left to right. A tile keeps the differences of its rows
to the rows above, modulo 256 (docs/reference/bundle-format.md).
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, Final

import cramjam
import numpy as np
import numpy.typing as npt
import xxhash
import zstandard

from controller.bundle import format as fmt
from controller.bundle.format import damaged

_MAX_WINDOW_BYTES: Final = 2**23
_LZ4_LEVEL: Final = 6
_ZSTD: Final = zstandard.ZstdCompressionParameters(
    strategy=zstandard.STRATEGY_LAZY2, window_log=20, hash_log=18, chain_log=18, search_log=5, min_match=6,
    target_length=32, write_content_size=True, write_checksum=False,
)  # fmt: skip
"""Five times the work of level 1, once; then 6 % smaller, a quarter quicker (docs/decisions/0021)."""

Content = npt.NDArray[np.uint64]
"""(bands, tiles across): which pixels each tile of an image has; 0 for unknown ones."""


def packer(codec: str) -> Callable[[bytes], bytes]:
    """What compresses a tile's bytes."""
    if codec == "zstd":
        return zstandard.ZstdCompressor(compression_params=_ZSTD).compress
    import lz4.block

    return partial(lz4.block.compress, mode="high_compression", compression=_LZ4_LEVEL, store_size=False)


def pack_tile(tile: npt.NDArray[np.uint8], pack: Callable[[bytes], bytes]) -> bytes:
    """A tile (rows, columns, 3) compressed."""
    delta = np.array(tile, order="C")
    np.subtract(tile[1:], tile[:-1], out=delta[1:])
    return pack(delta.tobytes())


def pack_bands(image: npt.NDArray[np.uint8], layout: fmt.OutputLayout, codec: str, version: int) -> Iterator[bytes]:
    """The bands of an image (rows, columns, 3) uint8, from the top; without tables before version 3."""
    pack = packer(codec)
    for band in np.split(image, np.cumsum(layout.band_heights)[:-1]):
        tiles = np.split(band, np.cumsum(layout.tile_widths)[:-1], axis=1)
        packed = [pack_tile(tile, pack) for tile in tiles]
        table = np.zeros(len(tiles), fmt.TILE_ENTRY)
        table["length"] = [len(data) for data in packed]
        table["content"] = [xxhash.xxh3_64_intdigest(np.ascontiguousarray(tile).data) for tile in tiles]
        yield (table.tobytes() if version >= fmt.TILED_FROM else b"") + b"".join(packed)


class Inflater:
    """Decompresses; may be used by several threads at once."""

    def __init__(self) -> None:
        # One unpacker a thread: created for each blob, their buffers leave gaps, and memory use grows slowly.
        self._thread = threading.local()

    def into(self, packed: memoryview, values: npt.NDArray[Any], at: int) -> None:
        """Decompress one Zstandard frame into contiguous ``values``, which it must fill; ``at``: its place, for errors.

        Raises BundleError("bundle-damaged").
        """
        try:
            if zstandard.frame_content_size(packed) != values.nbytes:
                raise damaged(f"what is compressed at {at} does not have the size that it should have")
            with self._unpacker().stream_reader(packed, read_size=len(packed)) as stream:
                filled = stream.readinto(values.data.cast("B"))
        except zstandard.ZstdError as error:
            raise damaged(f"what is compressed at {at} can't be decompressed") from error
        if filled != values.nbytes:
            raise damaged(f"what is compressed at {at} ends too early")

    def tile(self, packed: memoryview, codec: str, into: npt.NDArray[np.uint8], at: int) -> None:
        """Decompress a tile's bytes into ``into``, which it must fill. Raises as ``into``."""
        values = into if into.flags.c_contiguous else self._scratch(into.size).reshape(into.shape)
        if codec == "zstd":
            self.into(packed, values, at)
        else:
            try:
                filled = cramjam.lz4.decompress_block_into(packed, values.data)
            except cramjam.DecompressionError as error:
                raise damaged(f"what is compressed at {at} can't be decompressed") from error
            if filled != values.nbytes:
                raise damaged(f"what is compressed at {at} ends too early")
        if values is not into:
            np.copyto(into, values)

    def _unpacker(self) -> zstandard.ZstdDecompressor:
        if not hasattr(self._thread, "unpacker"):
            self._thread.unpacker = zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW_BYTES)
        unpacker: zstandard.ZstdDecompressor = self._thread.unpacker
        return unpacker

    def _scratch(self, size: int) -> npt.NDArray[np.uint8]:
        scratch: npt.NDArray[np.uint8] | None = getattr(self._thread, "scratch", None)
        if scratch is None or scratch.size < size:
            scratch = self._thread.scratch = np.empty(size, np.uint8)
        return scratch[:size]


class TiledImage:
    """One image to be decoded: its bands apart from each other, and the last to end adds the rows up.

    Adding is a numpy call a row for all bands together, so a task for some of them makes as many calls as one for all;
    these are too short for two threads to gain by making them at the same time (docs/decisions/0021). ``content`` is
    what the image holds once all tasks have ended. ``known``: what it holds before; such tiles stay as they are.
    """

    def __init__(
        self,
        bands: Sequence[tuple[fmt.Blob, memoryview]],
        layout: fmt.OutputLayout,
        codec: str | None,
        image: npt.NDArray[np.uint8],
        known: Content | None,
        inflater: Inflater,
    ) -> None:
        """``codec`` None: a band is one Zstandard frame with one tile, as before version 3."""
        self._bands, self._layout, self._codec, self._inflater = bands, layout, codec, inflater
        self._rows = image.reshape(layout.height_px, -1)
        self._edges = 3 * np.cumsum((0, *layout.tile_widths))
        shape = len(bands), len(layout.tile_widths)
        self.content: Content = np.zeros(shape, np.uint64)
        self._known = self.content.copy() if known is None else known
        self._fresh = np.zeros(shape, np.bool_)
        self._left, self._lock = len(bands), threading.Lock()

    def tasks(self) -> list[Callable[[], None]]:
        """What is to be done, in any order, on any threads. Each raises BundleError("bundle-damaged")."""
        return [partial(self._one, number) for number in range(len(self._bands))]

    def _one(self, number: int) -> None:
        blob, packed = self._bands[number]
        if self._codec is None:
            self._stripe(number, blob, packed)
        else:
            self._tiles(number, blob, packed, self._codec)
        with self._lock:
            self._left -= 1
            last = self._left == 0
        if last:
            self._add_rows()

    def _stripe(self, number: int, blob: fmt.Blob, packed: memoryview) -> None:
        self.content[number, 0] = blob.xxh3
        if self._is_there(number, 0):
            return
        _check(blob, packed)
        top = number * self._layout.tile_height_px
        self._inflater.into(packed, self._rows[top : top + self._layout.tile_height_px], blob.offset)
        self._fresh[number, 0] = True

    def _tiles(self, number: int, blob: fmt.Blob, packed: memoryview, codec: str) -> None:
        _check(blob, packed)
        top, across = number * self._layout.tile_height_px, len(self._edges) - 1
        band = self._rows[top : top + self._layout.tile_height_px]
        head = across * fmt.TILE_ENTRY.itemsize
        if len(packed) < head:
            raise damaged(f"the band at {blob.offset} has no table")
        table = np.frombuffer(packed[:head], fmt.TILE_ENTRY)
        ends = head + np.cumsum(table["length"], dtype=np.int64)
        if table["zero"].any() or ends[-1] != len(packed):
            raise damaged(f"the table of the band at {blob.offset} does not fit it")
        self.content[number] = table["content"]
        starts, edges = [head, *ends[:-1].tolist()], self._edges.tolist()
        for n, (start, end) in enumerate(zip(starts, ends.tolist(), strict=True)):
            if self._is_there(number, n):
                continue
            part = band[:, edges[n] : edges[n + 1]]
            self._inflater.tile(packed[start:end], codec, part, blob.offset + start)
            self._fresh[number, n] = True

    def _is_there(self, number: int, n: int) -> bool:
        content = self.content[number, n]
        return bool(content != 0 and content == self._known[number, n])

    def _add_rows(self) -> None:
        """Add to each row of the fresh tiles the row above it, modulo 256: equal bands next to each other together."""
        height = self._layout.tile_height_px
        whole = len(self._rows) // height
        for first, last in _runs(self._fresh[:whole]):
            block = self._rows[first * height : last * height].reshape(last - first, height, -1)
            self._add(block, self._fresh[first])
        if whole < len(self._bands):
            self._add(self._rows[whole * height :][None], self._fresh[whole])

    def _add(self, block: npt.NDArray[np.uint8], fresh: npt.NDArray[np.bool_]) -> None:
        for first, last in _runs(fresh):
            if fresh[first]:
                part = block[:, :, self._edges[first] : self._edges[last]]
                for row in range(1, part.shape[1]):
                    np.add(part[:, row], part[:, row - 1], out=part[:, row])


def _runs(values: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Where runs of equal rows (or values) begin and end."""
    if not len(values):
        return []
    differs = values[1:] != values[:-1]
    changes = differs.any(axis=1) if differs.ndim > 1 else differs
    edges = [0, *(1 + np.flatnonzero(changes)).tolist(), len(values)]
    return list(itertools.pairwise(edges))


def _check(blob: fmt.Blob, packed: memoryview) -> None:
    if xxhash.xxh3_64_intdigest(packed) != blob.xxh3:
        raise damaged(f"the bytes at {blob.offset} do not match their checksum")
