"""The light transport as plain sparse matrices, which `scipy.sparse.load_npz` reads."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from controller.core.arrays import FloatImage, save_arrays
from controller.core.errors import UsageError
from controller.core.storage import stream_atomically, write_atomically
from controller.optics.transport import LightTransport
from controller.optics.transport.planes import CameraBox
from controller.stage.artefacts.names import safe_name
from controller.stage.exchange.content import Content

MOST_ENTRIES: Final = 2**30
"""Of one matrix: about 8 GiB in memory."""
AT_ONCE: Final = 2**17
"""Projector pixels whose entries are calculated together."""
CHANNELS: Final = (0, 1, 2)


def write_transport(content: Content, folder: Path) -> dict[str, int]:
    """Write one matrix for each projector (PROJECTOR.npz), black.npz and transport.json.

    Rows are (channel, row, column) of the crop, columns (channel, row, column) of the projector's picture; both count
    the last index first. A picture of the crop is black + the sum of matrix @ light.

    Raises UsageError("crop-outside", "transport-too-large"), WorkError("no-space", "cannot-write").
    """
    transport = content.transport()
    box = checked_crop(content.crop, transport.camera_shape)
    matrices = ((name, projector_matrix(transport, n, box)) for n, name in enumerate(content.names))
    sizes, black = transport.sizes, content.black()[box.window]
    return {"entries": write_matrices(folder, matrices, sizes, black, transport.camera_shape, box)}


def write_matrices(
    folder: Path,
    matrices: Iterable[tuple[str, sp.csr_array[np.float32]]],
    sizes: Sequence[tuple[int, int]],
    black: FloatImage,
    camera: tuple[int, int],
    box: CameraBox,
) -> int:
    """The files of ``write_transport``: each projector's name and matrix, and its (rows, columns); the entries of all.

    ``black``: of the crop ``box`` of the camera's picture of ``camera`` (rows, columns)
    """
    projectors, entries = [], 0
    for (name, matrix), (rows, columns) in zip(matrices, sizes, strict=True):
        entries += matrix.nnz
        file_name = f"{safe_name(name)}.npz"
        stream_atomically(folder / file_name, lambda file, whole=matrix: sp.save_npz(file, whole, compressed=False))  # type: ignore[misc]
        projectors.append({"name": name, "file": file_name, "projector_px": [columns, rows]})
    save_arrays(folder / "black.npz", {"black": black})
    described = {
        "camera_px": [camera[1], camera[0]],
        "crop": {"x": box.left, "y": box.top, "width": box.right - box.left, "height": box.bottom - box.top},
        "projectors": projectors,
        "rows": "channel, row, column of the crop",
        "columns": "channel, row, column of the projector's picture",
        "black": "black.npz, array black: (rows, columns, channel) of the crop",
        "light": "linear; a projector's channel at full light is 1; the camera in full scales per second",
    }
    write_atomically(folder / "transport.json", (json.dumps(described, indent=1) + "\n").encode())
    return entries


def checked_crop(crop: CameraBox | None, camera_shape: tuple[int, int]) -> CameraBox:
    """``crop``, or all of the camera's picture of (rows, columns). Raises UsageError("crop-outside")."""
    rows, columns = camera_shape
    box = CameraBox(0, 0, rows, columns) if crop is None else crop
    if not (0 <= box.top < box.bottom <= rows and 0 <= box.left < box.right <= columns):
        raise UsageError(
            "crop-outside",
            what=f"The crop reaches beyond the camera's picture of {columns} x {rows} pixels, or it is empty.",
            remedy="Give --crop X,Y,WIDTH,HEIGHT inside the picture.",
        )
    return box


def projector_matrix(transport: LightTransport, n: int, box: CameraBox) -> sp.csr_array[np.float32]:
    """T_n on the crop, (3 pixels of the crop, 3 pixels of the projector) float32.

    Raises UsageError("transport-too-large") above ``MOST_ENTRIES``.
    """
    span = transport.span(n)
    pixels = span.stop - span.start
    height, width = box.bottom - box.top, box.right - box.left
    blocks, entries = [], 0
    for some in _parts(span):
        part = transport.submatrix(box, some, CHANNELS).astype(np.float32)
        part.eliminate_zeros()
        entries += part.nnz
        if entries > MOST_ENTRIES:
            raise UsageError(
                "transport-too-large",
                what=f"The matrix of projector {n + 1} has more than {MOST_ENTRIES} entries.",
                remedy="Export a part of the camera's picture: --crop X,Y,WIDTH,HEIGHT.",
            )
        found = part.tocoo()
        channel, at = np.divmod(found.col, some.size)
        column = channel.astype(np.int64) * pixels + (some[0] - span.start) + at
        blocks.append((found.row, column, found.data))
    row, column, data = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    return sp.csr_array((data, (row, column)), shape=(3 * height * width, 3 * pixels))


def _parts(span: slice) -> Iterator[npt.NDArray[np.int64]]:
    for start in range(span.start, span.stop, AT_ONCE):
        yield np.arange(start, min(start + AT_ONCE, span.stop), dtype=np.int64)
