"""Constants, limits, header and index values of a bundle (docs/reference/bundle-format.md). No I/O.

A bundle is one file: header, bands of compressed tiles, JSON index, signature block. Everything that is read from
it is checked against the limits below before anything of that size is allocated.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from controller.core.errors import BundleError

MAGIC: Final = b"VELBUNDL"
VERSION: Final = 3
READABLE: Final = (1, 2, 3)
HEADER: Final = struct.Struct("<8sIIQQQ32s56x")
HEADER_BYTES: Final = HEADER.size
FIRST_BLOB: Final = 4096
ALIGNMENTS: Final = {1: 4096, 2: 64, 3: 64}
"""Alignment of blobs by format version. 4 KiB cost a bundle 1 to 15 % of its size, and nothing reads whole pages of
it."""
ALIGNMENT: Final = ALIGNMENTS[VERSION]
TILED_FROM: Final = 3
"""The first version whose images are tiles; before it they were stripes, which are read as tiles of full width."""
BAND_BYTES: Final = 768 * 1024
"""The most pixel bytes that the writer puts into a band: its rows are added up in a processor core's own cache."""
NARROW_PX: Final = 320
"""About so wide are narrow tiles: even narrower ones cost more calls than the pixels that they spare."""

MAX_INDEX_BYTES: Final = 2 * 1024 * 1024
MAX_INDEX_TABLES: Final = 60_000
MAX_OUTPUTS: Final = 16
MAX_APPEARANCES: Final = 4096
MAX_SIDE_PX: Final = 16384
MAX_OUTPUT_PX: Final = 2**24
MAX_TILE_BYTES: Final = 2**22
MAX_TILES_ACROSS: Final = 256
MAX_THUMBNAIL_BYTES: Final = 256 * 1024
MAX_LIVE_ARRAYS: Final = 128
MAX_LIVE_BYTES: Final = 2**28
"""Of one array of the live section, decompressed."""
MAX_DURATION_MS: Final = 366 * 86_400_000
CODECS: Final = ("zstd", "lz4")
"""How tiles may be compressed: Zstandard frames, or LZ4 blocks, which take more room and a third of the time."""
LIVE_TYPES: Final = ("u1", "u2", "f2", "f4")
"""Element types of the live section, little-endian, as numpy names them."""
MAX_NAME_BYTES: Final = 80
MAX_OUTPUT_NAME_BYTES: Final = 39
TILE_ENTRY: Final = np.dtype([("length", "<u4"), ("zero", "<u4"), ("content", "<u8")])
"""A row of the table at the beginning of a band: compressed bytes of the tile, 0, and the xxh3 of its pixels."""
_PNG: Final = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True, slots=True)
class Header:
    """The first 128 bytes. ``index_offset``, ``index_length`` and ``file_size`` in bytes."""

    index_offset: int
    index_length: int
    file_size: int
    index_sha256: bytes
    version: int = VERSION


@dataclass(frozen=True, slots=True)
class Blob:
    """A run of bytes in the file, with its quick checksum (xxh3, 64 bit) and its SHA-256."""

    offset: int
    length: int
    xxh3: int
    sha256: bytes


@dataclass(frozen=True, slots=True)
class OutputLayout:
    """One projector output: its size, and that of the tiles of its image (the last of a row or column may be less)."""

    name: str
    width_px: int
    height_px: int
    tile_width_px: int
    tile_height_px: int

    @property
    def band_heights(self) -> tuple[int, ...]:
        """Rows of each band of tiles, from the top."""
        return _parts(self.height_px, self.tile_height_px)

    @property
    def tile_widths(self) -> tuple[int, ...]:
        """Columns of each tile of a band, from the left."""
        return _parts(self.width_px, self.tile_width_px)


def _parts(whole: int, part: int) -> tuple[int, ...]:
    count, rest = divmod(whole, part)
    return (part,) * count + ((rest,) if rest else ())


