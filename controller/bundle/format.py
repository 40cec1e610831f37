"""What a bundle's bytes mean: header, index, and the values they hold (docs/bundle-format.md). No I/O.

A bundle is one file: header, stripes of compressed pixels, JSON index, signature block. Everything that is read from
it is checked against the limits below before anything of that size is allocated.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NoReturn

from controller.errors import BundleError

MAGIC: Final = b"VELBUNDL"
VERSION: Final = 1
HEADER: Final = struct.Struct("<8sIIQQQ32s56x")
HEADER_BYTES: Final = HEADER.size
ALIGNMENT: Final = 4096
STRIPES_PER_IMAGE: Final = 6

MAX_INDEX_BYTES: Final = 2 * 1024 * 1024
_MAX_INDEX_TABLES: Final = 60_000
MAX_OUTPUTS: Final = 16
MAX_APPEARANCES: Final = 4096
MAX_SIDE_PX: Final = 16384
MAX_OUTPUT_PX: Final = 2**24
MAX_THUMBNAIL_BYTES: Final = 256 * 1024
MAX_NAME_BYTES: Final = 80
MAX_OUTPUT_NAME_BYTES: Final = 39
_PNG: Final = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True, slots=True)
class Header:
    """The first 128 bytes. ``index_offset``, ``index_length`` and ``file_size`` in bytes."""

    index_offset: int
    index_length: int
    file_size: int
    index_sha256: bytes


@dataclass(frozen=True, slots=True)
class Blob:
    """A run of bytes in the file, with its quick checksum (xxh3, 64 bit) and its SHA-256."""

    offset: int
    length: int
    xxh3: int
    sha256: bytes


@dataclass(frozen=True, slots=True)
class OutputLayout:
    """One projector output: its size, and how many rows each stripe of its image has (the last may have fewer)."""

    name: str
    width_px: int
    height_px: int
    stripe_rows: int

    @property
    def stripe_heights(self) -> tuple[int, ...]:
        """Rows of each stripe, from the top."""
        whole, rest = divmod(self.height_px, self.stripe_rows)
        return (self.stripe_rows,) * whole + ((rest,) if rest else ())


@dataclass(frozen=True, slots=True)
class Appearance:
    """One appearance: the stripes of each output's image from top to bottom, a PNG thumbnail, free metadata (JSON)."""

    name: str
    stripes: Mapping[str, tuple[Blob, ...]]
    thumbnail: Blob | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Index:
    """What a bundle holds and where.

    ``stage`` and ``calibration`` say for which stage and from which calibration it was made; ``created_unix_s`` is
    given by whoever publishes; ``revision`` never goes down on a kiosk (see ``install``).
    """

    stage: str
    calibration: str
    created_unix_s: int
    revision: int
    outputs: tuple[OutputLayout, ...]
    appearances: tuple[Appearance, ...]

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

    def appearance(self, name: str) -> Appearance:
        """The appearance of this name. Raises BundleError("bundle-no-appearance")."""
        for appearance in self.appearances:
            if appearance.name == name:
                return appearance
        raise BundleError(
            "bundle-no-appearance",
            what=f"The bundle has no appearance {name!r}; it has {_listed(a.name for a in self.appearances)}.",
            remedy="Choose one of those, or publish a bundle that has it.",
        )


def _listed(names: Any) -> str:
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
    """The most bytes that a compressed stripe of ``raw_bytes`` may take; more is refused unread."""
    return raw_bytes + raw_bytes // 128 + 1024


def pack_header(header: Header) -> bytes:
    """The 128 bytes of a header."""
    return HEADER.pack(
        MAGIC, VERSION, 0, header.index_offset, header.index_length, header.file_size, header.index_sha256
    )


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
    if version != VERSION:
        raise BundleError(
            "bundle-version",
            what=f"The bundle has format version {version}; this player reads version {VERSION}.",
            remedy="Publish the bundle again with this version of Velatura.",
        )
    header = Header(offset, length, size, digest)
    if flags or data[:HEADER_BYTES] != pack_header(header):
        raise damaged("reserved bytes of the header are not zero")
    if size != file_size:
        raise damaged(f"it has {file_size} bytes, and its header says {size}")
    if not 2 <= length <= MAX_INDEX_BYTES:
        raise damaged(f"its index of {length} bytes is outside 2 to {MAX_INDEX_BYTES}")
    if offset < HEADER_BYTES or offset + length + trailer_bytes != size:
        raise damaged("its index does not lie at its end")
    return header


def encode_index(index: Index) -> bytes:
    """The index as canonical JSON: UTF-8, keys sorted, no spaces. Raises BundleError if it breaks a limit."""
    document = {
        "stage": index.stage,
        "calibration": index.calibration,
        "created_unix_s": index.created_unix_s,
        "revision": index.revision,
        "outputs": [
            {"name": o.name, "width_px": o.width_px, "height_px": o.height_px, "stripe_rows": o.stripe_rows}
            for o in index.outputs
        ],
        "appearances": [
            {
                "name": a.name,
                "stripes": {name: [_packed(blob) for blob in blobs] for name, blobs in a.stripes.items()},
                "thumbnail": None if a.thumbnail is None else _packed(a.thumbnail),
                "metadata": dict(a.metadata),
            }
            for a in index.appearances
        ],
    }
    try:
        text = json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
        data = text.encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise BundleError(
            "bundle-metadata",
            what=f"An appearance's metadata can not be written as JSON ({error}).",
            remedy="Give only texts, finite numbers, true, false, lists and tables.",
        ) from error
    return data


def _packed(blob: Blob) -> list[int | str]:
    return [blob.offset, blob.length, f"{blob.xxh3:016x}", blob.sha256.hex()]


