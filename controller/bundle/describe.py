"""What a bundle holds, and in what two differ: as tables of JSON values, as text for people, and its frames as PNG
pictures.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from controller.bundle.format import BundledAppearance, Index, LiveSection, OutputLayout
from controller.bundle.reader import Bundle
from controller.core.errors import BundleError, UsageError
from controller.core.storage import sync_folder, write_atomically

_LAST_SECOND: Final = 253_402_300_799
"""The end of the year 9999; a bundle may contain a later time, but the calendar does not."""
_HEADS: Final = ("stage", "calibration", "created_unix_s", "revision")


def describe(bundle: Bundle) -> dict[str, Any]:
    """What ``velatura bundle inspect --json`` prints (docs/reference/bundle-format.md, "The commands")."""
    index = bundle.index
    raw = sum(3 * output.width_px * output.height_px for output in index.outputs) * len(index.appearances)
    return {
        "file": str(bundle.path),
        "version": bundle.version,
        "bytes": bundle.size,
        "ratio": raw / bundle.size,
        "identity": bundle.identity,
        "signed_by": None if bundle.signed_by is None else bundle.signed_by.hex(),
        **{key: getattr(index, key) for key in _HEADS},
        "created": _utc(index.created_unix_s),
        "outputs": [_output(output) for output in index.outputs],
        "appearances": [_appearance(appearance) for appearance in index.appearances],
        "schedule": [[hint.appearance, hint.duration_ms, hint.fade_ms] for hint in index.schedule],
        "live": None if index.live is None else _live(index.live),
    }


def _live(live: LiveSection) -> dict[str, Any]:
    return {"target_px": list(live.target_px), "bytes": sum(array.blob.length for array in live.arrays.values())}


def _output(output: OutputLayout) -> dict[str, Any]:
    return {"name": output.name, "width_px": output.width_px, "height_px": output.height_px}


def _appearance(appearance: BundledAppearance) -> dict[str, Any]:
    return {
        "name": appearance.name,
        "bytes": sum(blob.length for blobs in appearance.bands.values() for blob in blobs),
        "thumbnail": appearance.thumbnail is not None,
        "metadata": dict(appearance.metadata),
    }


def _utc(seconds: int) -> str:
    if seconds > _LAST_SECOND:
        return f"{seconds} s after 1970"
    return time.strftime("%Y-%m-%d %H:%M:%SZ", time.gmtime(seconds))


def as_text(found: Mapping[str, Any]) -> str:
    """What ``describe`` returned, in lines. Names of a bundle are printable; its metadata is left out."""
    outputs = ", ".join(f"{output['name']} {output['width_px']}x{output['height_px']}" for output in found["outputs"])
    lines = [
        f"stage        {found['stage']}",
        f"calibration  {found['calibration']}",
        f"revision     {found['revision']}, made {found['created']}",
        f"signed by    {found['signed_by'] or 'not signed; its origin is unknown'}",
        f"size         {found['bytes']} bytes, {found['ratio']:.1f} x smaller than raw",
        f"outputs      {outputs}",
        f"appearances  {len(found['appearances'])}",
    ]
    lines += [f"  {appearance['name']}  {appearance['bytes']} bytes" for appearance in found["appearances"]]
    lines += [
        f"schedule     {name} for {shown / 1000:g} s, fade {fade / 1000:g} s" for name, shown, fade in found["schedule"]
    ]
    if found["live"] is not None:
        width, height = found["live"]["target_px"]
        lines.append(f"live         targets of {width}x{height}, {found['live']['bytes']} bytes")
    return "\n".join(lines)


def differences(one: Bundle, other: Bundle) -> dict[str, Any]:
    """In what ``other`` differs from ``one``; ``same`` is true where nothing does.

    Pictures are compared by the hashes in the index, so no pixel is read.
    """
    changed = {key: [getattr(one.index, key), getattr(other.index, key)] for key in _HEADS}
    changed["signed_by"] = [None if key is None else key.hex() for key in (one.signed_by, other.signed_by)]
    changed["outputs"] = [[_output(output) for output in bundle.index.outputs] for bundle in (one, other)]
    changed["schedule"] = [describe(bundle)["schedule"] for bundle in (one, other)]
    changed["live"] = [_live_hashes(bundle.index) for bundle in (one, other)]
    changed = {key: pair for key, pair in changed.items() if pair[0] != pair[1]}
    appearances = _appearance_differences(one.index, other.index)
    return {"same": not (changed or any(appearances.values())), "changed": changed, "appearances": appearances}


def _live_hashes(index: Index) -> dict[str, str]:
    arrays = {} if index.live is None else index.live.arrays
    return {name: array.blob.sha256.hex()[:16] for name, array in arrays.items()}


def _appearance_differences(one: Index, other: Index) -> dict[str, list[Any]]:
    before = {appearance.name: appearance for appearance in one.appearances}
    after = {appearance.name: appearance for appearance in other.appearances}
    changed = [
        {"name": name, **parts}
        for name in before
        if name in after and any((parts := _parts(before[name], after[name])).values())
    ]
    return {
        "removed": [name for name in before if name not in after],
        "added": [name for name in after if name not in before],
        "changed": changed,
    }


def _parts(before: BundledAppearance, after: BundledAppearance) -> dict[str, Any]:
    outputs = [*before.bands, *(name for name in after.bands if name not in before.bands)]
    thumbnails = [None if one.thumbnail is None else one.thumbnail.sha256 for one in (before, after)]
    return {
        "pictures": [name for name in outputs if _hashes(before, name) != _hashes(after, name)],
        "thumbnail": thumbnails[0] != thumbnails[1],
        "metadata": before.metadata != after.metadata,
    }


def _hashes(appearance: BundledAppearance, output: str) -> list[bytes]:
    return [blob.sha256 for blob in appearance.bands.get(output, ())]


def differences_as_text(found: Mapping[str, Any]) -> str:
    """What ``differences`` returned, in lines: - for what only the first has, + for the second, ~ for both."""
    if found["same"]:
        return "The bundles have the same content."
    lines = []
    for key, (one, other) in found["changed"].items():
        if key in ("schedule", "live"):
            lines.append(f"~ {key}")
            continue
        lines += [f"- {key} {_value(one)}", f"+ {key} {_value(other)}"]
    appearances = found["appearances"]
    lines += [f"- appearance {name}" for name in appearances["removed"]]
    lines += [f"+ appearance {name}" for name in appearances["added"]]
    for one in appearances["changed"]:
        parts = [*one["pictures"], *(part for part in ("thumbnail", "metadata") if one[part])]
        lines.append(f"~ appearance {one['name']}: {', '.join(parts)}")
    return "\n".join(lines)


def _value(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(f"{output['name']} {output['width_px']}x{output['height_px']}" for output in value)
    return "none" if value is None else str(value)


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