def tiled(name: str, width_px: int, height_px: int, *, narrow: bool) -> OutputLayout:
    """The layout that the writer gives an output of this size; tiles are as wide as it unless ``narrow``."""
    bands = -(-height_px * width_px * 3 // BAND_BYTES)
    across = max(1, round(width_px / NARROW_PX)) if narrow else 1
    return OutputLayout(name, width_px, height_px, -(-width_px // across), -(-height_px // bands))


def lowest_version(layouts: Iterable[OutputLayout], codec: str) -> int:
    """The version to write, so that players before version 3 read what they can show: images that need no tiles."""
    stripes = codec == CODECS[0] and all(layout.tile_width_px == layout.width_px for layout in layouts)
    return TILED_FROM - 1 if stripes else VERSION


@dataclass(frozen=True, slots=True)
class BundledAppearance:
    """One appearance: the bands of each output's image from top to bottom, a PNG thumbnail, free metadata (JSON)."""

    name: str
    bands: Mapping[str, tuple[Blob, ...]]
    thumbnail: Blob | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class PlaylistEntry:
    """One entry of the playlist that a bundle suggests; a player may ignore it."""

    appearance: str
    duration_ms: int
    fade_ms: int


@dataclass(frozen=True, slots=True)
class LiveArray:
    """An array of the live section: ``dtype`` one of ``LIVE_TYPES``, its shape, and where its compressed bytes are."""

    dtype: str
    shape: tuple[int, ...]
    blob: Blob

    @property
    def raw_bytes(self) -> int:
        """Its size in memory."""
        return int(self.dtype[1]) * math.prod(self.shape)


@dataclass(frozen=True, slots=True)
class LiveSection:
    """What the live mode needs (docs/reference/bundle-format.md, "Live section"); ``target_px`` is (width, height)."""

    target_px: tuple[int, int]
    arrays: Mapping[str, LiveArray]


@dataclass(frozen=True, slots=True)
class Index:
    """What a bundle holds and where.

    ``stage`` and ``calibration`` say for which stage and from which calibration it was made; ``created_unix_s`` is
    given by the publisher; ``revision`` never goes down on a kiosk (see ``install``). Version 1 has neither
    ``schedule`` nor ``live``; versions 1 and 2 have one codec. ``codec`` is one of ``CODECS``.
    """

    stage: str
    calibration: str
    created_unix_s: int
    revision: int
    outputs: tuple[OutputLayout, ...]
    appearances: tuple[BundledAppearance, ...]
    schedule: tuple[PlaylistEntry, ...] = ()
    live: LiveSection | None = None
    codec: str = "zstd"

    def output(self, name: str) -> OutputLayout:
        """The output of this name. Raises BundleError("bundle-no-output")."""
        for output in self.outputs:
            if output.name == name:
                return output
        raise BundleError(
            "bundle-no-output",
            what=f"The bundle has no output {name!r}; it has {_listed(o.name for o in self.outputs)}.",
            remedy="Publish a bundle for this stage's outputs.",
        )

    def appearance(self, name: str) -> BundledAppearance:
        """The appearance of this name. Raises BundleError("bundle-no-appearance")."""
        for appearance in self.appearances:
            if appearance.name == name:
                return appearance
        raise BundleError(
            "bundle-no-appearance",
            what=f"The bundle has no appearance {name!r}; it has {_listed(a.name for a in self.appearances)}.",
            remedy="Choose one of those, or publish a bundle that has it.",
        )


def _listed(names: Iterable[str]) -> str:
    shown = [repr(name) for name in names]
    return ", ".join(shown[:20]) + (f" and {len(shown) - 20} more" if len(shown) > 20 else "") if shown else "none"


def damaged(detail: str) -> BundleError:
    """The error for bytes that are not what the format says. ``detail`` completes "The bundle is damaged: "."""
    return BundleError(
        "bundle-damaged",
        what=f"The bundle is damaged: {detail}.",
        remedy="Copy or publish the bundle again; nothing of this one was used.",
    )


def compressed_bound(raw_bytes: int) -> int:
    """The most bytes that a compressed tile of ``raw_bytes`` may take; more is refused unread."""
    return raw_bytes + raw_bytes // 128 + 1024


def band_bound(raw_bytes: int, tiles: int) -> int:
    """The most bytes that a band of so many tiles may take, its table included."""
    return raw_bytes + raw_bytes // 128 + tiles * (1024 + TILE_ENTRY.itemsize)


def pack_header(header: Header) -> bytes:
    """The 128 bytes of a header."""
    return HEADER.pack(
        MAGIC, header.version, 0, header.index_offset, header.index_length, header.file_size, header.index_sha256
    )


def version_of(data: bytes) -> int | None:
    """The format version of a file that begins with ``data``; None for a file that is not a bundle."""
    return HEADER.unpack(data)[1] if len(data) == HEADER_BYTES and data[:8] == MAGIC else None


def parse_header(data: bytes, *, file_size: int, trailer_bytes: int) -> Header:
    """Read the first 128 bytes of a file that has ``file_size`` bytes and ends with ``trailer_bytes`` after its index.

    Raises BundleError("bundle-foreign", "bundle-version" or "bundle-damaged").
    """
    if len(data) < HEADER_BYTES or data[:8] != MAGIC:
        raise BundleError(
            "bundle-foreign",
            what="The file is not a Velatura bundle.",
            remedy="Give the .vel file that 'velatura bundle build' wrote.",
        )
    _, version, flags, offset, length, size, digest = HEADER.unpack(data[:HEADER_BYTES])
    if version not in READABLE:
        raise BundleError(
            "bundle-version",
            what=f"The bundle has format version {version}; this player reads versions {READABLE[0]} to {VERSION}.",
            remedy="Publish the bundle again with this version of Velatura.",
        )
    header = Header(offset, length, size, digest, version)
    if flags or data[:HEADER_BYTES] != pack_header(header):
        raise damaged("reserved bytes of the header are not zero")
    if size != file_size:
        raise damaged(f"the file has {file_size} bytes, but its header says {size}")
    if not 2 <= length <= MAX_INDEX_BYTES:
        raise damaged(f"its index of {length} bytes is outside 2 to {MAX_INDEX_BYTES}")
    if offset < HEADER_BYTES or offset + length + trailer_bytes != size:
        raise damaged("its index is not at its end")
    return header


def valid_name(name: str, most_bytes: int = MAX_NAME_BYTES) -> bool:
    """Whether a name is 1 to ``most_bytes`` of printable UTF-8 that is safe as a file's name."""
    safe = name.isprintable() and not name.startswith(".") and not set(name) & set("/\\")
    return safe and 1 <= len(name.encode(errors="replace")) <= most_bytes


def is_png(data: bytes) -> bool:
    """Whether a thumbnail begins as a PNG file does."""
    return data.startswith(_PNG)