def parse_index(data: bytes, *, data_end: int) -> Index:
    """Read an index whose stripes must lie between the header and ``data_end`` (bytes from the file's start).

    Raises BundleError("bundle-damaged") for anything that the format does not allow.
    """
    # No sound index has so many lists and tables; a hostile one would cost a third of a second to parse.
    if len(data) > MAX_INDEX_BYTES or data.count(b"[") + data.count(b"{") > _MAX_INDEX_TABLES:
        raise damaged("its index is too large")
    try:
        document = json.loads(data.decode(), object_pairs_hook=_table, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise damaged("its index is not JSON") from error
    top = _fields(document, {"stage", "calibration", "created_unix_s", "revision", "outputs", "appearances"})
    outputs = tuple(_output(item) for item in _list(top["outputs"], "outputs", 1, MAX_OUTPUTS))
    listed = _list(top["appearances"], "appearances", 0, MAX_APPEARANCES)
    appearances = tuple(_appearance(item, outputs, data_end) for item in listed)
    for what, names in (("outputs", [o.name for o in outputs]), ("appearances", [a.name for a in appearances])):
        if len(set(names)) != len(names):
            raise damaged(f"two of its {what} have the same name")
    return Index(
        stage=_name(top["stage"]),
        calibration=_name(top["calibration"]),
        created_unix_s=_whole(top["created_unix_s"], "created_unix_s", 0, 2**53),
        revision=_whole(top["revision"], "revision", 0, 2**53),
        outputs=outputs,
        appearances=appearances,
    )


def _table(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) != len(pairs):
        raise ValueError("a key stands twice")
    return table


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not JSON")


def _fields(value: Any, keys: set[str]) -> dict[str, Any]:
    if not isinstance(value, dict) or value.keys() != keys:
        raise damaged(f"a table of its index does not have exactly the keys {', '.join(sorted(keys))}")
    return value


def _list(value: Any, what: str, least: int, most: int) -> list[Any]:
    if not isinstance(value, list) or not least <= len(value) <= most:
        raise damaged(f"{what} of its index is not a list of {least} to {most}")
    return value


def _whole(value: Any, what: str, least: int, most: int) -> int:
    if type(value) is not int or not least <= value <= most:
        raise damaged(f"{what} of its index is not a whole number from {least} to {most}")
    return value


def _name(value: Any, most_bytes: int = MAX_NAME_BYTES) -> str:
    if not isinstance(value, str) or not valid_name(value, most_bytes):
        raise damaged("a name in its index is empty, too long, or has characters that names may not have")
    return value


def valid_name(name: str, most_bytes: int = MAX_NAME_BYTES) -> bool:
    """Whether a name is 1 to ``most_bytes`` of printable UTF-8 that is safe as a file's name."""
    safe = name.isprintable() and not name.startswith(".") and not set(name) & set("/\\")
    return safe and 1 <= len(name.encode(errors="replace")) <= most_bytes


def _output(value: Any) -> OutputLayout:
    table = _fields(value, {"name", "width_px", "height_px", "stripe_rows"})
    width = _whole(table["width_px"], "width_px", 1, MAX_SIDE_PX)
    height = _whole(table["height_px"], "height_px", 1, MAX_SIDE_PX)
    if width * height > MAX_OUTPUT_PX:
        raise damaged(f"an output of {width}x{height} pixels is larger than {MAX_OUTPUT_PX} pixels")
    rows = _whole(table["stripe_rows"], "stripe_rows", 1, height)
    return OutputLayout(_name(table["name"], MAX_OUTPUT_NAME_BYTES), width, height, rows)


def _appearance(value: Any, outputs: tuple[OutputLayout, ...], data_end: int) -> Appearance:
    table = _fields(value, {"name", "stripes", "thumbnail", "metadata"})
    stripes = _fields(table["stripes"], {output.name for output in outputs})
    if not isinstance(table["metadata"], dict):
        raise damaged("the metadata of an appearance is not a table")
    thumbnail = table["thumbnail"]
    return Appearance(
        name=_name(table["name"]),
        stripes={o.name: _stripes(stripes[o.name], o, data_end) for o in outputs},
        thumbnail=None if thumbnail is None else _blob(thumbnail, MAX_THUMBNAIL_BYTES, data_end),
        metadata=table["metadata"],
    )


def _stripes(value: Any, output: OutputLayout, data_end: int) -> tuple[Blob, ...]:
    heights = output.stripe_heights
    blobs = _list(value, f"stripes of {output.name}", len(heights), len(heights))
    row_bytes = output.width_px * 3
    return tuple(
        _blob(blob, compressed_bound(rows * row_bytes), data_end) for blob, rows in zip(blobs, heights, strict=True)
    )


def _blob(value: Any, most_bytes: int, data_end: int) -> Blob:
    offset, length, quick, digest = _list(value, "a stripe", 4, 4)
    offset = _whole(offset, "a stripe's offset", ALIGNMENT, data_end)
    length = _whole(length, "a stripe's length", 1, most_bytes)
    if offset % ALIGNMENT or offset + length > data_end:
        raise damaged("a stripe lies outside the file or is not aligned")
    return Blob(offset, length, int.from_bytes(_hex(quick, 8), "big"), _hex(digest, 32))


def _hex(value: Any, count: int) -> bytes:
    if not isinstance(value, str) or len(value) != 2 * count or set(value) - set("0123456789abcdef"):
        raise damaged("a checksum in its index is not lower-case hexadecimal of the right length")
    return bytes.fromhex(value)


def is_png(data: bytes) -> bool:
    """Whether a thumbnail begins as a PNG file does."""
    return data.startswith(_PNG)
