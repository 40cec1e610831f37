"""Reads bundles: memory-mapped, every size checked before it is used, decoding into buffers that the caller owns."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import mmap
import os
import stat
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np
import numpy.typing as npt
import xxhash
from nacl.signing import SigningKey

from controller.bundle import format as fmt
from controller.bundle.format import damaged
from controller.bundle.index import parse_index
from controller.bundle.signing import BLOCK_BYTES, Trust, check_signature, sign
from controller.bundle.tiles import Content, Inflater, TiledImage
from controller.core.errors import BundleError


class Bundle:
    """An opened bundle: ``index`` says what it holds, ``signed_by`` who signed it (a public key, or None).

    ``identity`` is the SHA-256 of its index in hex: it changes with every pixel. Safe to decode from several threads.
    """

    def __init__(
        self,
        data: mmap.mmap,
        path: Path,
        *,
        trusted: Sequence[bytes],
        allow_unsigned: bool,
        revoked: Sequence[bytes] = (),
    ) -> None:
        self._data = data
        self.path = path
        start = data[: fmt.HEADER_BYTES]
        header = fmt.parse_header(start, file_size=len(data), trailer_bytes=BLOCK_BYTES)
        end = header.index_offset + header.index_length
        index_bytes, block = data[header.index_offset : end], data[end : end + BLOCK_BYTES]
        if hashlib.sha256(index_bytes).digest() != header.index_sha256:
            raise damaged("its index does not match the hash in its header")
        self.signed_by = check_signature(
            start, index_bytes, block, trusted=trusted, allow_unsigned=allow_unsigned, revoked=revoked
        )
        self.index = parse_index(index_bytes, data_end=header.index_offset, version=header.version)
        self.version = header.version
        self.identity = header.index_sha256.hex()
        self._data_end = header.index_offset
        self._inflater = Inflater()

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return len(self._data)

    @classmethod
    def open_trusted(cls, path: Path, trust: Trust) -> Self:
        """As ``open``, with what may be used as one value."""
        return cls.open(path, trusted=trust.keys, allow_unsigned=trust.allow_unsigned, revoked=trust.revoked)

    @classmethod
    def open(
        cls, path: Path, *, trusted: Sequence[bytes] = (), allow_unsigned: bool = False, revoked: Sequence[bytes] = ()
    ) -> Self:
        """Map a bundle and check header, index and signature (not yet the pixels: see ``verify``).

        ``trusted``, ``revoked``: public keys, 32 bytes each. Raises BundleError, with code "bundle-unreadable" for a
        file that can not be opened, and those of ``format.parse_header``, ``index.parse_index`` and
        ``signing.check_signature``.
        """
        try:
            # Not blocking: opening a pipe would otherwise wait for its other end, and the player with it.
            with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
                if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                    raise OSError(errno.EINVAL, "it is not a file")
                data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except OSError as error:
            raise BundleError(
                "bundle-unreadable",
                what=f"The bundle {path} can't be read: {error.strerror}.",
                remedy="Check the path and the file's permissions.",
            ) from error
        except ValueError as error:
            raise damaged("it is empty") from error
        try:
            return cls(data, path, trusted=trusted, allow_unsigned=allow_unsigned, revoked=revoked)
        except BaseException:
            data.close()
            raise

    def close(self) -> None:
        """Release the mapping, at the latest when the last error that it caused is gone. Harmless when called twice."""
        with contextlib.suppress(BufferError):
            self._data.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def verify(self) -> None:
        """Check the SHA-256 of every band and thumbnail, and that nothing but zeros lies between them.

        Raises BundleError("bundle-damaged") at the first that is wrong.
        """
        position = fmt.HEADER_BYTES
        for blob in sorted(self._blobs(), key=lambda blob: blob.offset):
            if hashlib.sha256(self._view(blob)).digest() != blob.sha256:
                raise damaged(f"the bytes from {blob.offset} do not match their hash")
            self._check_gap(position, blob.offset)
            position = max(position, blob.offset + blob.length)
        self._check_gap(position, self._data_end)

    def write_signed(self, file: BinaryIO, key: SigningKey) -> None:
        """Write this bundle with the signature of ``key`` in the place of its own; what is mapped here is copied."""
        end = len(self._data) - BLOCK_BYTES
        file.write(memoryview(self._data)[:end])
        file.write(sign(self._data[: fmt.HEADER_BYTES], self._data[self._data_end : end], key))

    def _check_gap(self, start: int, end: int) -> None:
        if end - start >= fmt.FIRST_BLOB or self._data[start:end].strip(b"\0"):
            raise damaged(f"there are bytes between its parts, at {start}")

    def _blobs(self) -> list[fmt.Blob]:
        blobs_of_all = []
        for appearance in self.index.appearances:
            blobs_of_all += [blob for blobs in appearance.bands.values() for blob in blobs]
            blobs_of_all += [appearance.thumbnail] if appearance.thumbnail else []
        if self.index.live is not None:
            blobs_of_all += [array.blob for array in self.index.live.arrays.values()]
        return blobs_of_all

    def _view(self, blob: fmt.Blob) -> memoryview:
        return memoryview(self._data)[blob.offset : blob.offset + blob.length]

    def thumbnail(self, appearance: str) -> bytes | None:
        """The PNG file of an appearance, or None. Raises BundleError as ``decode``."""
        blob = self.index.appearance(appearance).thumbnail
        if blob is None:
            return None
        data = bytes(self._view(blob))
        if hashlib.sha256(data).digest() != blob.sha256 or not fmt.is_png(data):
            raise damaged(f"the thumbnail of {appearance!r} does not match its hash")
        return data

    def live_array(self, name: str) -> npt.NDArray[Any]:
        """An array of the live section, as it was written.

        Raises BundleError("bundle-not-live") where the bundle has none of that name, and ("bundle-damaged").
        """
        array = None if self.index.live is None else self.index.live.arrays.get(name)
        if array is None:
            raise BundleError(
                "bundle-not-live",
                what=f"The bundle contains no {name!r} for the live mode.",
                remedy="Build it again on the stage with 'velatura bundle build --live'.",
            )
        values = np.empty(array.shape, f"<{array.dtype}")
        view = self._view(array.blob)
        if xxhash.xxh3_64_intdigest(view) != array.blob.xxh3:
            raise damaged(f"the bytes at {array.blob.offset} do not match their checksum")
        self._inflater.into(view, values, array.blob.offset)
        if values.dtype.kind == "u":
            np.add.accumulate(values, axis=0, dtype=values.dtype, out=values)
        return values

    def decode(self, appearance: str, output: str) -> npt.NDArray[np.uint8]:
        """One output's image of an appearance, (rows, columns, 3) uint8.

        Raises BundleError("bundle-no-appearance", "bundle-no-output" or "bundle-damaged").
        """
        layout = self.index.output(output)
        image = np.empty((layout.height_px, layout.width_px, 3), np.uint8)
        self.decode_into(appearance, {output: image})
        return image

    def decode_into(
        self,
        appearance: str,
        buffers: Mapping[str, npt.NDArray[np.uint8]],
        pool: Executor | None = None,
        known: Mapping[str, Content] | None = None,
    ) -> dict[str, Content]:
        """Decode into ``buffers``, output name -> C-contiguous (rows, columns, 3) uint8, on the threads of ``pool``.

        Returns what each buffer holds then. ``known``: what this returned for the buffers' present pixels; tiles that
        are there already stay. Checks the quick checksum of every band that it reads. Raises as ``decode``; the
        buffers' content is then undefined. ValueError if a buffer does not have its output's shape.
        """
        bundled = self.index.appearance(appearance)
        codec = self.index.codec if self.version >= fmt.TILED_FROM else None
        images = {}
        for name, buffer in buffers.items():
            layout = self.index.output(name)
            if buffer.shape != (layout.height_px, layout.width_px, 3) or buffer.dtype != np.uint8:
                raise ValueError(f"the buffer for {name} has shape {buffer.shape} and dtype {buffer.dtype}")
            bands = [(blob, self._view(blob)) for blob in bundled.bands[name]]
            content = None if known is None else known[name]
            images[name] = TiledImage(bands, layout, codec, buffer, content, self._inflater)
        tasks = [task for image in images.values() for task in image.tasks()]
        if pool is None:
            for task in tasks:
                task()
        else:
            for future in [pool.submit(task) for task in tasks]:
                future.result()
        return {name: image.content for name, image in images.items()}
