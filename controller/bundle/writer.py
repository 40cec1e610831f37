"""Writes bundles: the same input and the same codec library give the same bytes."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
import numpy.typing as npt
import xxhash
import zstandard
from nacl.signing import SigningKey

from controller.bundle import format as fmt
from controller.bundle.index import encode_index, parse_index
from controller.bundle.reader import Bundle
from controller.bundle.signing import ANY_SIGNER, BLOCK_BYTES, UNSIGNED_BLOCK, sign
from controller.bundle.tiles import pack_bands, pack_tile, packer
from controller.core.errors import BundleError
from controller.core.storage import stream_atomically

FAST_FROM_BYTES: Final = 32 * 1024 * 1024
"""Pixel bytes of a swap from which on decoding counts for more than the file's size (docs/decisions/0021)."""
MOST_LARGER: Final = 1.5
"""So many times larger than with Zstandard a bundle may be for LZ4's sake,"""
MOST_ADDED: Final = 1 / 50
"""plus this share of the pixels' own size: LZ4 keeps 1/255 of even areas, Zstandard nearly nothing."""
_SAMPLED_TILES: Final = 12
"""Of each output; every one is compressed both ways to choose the codec."""
WORTH_NARROW: Final = 0.25
"""Tiles are narrow where so much of the pixels of the first two appearances lies in narrow tiles that are equal."""


@dataclass(frozen=True, slots=True)
class NewAppearance:
    """An appearance to be published.

    ``frames``: for every output its (rows, columns, 3) uint8 device values; ``thumbnail``: a PNG file's bytes or None;
    ``metadata``: a table of JSON values, kept as given.
    """

    name: str
    frames: Mapping[str, npt.NDArray[np.uint8]]
    thumbnail: bytes | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class NewLive:
    """What the live mode needs, to be published.

    ``target_px`` (width, height); ``arrays`` by name, uint8, uint16, float16 or float32, of 1 to 4 dimensions.
    """

    target_px: tuple[int, int]
    arrays: Mapping[str, npt.NDArray[Any]]


@dataclass(frozen=True, slots=True)
class Packing:
    """How a bundle keeps its pictures: the tiles of each output, in stage order, and one of ``format.CODECS``."""

    layouts: tuple[fmt.OutputLayout, ...]
    codec: str


@dataclass(frozen=True, slots=True)
class NewBundle:
    """Metadata of a new bundle, beside its appearances.

    Parameters
    ----------
    stage, calibration : for which stage, and by which of its calibrations
    created_unix_s : when it was made, Unix seconds
    outputs : (name, width_px, height_px) of each output, in stage order
    schedule : the playlist that the bundle suggests
    live : the data of live mode; None leaves it out
    """

    stage: str
    calibration: str
    created_unix_s: int
    outputs: Sequence[tuple[str, int, int]]
    revision: int = 0
    schedule: Sequence[fmt.PlaylistEntry] = ()
    live: NewLive | None = None


def write_bundle(
    path: Path,
    new: NewBundle,
    appearances: Iterable[NewAppearance],
    *,
    key: SigningKey | None = None,
    packing: Packing | None = None,
) -> fmt.Index:
    """Write a bundle atomically and return its index.

    Parameters
    ----------
    appearances : taken one at a time, so that a long list need not be in memory at once
    packing : None lets the first two appearances decide (``choose_packing``)
    key : signs the bundle; None leaves it unsigned, and players refuse it unless they allow unsigned bundles

    Raises BundleError for frames that do not fit the outputs and for names, thumbnails or metadata that the format
    does not allow; WorkError("no-space") when the disk is full. ``path`` is then as it was.
    """
    written: list[fmt.Index] = []

    def write(file: BinaryIO) -> None:
        file.write(bytes(fmt.FIRST_BLOB))
        blobs, coming = _Blobs(file), iter(appearances)
        first = [_checked(new.outputs, appearance) for appearance in itertools.islice(coming, 2)]
        chosen = packing or choose_packing(new.outputs, [appearance.frames for appearance in first])
        parts = []
        while first:
            parts.append(_write_appearance(blobs, chosen, first.pop(0)))
            first += [_checked(new.outputs, appearance) for appearance in itertools.islice(coming, 0 if first else 1)]
        kept = None if new.live is None else _write_live(blobs, new.live)
        index = fmt.Index(
            new.stage, new.calibration, new.created_unix_s, new.revision,
            chosen.layouts, tuple(parts), tuple(new.schedule), kept, chosen.codec,
        )  # fmt: skip
        _finish(blobs, index, key)
        written.append(index)

    stream_atomically(path, write)
    return written[0]


