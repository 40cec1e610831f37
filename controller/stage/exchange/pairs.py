"""Folders of pairs, as learned methods' data sets have them: pictures that were projected, and photographs of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import scipy.sparse as sp

from controller.core.arrays import FloatImage
from controller.core.colour import Unsuitable
from controller.core.errors import UsageError
from controller.optics.capture import linear_files, raw
from controller.optics.transport.pairs import PairFit, fit_pairs
from controller.optics.transport.planes import CameraBox
from controller.stage.exchange.sparse import checked_crop, write_matrices

PROJECTED, PHOTOGRAPHS = "projected", "photographs"
EXPONENT: Final = 2.2


@dataclass(frozen=True, slots=True)
class Pairs:
    """N pairs: ``projected`` one (N, rows, columns, 3) float32 a projector of ``names``, linear light 0 to 1;
    ``photographs`` (N, camera rows, columns, 3) float32 linear light."""

    names: tuple[str, ...]
    projected: tuple[FloatImage, ...]
    photographs: FloatImage


def read_pairs(folder: Path | str, *, exponent: float = EXPONENT) -> Pairs:
    """Read ``projected/`` and ``photographs/``: files of one name, without its end, belong together.

    Parameters
    ----------
    folder : with several projectors ``projected`` has a folder for each; PNG, TIFF, EXR and RAW files
    exponent : projected light is the device value, 0 to 1, to this power. Photographs are linear as they are

    Errors: ``pairs-wrong``.
    """
    folder = Path(folder)
    parts = sorted(path for path in (folder / PROJECTED).glob("*") if path.is_dir()) or [folder / PROJECTED]
    names = sorted(path.stem for path in (folder / PHOTOGRAPHS).glob("*") if path.is_file())
    if not names:
        raise _wrong(folder, f"it has no pictures in {PHOTOGRAPHS}")
    shown = [_pictures(part, names) ** np.float32(exponent) for part in parts]
    return Pairs(tuple(part.name for part in parts), tuple(shown), _pictures(folder / PHOTOGRAPHS, names))


def fitted(projected: Sequence[FloatImage], photographs: FloatImage) -> PairFit:
    """``fit_pairs`` for photographs (N, rows, columns, 3); of a pixel that is saturated in any, nothing is known."""
    light = photographs.reshape(len(photographs), -1, 3)
    measured = np.asarray(np.isfinite(light).all(axis=(0, 2)))
    return fit_pairs(projected, np.where(measured[:, None], light, np.float32(0)))


def is_pairs(folder: Path) -> bool:
    """Whether this is a folder for ``read_pairs``."""
    return (folder / PROJECTED).is_dir() and (folder / PHOTOGRAPHS).is_dir()


def write_pairs_transport(folder: Path, out: Path, crop: CameraBox | None) -> dict[str, Any]:
    """As ``write_transport``, from a folder of pairs; with the figures of the fit. Raises as both."""
    pairs = read_pairs(folder)
    box = checked_crop(crop, pairs.photographs.shape[1:3])
    seen = pairs.photographs[:, *box.window]
    fit = fitted(pairs.projected, seen)
    matrices = {}
    for name, shares, white, mixing in zip(pairs.names, fit.shares, fit.whites, fit.mixing, strict=True):
        gains: Any = white[:, :, None] * mixing
        rows: Any = [[shares.multiply(gains[:, c, k, None]) for k in range(3)] for c in range(3)]
        matrices[name] = sp.csr_array(sp.block_array(rows, format="csr", dtype=np.float32))
    sizes = [one.shape[1:3] for one in pairs.projected]
    camera = pairs.photographs.shape[1:3]
    entries = write_matrices(out, matrices.items(), sizes, fit.black.reshape(*seen.shape[1:]), camera, box)
    return {"entries": entries, "error": f"{100 * fit.error:.1f} % in pairs that were left out"}


def _pictures(folder: Path, names: list[str]) -> FloatImage:
    files = {path.stem: path for path in sorted(folder.glob("*")) if path.is_file()}
    if missing := next((name for name in names if name not in files), None):
        raise _wrong(folder, f"it has no picture {missing}")
    first = _picture(files[names[0]])
    pictures = np.empty((len(names), *first.shape), np.float32)
    for picture, name in zip(pictures, names, strict=True):
        image = _picture(files[name])
        if image.shape != first.shape:
            raise _wrong(folder, f"{files[name].name} has another size than {files[names[0]].name}")
        picture[:] = image
    return pictures


def _picture(path: Path) -> FloatImage:
    if path.suffix.lower() not in (*linear_files.SUFFIXES, ".png"):
        return raw.read_photograph(path).measured()
    try:
        return linear_files.read_linear(path, bits=(8, 16))[0]
    except Unsuitable as error:
        raise _wrong(path.parent, f"{path.name} can't be read, {error}") from error


def _wrong(folder: Path, why: str) -> UsageError:
    return UsageError(
        "pairs-wrong",
        what=f"The pairs in {folder} can't be used: {why}.",
        remedy=f"Give each photograph in {PHOTOGRAPHS} a picture of the same name in {PROJECTED}.",
    )
