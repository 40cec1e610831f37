"""The index as JSON: written canonically, read with every value checked against its limits. No I/O."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NoReturn

from controller.bundle.format import (
    ALIGNMENTS,
    CODECS,
    FIRST_BLOB,
    LIVE_TYPES,
    MAX_APPEARANCES,
    MAX_DURATION_MS,
    MAX_INDEX_BYTES,
    MAX_INDEX_TABLES,
    MAX_LIVE_ARRAYS,
    MAX_LIVE_BYTES,
    MAX_NAME_BYTES,
    MAX_OUTPUT_NAME_BYTES,
    MAX_OUTPUT_PX,
    MAX_OUTPUTS,
    MAX_SIDE_PX,
    MAX_THUMBNAIL_BYTES,
    MAX_TILE_BYTES,
    MAX_TILES_ACROSS,
    TILED_FROM,
    VERSION,
    Blob,
    BundledAppearance,
    Index,
    LiveArray,
    LiveSection,
    OutputLayout,
    PlaylistEntry,
    band_bound,
    compressed_bound,
    damaged,
    lowest_version,
    valid_name,
)
from controller.core.errors import BundleError


def encode_index(index: Index) -> bytes:
    """The index, in the lowest version that can hold it, as canonical JSON: UTF-8, keys sorted, no spaces.

    Raises BundleError("bundle-metadata").
    """
    tiled = lowest_version(index.outputs, index.codec) >= TILED_FROM
    document = {
        "stage": index.stage,
        "calibration": index.calibration,
        "created_unix_s": index.created_unix_s,
        "revision": index.revision,
        "outputs": [
            {
                "name": o.name,
                "width_px": o.width_px,
                "height_px": o.height_px,
                **({"tile_width_px": o.tile_width_px} if tiled else {}),
                "tile_height_px" if tiled else "stripe_rows": o.tile_height_px,
            }
            for o in index.outputs
        ],
        "appearances": [
            {
                "name": a.name,
                "bands" if tiled else "stripes": {
                    name: [_packed(blob) for blob in blobs] for name, blobs in a.bands.items()
                },
                "thumbnail": None if a.thumbnail is None else _packed(a.thumbnail),
                "metadata": dict(a.metadata),
            }
            for a in index.appearances
        ],
        **({"codec": index.codec} if tiled else {}),
        "schedule": [[hint.appearance, hint.duration_ms, hint.fade_ms] for hint in index.schedule],
        "live": None if index.live is None else _live_document(index.live),
    }
    try:
        text = json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
        data = text.encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise BundleError(
            "bundle-metadata",
            what=f"An appearance's metadata can't be written as JSON ({error}).",
            remedy="Give only texts, finite numbers, true, false, lists and tables.",
        ) from error
    return data


def _live_document(live: LiveSection) -> dict[str, Any]:
    arrays = {
        name: {"dtype": array.dtype, "shape": list(array.shape), "blob": _packed(array.blob)}
        for name, array in live.arrays.items()
    }
    return {"target_px": list(live.target_px), "arrays": arrays}


def _packed(blob: Blob) -> list[int | str]:
    return [blob.offset, blob.length, f"{blob.xxh3:016x}", blob.sha256.hex()]


@dataclass(frozen=True, slots=True)
class _Area:
    """Where blobs may lie: at multiples of ``alignment``, up to ``end`` (bytes from the file's start); the version."""

    version: int
    end: int

    @property
    def alignment(self) -> int:
        return ALIGNMENTS[self.version]

    @property
    def tiled(self) -> bool:
        return self.version >= TILED_FROM


_KEYS: Final = {"stage", "calibration", "created_unix_s", "revision", "outputs", "appearances"}
_LATER_KEYS: Final = {1: _KEYS, 2: _KEYS | {"schedule", "live"}, 3: _KEYS | {"schedule", "live", "codec"}}


def parse_index(data: bytes, *, data_end: int, version: int = VERSION) -> Index:
    """Read an index whose blobs must lie between the header and ``data_end`` (bytes from the file's start).

    Raises BundleError("bundle-damaged") for anything that the format does not allow.
    """
    # No sound index has so many lists and tables; a hostile one would cost a third of a second to parse.
    if len(data) > MAX_INDEX_BYTES or data.count(b"[") + data.count(b"{") > MAX_INDEX_TABLES:
        raise damaged("its index is too large")
    try:
        document = json.loads(data.decode(), object_pairs_hook=_table, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise damaged("its index is not JSON") from error
    top = _fields(document, _LATER_KEYS[version])
    if version < TILED_FROM and len(document) != len(top):
        raise damaged("its index has keys of a later format")
    if top.get("codec", CODECS[0]) not in CODECS:
        raise damaged("its tiles are compressed in an unknown way")
    area = _Area(version, data_end)
    outputs = tuple(_output(item, tiled=area.tiled) for item in _list(top["outputs"], "outputs", 1, MAX_OUTPUTS))
    listed = _list(top["appearances"], "appearances", 0, MAX_APPEARANCES)
    appearances = tuple(_appearance(item, outputs, area) for item in listed)
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
        schedule=_schedule(top.get("schedule", []), {a.name for a in appearances}),
        live=None if top.get("live") is None else _live(top["live"], area),
        codec=top.get("codec", CODECS[0]),
    )


def _table(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) != len(pairs):
        raise ValueError("a key occurs twice")
    return table


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not JSON")


def _fields(value: Any, keys: set[str]) -> dict[str, Any]:
    """A table with these keys. Others are of a later release, and a player can do without them: what it can't do
    without raises the format version.
    """
    if not isinstance(value, dict) or not keys <= value.keys():
        raise damaged(f"a table of its index does not have all keys {', '.join(sorted(keys))}")
    return {key: value[key] for key in keys}


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


def _output(value: Any, *, tiled: bool) -> OutputLayout:
    sides = {"tile_width_px", "tile_height_px"} if tiled else {"stripe_rows"}
    table = _fields(value, {"name", "width_px", "height_px"} | sides)
    width = _whole(table["width_px"], "width_px", 1, MAX_SIDE_PX)
    height = _whole(table["height_px"], "height_px", 1, MAX_SIDE_PX)
    if width * height > MAX_OUTPUT_PX:
        raise damaged(f"an output of {width}x{height} pixels is larger than {MAX_OUTPUT_PX} pixels")
    name = _name(table["name"], MAX_OUTPUT_NAME_BYTES)
    if not tiled:
        return OutputLayout(name, width, height, width, _whole(table["stripe_rows"], "stripe_rows", 1, height))
    across = _whole(table["tile_width_px"], "tile_width_px", -(-width // MAX_TILES_ACROSS), width)
    down = _whole(table["tile_height_px"], "tile_height_px", 1, height)
    if across * down * 3 > MAX_TILE_BYTES:
        raise damaged(f"a tile of {across}x{down} pixels is larger than {MAX_TILE_BYTES} bytes")
    return OutputLayout(name, width, height, across, down)


def _appearance(value: Any, outputs: tuple[OutputLayout, ...], area: _Area) -> BundledAppearance:
    key = "bands" if area.tiled else "stripes"
    table = _fields(value, {"name", key, "thumbnail", "metadata"})
    bands = _fields(table[key], {output.name for output in outputs})
    if len(table[key]) != len(bands):
        raise damaged("an appearance has images of an output that it does not list")
    if not isinstance(table["metadata"], dict):
        raise damaged("the metadata of an appearance is not a table")
    thumbnail = table["thumbnail"]
    return BundledAppearance(
        name=_name(table["name"]),
        bands={o.name: _bands(bands[o.name], o, area) for o in outputs},
        thumbnail=None if thumbnail is None else _blob(thumbnail, MAX_THUMBNAIL_BYTES, area),
        metadata=table["metadata"],
    )


def _schedule(value: Any, names: set[str]) -> tuple[PlaylistEntry, ...]:
    hints = []
    for item in _list(value, "the schedule", 0, MAX_APPEARANCES):
        name, duration, fade = _list(item, "an entry of the schedule", 3, 3)
        if not isinstance(name, str) or name not in names:
            raise damaged("its schedule names an appearance that it does not contain")
        duration = _whole(duration, "a duration", 1, MAX_DURATION_MS)
        hints.append(PlaylistEntry(name, duration, _whole(fade, "a fade", 0, duration)))
    return tuple(hints)


def _live(value: Any, area: _Area) -> LiveSection:
    table = _fields(value, {"target_px", "arrays"})
    width, height = (_whole(side, "target_px", 1, MAX_SIDE_PX) for side in _list(table["target_px"], "target_px", 2, 2))
    arrays = table["arrays"]
    if not isinstance(arrays, dict) or len(arrays) > MAX_LIVE_ARRAYS:
        raise damaged(f"the arrays of its live section are not a table of at most {MAX_LIVE_ARRAYS}")
    return LiveSection((width, height), {_name(name): _live_array(arrays[name], area) for name in sorted(arrays)})


def _live_array(value: Any, area: _Area) -> LiveArray:
    table = _fields(value, {"dtype", "shape", "blob"})
    if table["dtype"] not in LIVE_TYPES:
        raise damaged("an array of its live section has an unknown element type")
    sides = _list(table["shape"], "a shape", 1, 4)
    shape = tuple(_whole(side, "a side of an array", 1, MAX_SIDE_PX) for side in sides)
    raw_bytes = int(table["dtype"][1]) * math.prod(shape)
    if raw_bytes > MAX_LIVE_BYTES:
        raise damaged(f"an array of its live section is larger than {MAX_LIVE_BYTES} bytes")
    return LiveArray(table["dtype"], shape, _blob(table["blob"], compressed_bound(raw_bytes), area))


def _bands(value: Any, output: OutputLayout, area: _Area) -> tuple[Blob, ...]:
    heights = output.band_heights
    blobs = _list(value, f"bands of {output.name}", len(heights), len(heights))
    row_bytes, tiles = output.width_px * 3, len(output.tile_widths)
    most = [
        band_bound(rows * row_bytes, tiles) if area.tiled else compressed_bound(rows * row_bytes) for rows in heights
    ]
    return tuple(_blob(blob, bound, area) for blob, bound in zip(blobs, most, strict=True))


def _blob(value: Any, most_bytes: int, area: _Area) -> Blob:
    offset, length, quick, digest = _list(value, "a blob", 4, 4)
    offset = _whole(offset, "a blob's offset", FIRST_BLOB, area.end)
    length = _whole(length, "a blob's length", 1, most_bytes)
    if offset % area.alignment or offset + length > area.end:
        raise damaged("a blob lies outside the file or is not aligned")
    return Blob(offset, length, int.from_bytes(_hex(quick, 8), "big"), _hex(digest, 32))


def _hex(value: Any, count: int) -> bytes:
    if not isinstance(value, str) or len(value) != 2 * count or set(value) - set("0123456789abcdef"):
        raise damaged("a checksum in its index is not lower-case hexadecimal of the right length")
    return bytes.fromhex(value)