def sign_bundle(path: Path, key: SigningKey) -> bytes:
    """Check a bundle in full and give it the signature of ``key`` in the place of any other; returns the public key.

    Raises BundleError as ``Bundle.open`` and ``Bundle.verify``: what is damaged or forged is not signed.
    """
    with Bundle.open_trusted(path, ANY_SIGNER) as bundle:
        bundle.verify()
        stream_atomically(path, lambda file: bundle.write_signed(file, key))
    return bytes(key.verify_key)


class _Blobs:
    """Writes blobs one after the other; what is written already is not written again."""

    def __init__(self, file: BinaryIO) -> None:
        self.file = file
        self._written: dict[bytes, fmt.Blob] = {}

    def write(self, data: bytes) -> fmt.Blob:
        digest = hashlib.sha256(data).digest()
        if digest not in self._written:
            offset = self.align()
            self.file.write(data)
            self._written[digest] = fmt.Blob(offset, len(data), xxhash.xxh3_64_intdigest(data), digest)
        return self._written[digest]

    def align(self) -> int:
        """Fill up with zeros to the next aligned offset; return it."""
        position = self.file.tell()
        padding = -position % fmt.ALIGNMENT
        self.file.write(bytes(padding))
        return position + padding


def _finish(blobs: _Blobs, index: fmt.Index, key: SigningKey | None) -> None:
    file, end = blobs.file, blobs.align()
    data, version = encode_index(index), fmt.lowest_version(index.outputs, index.codec)
    try:
        parse_index(data, data_end=end, version=version)
    except BundleError as error:
        raise BundleError(
            "bundle-not-writable",
            what=error.what.replace("The bundle can't be written", "The bundle is damaged"),
            remedy="Change the name or size that is not allowed; docs/reference/bundle-format.md lists the limits.",
        ) from error
    size = end + len(data) + BLOCK_BYTES
    header = fmt.pack_header(fmt.Header(end, len(data), size, hashlib.sha256(data).digest(), version))
    file.write(data)
    file.write(UNSIGNED_BLOCK if key is None else sign(header, data, key))
    file.seek(0)
    file.write(header)


def _checked(outputs: Sequence[tuple[str, int, int]], appearance: NewAppearance) -> NewAppearance:
    if set(appearance.frames) != {name for name, _, _ in outputs}:
        raise _unfit(appearance, "does not have exactly one frame for each output")
    for name, width, height in outputs:
        frame = appearance.frames[name]
        if frame.dtype != np.uint8 or frame.shape != (height, width, 3):
            raise _unfit(
                appearance,
                f"has a frame of shape {frame.shape}, dtype {frame.dtype} for {name}, which needs "
                f"({height}, {width}, 3), uint8",
            )
    return appearance


def choose_packing(
    outputs: Sequence[tuple[str, int, int]], frames: Sequence[Mapping[str, npt.NDArray[np.uint8]]]
) -> Packing:
    """What suits such frames: those of a bundle's first two appearances, or of the only one.

    Tiles are as wide as their outputs, which decode quickest, or narrow if enough of these are equal in both. Small
    swaps are decoded in time by either codec, and Zstandard makes them smaller. For large ones LZ4 is taken, unless
    these pixels are of the kind that it hardly compresses. Sizes decide, not times: the same input, the same bytes.
    """
    layouts = tuple(fmt.tiled(*output, narrow=False) for output in outputs)
    if not frames:
        return Packing(layouts, "zstd")
    if len(frames) > 1:
        narrow = tuple(fmt.tiled(*output, narrow=True) for output in outputs)
        equal = sum(_equal_px(frames[0][layout.name], frames[1][layout.name], layout) for layout in narrow)
        if equal >= WORTH_NARROW * sum(layout.width_px * layout.height_px for layout in narrow):
            layouts = narrow
    return Packing(layouts, _choose_codec(layouts, frames[0]))


