"""Writes bundles: the same input and the same codec library give the same bytes."""

from __future__ import annotations

import hashlib
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
from controller.core.errors import BundleError
from controller.core.storage import stream_atomically

STRIPE_PARAMETERS: Final = zstandard.ZstdCompressionParameters(
    strategy=zstandard.STRATEGY_LAZY2, window_log=20, hash_log=18, chain_log=18, search_log=5, min_match=6,
    target_length=32, write_content_size=True, write_checksum=False,
)  # fmt: skip
"""Five times the work of level 1, once; then 6 % smaller, a quarter quicker (docs/reference/bundle-format.md)."""


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


def write_bundle(
    path: Path,
    *,
    stage: str,
    calibration: str,
    created_unix_s: int,
    outputs: Sequence[tuple[str, int, int]],
    appearances: Iterable[NewAppearance],
    key: SigningKey | None = None,
    revision: int = 0,
    schedule: Sequence[fmt.PlaylistEntry] = (),
    live: NewLive | None = None,
) -> fmt.Index:
    """Write a bundle atomically and return its index.

    Parameters
    ----------
    outputs : (name, width_px, height_px) of each output, in stage order
    appearances : taken one at a time, so that a long list need not be in memory at once
    schedule : the playlist that the bundle suggests
    key : signs the bundle; None leaves it unsigned, and players refuse it unless they allow unsigned bundles

    Raises BundleError for frames that do not fit the outputs and for names, thumbnails or metadata that the format
    does not allow; WorkError("no-space") when the disk is full. ``path`` is then as it was.
    """
    layouts = tuple(fmt.OutputLayout(n, w, h, -(-h // fmt.STRIPES_PER_IMAGE)) for n, w, h in outputs)
    written: list[fmt.Index] = []

    def write(file: BinaryIO) -> None:
        file.write(bytes(fmt.FIRST_BLOB))
        parts = tuple(_write_appearance(file, layouts, appearance) for appearance in appearances)
        kept = None if live is None else _write_live(file, live)
        index = fmt.Index(stage, calibration, created_unix_s, revision, layouts, parts, tuple(schedule), kept)
        _finish(file, index, key)
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


def _finish(file: BinaryIO, index: fmt.Index, key: SigningKey | None) -> None:
    end = _align(file)
    data = encode_index(index)
    try:
        parse_index(data, data_end=end)
    except BundleError as error:
        raise BundleError(
            "bundle-not-writable",
            what=error.what.replace("The bundle can't be written", "The bundle is damaged"),
            remedy="Change the name or size that is not allowed; docs/reference/bundle-format.md lists the limits.",
        ) from error
    size = end + len(data) + BLOCK_BYTES
    header = fmt.pack_header(fmt.Header(end, len(data), size, hashlib.sha256(data).digest()))
    file.write(data)
    file.write(UNSIGNED_BLOCK if key is None else sign(header, data, key))
    file.seek(0)
    file.write(header)


def _write_appearance(
    file: BinaryIO, layouts: Sequence[fmt.OutputLayout], appearance: NewAppearance
) -> fmt.BundledAppearance:
    if set(appearance.frames) != {layout.name for layout in layouts}:
        raise _unfit(appearance, "does not have exactly one frame for each output")
    stripes = {}
    for layout in layouts:
        frame = appearance.frames[layout.name]
        if frame.dtype != np.uint8 or frame.shape != (layout.height_px, layout.width_px, 3):
            raise _unfit(
                appearance,
                f"has a frame of shape {frame.shape}, dtype {frame.dtype} for {layout.name}, which needs "
                f"({layout.height_px}, {layout.width_px}, 3), uint8",
            )
        stripes[layout.name] = tuple(_write_blob(file, data) for data in compress_image(frame, layout))
    thumbnail = appearance.thumbnail
    if thumbnail is not None and (not fmt.is_png(thumbnail) or len(thumbnail) > fmt.MAX_THUMBNAIL_BYTES):
        raise _unfit(appearance, f"has a thumbnail that is not a PNG file of at most {fmt.MAX_THUMBNAIL_BYTES} bytes")
    blob = None if thumbnail is None else _write_blob(file, thumbnail)
    return fmt.BundledAppearance(appearance.name, stripes, blob, dict(appearance.metadata))


def _unfit(appearance: NewAppearance, detail: str) -> BundleError:
    return BundleError(
        "bundle-frame-unfit",
        what=f"The appearance {appearance.name!r} {detail}.",
        remedy="Solve it again for the outputs of this stage.",
    )


def compress_image(frame: npt.NDArray[np.uint8], layout: fmt.OutputLayout) -> Iterable[bytes]:
    """The compressed stripes of one (rows, columns, 3) uint8 image: rows less the row above, modulo 256, then zstd."""
    packer = zstandard.ZstdCompressor(compression_params=STRIPE_PARAMETERS)
    for top in range(0, layout.height_px, layout.stripe_rows):
        stripe = frame[top : top + layout.stripe_rows]
        delta = stripe.copy()
        np.subtract(stripe[1:], stripe[:-1], out=delta[1:])
        yield packer.compress(delta.tobytes())


def _write_live(file: BinaryIO, live: NewLive) -> fmt.LiveSection:
    arrays = {}
    for name, values in sorted(live.arrays.items()):
        dtype = values.dtype.str.lstrip("<|")
        if dtype not in fmt.LIVE_TYPES:
            raise BundleError(
                "bundle-live-unfit",
                what=f"The array {name!r} of the live section has elements of type {values.dtype}.",
                remedy=f"Give one of {', '.join(fmt.LIVE_TYPES)}, little-endian.",
            )
        arrays[name] = fmt.LiveArray(dtype, values.shape, _write_blob(file, _compressed_array(values)))
    return fmt.LiveSection(live.target_px, arrays)


def _compressed_array(values: npt.NDArray[Any]) -> bytes:
    """Whole numbers as differences to the row above, modulo their range; then zstd."""
    delta = np.array(values, order="C")
    if delta.dtype.kind == "u":
        np.subtract(values[1:], values[:-1], out=delta[1:])
    return zstandard.ZstdCompressor(level=3, write_checksum=False, write_content_size=True).compress(delta.tobytes())


def _write_blob(file: BinaryIO, data: bytes) -> fmt.Blob:
    offset = _align(file)
    file.write(data)
    return fmt.Blob(offset, len(data), xxhash.xxh3_64_intdigest(data), hashlib.sha256(data).digest())


def _align(file: BinaryIO) -> int:
    """Fill up with zeros to the next aligned offset; return it."""
    position = file.tell()
    padding = -position % fmt.ALIGNMENT
    file.write(bytes(padding))
    return position + padding
