"""Array types, and the container for arrays on disk.

The container is NumPy's published ``.npz`` format (a zip of ``.npy`` members), never with pickled objects. Members are
not packed and begin at multiples of 64 bytes, so that a large file can be used where it is (docs/decisions/0004).
"""

from __future__ import annotations

import math
import mmap
import os
import struct
import tempfile
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, BinaryIO, Final, TypeAlias, TypeVar, cast

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy

from controller.core.errors import UsageError
from controller.core.storage import stream_atomically

FloatImage: TypeAlias = npt.NDArray[np.float32]
"""(rows, columns) or (rows, columns, 3), linear light."""
ByteImage: TypeAlias = npt.NDArray[np.uint8]
"""(rows, columns, 3) device values of a projector."""
Mask: TypeAlias = npt.NDArray[np.bool_]
"""(rows, columns)."""
Float64: TypeAlias = npt.NDArray[np.float64]
Array = TypeVar("Array", bound=npt.NDArray[Any])

STRIP_ROWS: Final = 128
"""Of a picture that is worked on in strips, so that what is needed on the way is small."""
ALIGNMENT: Final = 64
MAPPED_FROM: Final = 32 * 1024 * 1024
"""Bytes from which a file is mapped instead of read, and an array worth a file."""
LARGEST_UNPACKED: Final = 1 << 30
"""Bytes of the packed members of a file, which may be a thousand times larger than it."""
_LOCAL: Final = struct.Struct("<26xHH")
"""Of a member's local header: the lengths of its name and of what follows the name."""
_ZIP64_EXTRA: Final = 20
_PADDING: Final = struct.Struct("<HH")
_PADDING_ID: Final = 0xD935
"""The extra field that Android's zipalign uses for the same purpose."""
_BLOCK: Final = 1 << 24
_DAMAGED: Final = (
    OSError, ValueError, KeyError, EOFError, RuntimeError, struct.error, zlib.error, tokenize.TokenError,
    zipfile.BadZipFile, MemoryError,
)  # fmt: skip
"""What the libraries raise for a file that is not what it should be."""


def strips(rows: int, at_once: int = STRIP_ROWS) -> Iterator[slice]:
    """All rows of a picture, some at a time."""
    return (slice(first, min(first + at_once, rows)) for first in range(0, rows, at_once))


def summed(pictures: Sequence[FloatImage]) -> FloatImage:
    """The sum of one picture or more, without a copy of all of them, as ``np.sum(pictures, axis=0)`` makes."""
    whole = pictures[0].copy()
    for picture in pictures[1:]:
        whole += picture
    return whole