def _equal_px(one: npt.NDArray[np.uint8], other: npt.NDArray[np.uint8], layout: fmt.OutputLayout) -> int:
    """How many pixels lie in tiles that are equal in two images."""
    found = 0
    for top in range(0, layout.height_px, layout.tile_height_px):
        for left in range(0, layout.width_px, layout.tile_width_px):
            tile = np.s_[top : top + layout.tile_height_px, left : left + layout.tile_width_px]
            if np.array_equal(one[tile], other[tile]):
                found += one[tile].shape[0] * one[tile].shape[1]
    return found


def _choose_codec(layouts: Sequence[fmt.OutputLayout], frames: Mapping[str, npt.NDArray[np.uint8]]) -> str:
    if sum(frame.nbytes for frame in frames.values()) < FAST_FROM_BYTES:
        return "zstd"
    raw, sizes = 0, dict.fromkeys(fmt.CODECS, 0)
    packers = {codec: packer(codec) for codec in fmt.CODECS}
    for layout in layouts:
        tops = range(0, layout.height_px, layout.tile_height_px)
        places = [(top, left) for top in tops for left in range(0, layout.width_px, layout.tile_width_px)]
        for top, left in places[:: max(1, len(places) // _SAMPLED_TILES)]:
            tile = frames[layout.name][top : top + layout.tile_height_px, left : left + layout.tile_width_px]
            raw += tile.nbytes
            for codec, pack in packers.items():
                sizes[codec] += len(pack_tile(tile, pack))
    return "lz4" if sizes["lz4"] <= MOST_LARGER * sizes["zstd"] + MOST_ADDED * raw else "zstd"


def _write_appearance(blobs: _Blobs, packing: Packing, appearance: NewAppearance) -> fmt.BundledAppearance:
    version = fmt.lowest_version(packing.layouts, packing.codec)
    bands = {
        layout.name: tuple(
            blobs.write(band) for band in pack_bands(appearance.frames[layout.name], layout, packing.codec, version)
        )
        for layout in packing.layouts
    }
    thumbnail = appearance.thumbnail
    if thumbnail is not None and (not fmt.is_png(thumbnail) or len(thumbnail) > fmt.MAX_THUMBNAIL_BYTES):
        raise _unfit(appearance, f"has a thumbnail that is not a PNG file of at most {fmt.MAX_THUMBNAIL_BYTES} bytes")
    blob = None if thumbnail is None else blobs.write(thumbnail)
    return fmt.BundledAppearance(appearance.name, bands, blob, dict(appearance.metadata))


def _unfit(appearance: NewAppearance, detail: str) -> BundleError:
    return BundleError(
        "bundle-frame-unfit",
        what=f"The appearance {appearance.name!r} {detail}.",
        remedy="Solve it again for the outputs of this stage.",
    )


def _write_live(blobs: _Blobs, live: NewLive) -> fmt.LiveSection:
    arrays = {}
    for name, values in sorted(live.arrays.items()):
        dtype = values.dtype.str.lstrip("<|")
        if dtype not in fmt.LIVE_TYPES:
            raise BundleError(
                "bundle-live-unfit",
                what=f"The array {name!r} of the live section has elements of type {values.dtype}.",
                remedy=f"Give one of {', '.join(fmt.LIVE_TYPES)}, little-endian.",
            )
        arrays[name] = fmt.LiveArray(dtype, values.shape, blobs.write(_compressed_array(values)))
    return fmt.LiveSection(live.target_px, arrays)


def _compressed_array(values: npt.NDArray[Any]) -> bytes:
    """Whole numbers as differences to the row above, modulo their range; then zstd."""
    delta = np.array(values, order="C")
    if delta.dtype.kind == "u":
        np.subtract(values[1:], values[:-1], out=delta[1:])
    return zstandard.ZstdCompressor(level=3, write_checksum=False, write_content_size=True).compress(delta.tobytes())
