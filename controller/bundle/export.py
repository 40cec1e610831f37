"""A bundle's frames as PNG pictures, for other programs and for looking at."""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from controller.bundle.describe import describe
from controller.bundle.reader import Bundle
from controller.core.errors import BundleError, UsageError
from controller.core.storage import sync_folder, write_atomically

INDEX: Final = "index.json"


def export_pictures(bundle: Bundle, folder: Path, advance: Callable[[float], None] = lambda done: None) -> int:
    """Check the bundle in full and write its pictures into ``folder``; return how many.

    ``frames/APPEARANCE/OUTPUT.png`` are the frames, byte for byte as a projector gets them;
    ``thumbnails/APPEARANCE.png`` the thumbnails. ``index.json`` is what ``describe`` says, with the path and the
    SHA-256 of each file. The folder appears once all is written.
    ``advance`` gets the share that is done before each appearance, and may raise to stop the work.

    Raises UsageError("folder-not-empty"), BundleError("bundle-damaged"), WorkError("no-space").
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(
            "folder-not-empty",
            what=f"{folder} already exists and is not empty.",
            remedy="Give an empty or new folder; nothing was overwritten.",
        )
    bundle.verify()
    folder = folder.resolve()
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as unfinished:
        made = Path(unfinished) / folder.name
        made.mkdir()
        count = _export(bundle, made, advance)
        made.replace(folder)
    sync_folder(folder.parent)
    return count


def _export(bundle: Bundle, folder: Path, advance: Callable[[float], None]) -> int:
    found = describe(bundle)
    for number, appearance in enumerate(found["appearances"]):
        advance(number / len(found["appearances"]))
        appearance.update(_export_appearance(bundle, appearance["name"], folder))
    write_atomically(folder / INDEX, json.dumps(found, indent=1, ensure_ascii=False).encode())
    return sum(len(appearance["frames"]) for appearance in found["appearances"])


def _export_appearance(bundle: Bundle, name: str, folder: Path) -> dict[str, Any]:
    frames = {
        output.name: _write(folder, f"frames/{name}/{output.name}.png", png(bundle.decode(name, output.name)))
        for output in bundle.index.outputs
    }
    data = bundle.thumbnail(name)
    return {"frames": frames, "thumbnail": None if data is None else _write(folder, f"thumbnails/{name}.png", data)}


def _write(folder: Path, path: str, data: bytes) -> dict[str, str]:
    # Names of a bundle hold no separator and begin with no dot (format.valid_name), so the path stays in the folder.
    write_atomically(folder / path, data)
    return {"file": path, "sha256": hashlib.sha256(data).hexdigest()}


def png(image: npt.NDArray[np.uint8]) -> bytes:
    """A PNG file of an (rows, columns, 3) uint8 RGB image, lossless. Raises BundleError("picture-not-encodable")."""
    done, data = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))
    if not done:
        raise BundleError(
            "picture-not-encodable",
            what=f"A frame of {image.shape[1]}x{image.shape[0]} pixels could not be written as PNG.",
            remedy="Read the bundle with the program in docs/reference/bundle-format.md instead.",
        )
    return data.tobytes()