def save_arrays(path: Path, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Write named arrays atomically; the same arrays give the same bytes."""
    stream_atomically(path, lambda file: _write(file, arrays))


def _write(file: BinaryIO, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
        for name, values in arrays.items():
            member = zipfile.ZipInfo(f"{name}.npy")
            begins = file.tell() + _LOCAL.size + len(member.filename.encode()) + _ZIP64_EXTRA
            padding = -(begins + _PADDING.size) % ALIGNMENT
            member.extra = _PADDING.pack(_PADDING_ID, padding) + bytes(padding)
            with archive.open(member, "w", force_zip64=True) as to:
                npy.write_array(to, np.asanyarray(values), allow_pickle=False)


def load_arrays(path: Path, *, mapped_from: int = MAPPED_FROM) -> dict[str, npt.NDArray[Any]]:
    """Read a file of ``save_arrays``. Raises UsageError("array-file-unreadable") for any other file.

    Arrays of a file of at least ``mapped_from`` bytes stay in the file, checked, and are read as they are used. They
    may be written to: what changes then is memory of this process alone.
    """
    try:
        _refuse_bomb(path)
        if path.stat().st_size >= mapped_from:
            return _mapped(path)
        with np.load(path, allow_pickle=False) as archive:
            # Use the members' full names: without the suffix, "a" and "a.npy" would both mean the first.
            return {name: archive[f"{name}.npy"] for name in archive.files}
    except _DAMAGED as error:
        raise UsageError(
            "array-file-unreadable",
            what=f"{path} is not a readable array file ({error}).",
            remedy="Delete it and run the command that made it again.",
        ) from error


def _refuse_bomb(path: Path) -> None:
    """Raises ValueError for a file whose packed members would fill the memory: ours are not packed at all."""
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(one.file_size for one in archive.infolist() if one.compress_type != zipfile.ZIP_STORED)
    if unpacked > LARGEST_UNPACKED:
        raise ValueError(f"it holds {unpacked / 1e9:.1f} GB, packed")


def _mapped(path: Path) -> dict[str, npt.NDArray[Any]]:
    with path.open("rb") as file, zipfile.ZipFile(file) as archive:
        whole = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
        return {
            member.filename.removesuffix(".npy"): _member(file, whole, archive, member) for member in archive.infolist()
        }


def _member(file: IO[bytes], whole: mmap.mmap, archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> npt.NDArray[Any]:
    """One array: in the file if it is neither packed nor at an odd place, else read."""
    file.seek(member.header_offset)
    name, extra = _LOCAL.unpack(file.read(_LOCAL.size))
    first = member.header_offset + _LOCAL.size + name + extra
    if member.compress_type == zipfile.ZIP_STORED and first + member.file_size <= len(whole):
        _check(memoryview(whole)[first : first + member.file_size], member)
        file.seek(first)
        read = npy.read_array_header_1_0 if npy.read_magic(file) == (1, 0) else npy.read_array_header_2_0
        shape, columns_first, dtype = read(file)
        at, count = file.tell(), math.prod(shape)
        if count and not (dtype.hasobject or columns_first or at % dtype.itemsize):
            if at - first + count * dtype.itemsize != member.file_size:
                raise ValueError(f"{member.filename} does not have the size of its array")
            return np.frombuffer(whole, dtype, count, at).reshape(shape)
    with archive.open(member) as packed:
        return np.asarray(npy.read_array(packed, allow_pickle=False))


def _check(data: memoryview, member: zipfile.ZipInfo) -> None:
    found = 0
    for begin in range(0, len(data), _BLOCK):
        found = zlib.crc32(data[begin : begin + _BLOCK], found)
    if found != member.CRC:
        raise zipfile.BadZipFile(f"{member.filename} does not match its checksum")


def array_in_file(
    folder: Path | None, shape: tuple[int, ...], dtype: npt.DTypeLike = np.float32, *, from_bytes: int = MAPPED_FROM
) -> npt.NDArray[Any]:
    """An empty array that need not stay in memory: in a nameless file of ``folder``, which ends with it.

    Below ``from_bytes``, without a ``folder``, or where no file can be had, it is in memory.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if folder is not None and size >= max(from_bytes, 1):
        try:
            with tempfile.TemporaryFile(dir=folder) as file:
                os.posix_fallocate(file.fileno(), 0, size)
                return np.frombuffer(mmap.mmap(file.fileno(), size), dtype).reshape(shape)
        except OSError:
            # a full or read-only disk: memory will do, or say that it does not
            pass
    return np.empty(shape, dtype)


def moved_to_file(array: Array, folder: Path | None, *, from_bytes: int = MAPPED_FROM) -> Array:
    """The same numbers, as in ``array_in_file`` where they are many, else ``array`` itself; so without a ``folder``."""
    if folder is None or array.nbytes < from_bytes or _is_mapped(array):
        return array
    moved = array_in_file(folder, array.shape, array.dtype, from_bytes=from_bytes)
    moved[...] = array
    return cast("Array", moved)


def _is_mapped(array: npt.NDArray[Any]) -> bool:
    owner: object = array
    while isinstance(owner, np.ndarray):
        owner = owner.base
    return isinstance(owner, memoryview | mmap.mmap)


def as_light(values: npt.ArrayLike) -> FloatImage:
    """Linear light as contiguous float32; without a copy where it is that already.

    Raises UsageError("image-not-light") for whole numbers above 1, which are those of a file.
    """
    array = np.asarray(values)
    if array.dtype.kind in "iu" and array.size and array.max() > 1:
        raise UsageError(
            "image-not-light",
            what=f"The array has whole numbers up to {array.max()}, and linear light goes from 0 to 1.",
            remedy="Divide by the largest number of the file's type, and set saturated samples to NaN.",
        )
    return np.ascontiguousarray(array, np.float32)
