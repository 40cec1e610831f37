"""The demo's stage: written once, used again by a continued demo."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from controller.bundle.signing import generate_key
from controller.config import write_stage
from controller.core.errors import UsageError, WorkError
from controller.core.storage import sha256_of, sync_folder, write_atomically
from controller.optics.solve.targets.files import shipped_photograph
from controller.optics.solve.targets.values import linear_to_srgb
from controller.stage.sessions.bench import bench_of
from controller.stage.sessions.calibrations import KEY_FILE
from hal.errors import DeviceError

MARK = "demo.json"
BUILDING = ".stage.part"
PHOTOGRAPH = "photograph.png"
DEFAULT_ROOM = "room"
"""With light that comes back from object, table and wall, as stages have it."""
POWER_DOWN_S = 10.0
"""Emulated lamps go off at once; a dead bench must not delay the end of the demo."""

APPEARANCES: tuple[dict[str, Any], ...] = (
    {"name": "photograph", "kind": "photograph", "file": PHOTOGRAPH},
    {"name": "new-pattern", "kind": "pattern"},
    {"name": "checkerboard", "kind": "checkerboard"},
    {"name": "gloss", "kind": "gloss"},
)


def prepare(out: Path, *, size: str, object_file: Path | None, seed: int, room: str = DEFAULT_ROOM) -> Path:
    """The stage folder ``out/stage`` for these options, created now or by an earlier demo.

    Raises UsageError("demo-folder-taken") if ``out`` holds a stage with other options, and what the bench refuses (a
    mesh without faces, an unknown size or room) before anything is written.
    """
    stage = out / "stage"
    options = {"size": size, "seed": seed, "object": _object_digest(object_file), "room": room}
    if (mark := stage / MARK).exists():
        if _read_mark(mark) != options:
            raise UsageError(
                "demo-folder-taken",
                what=f"{out} contains a demo with another size, object, seed or room.",
                remedy="Choose another folder with --out, or delete this one.",
            )
        return stage
    if stage.is_dir() and any(stage.iterdir()):
        raise UsageError(
            "demo-folder-taken",
            what=f"{stage} is not empty and is not from a demo.",
            remedy="Choose another folder with --out.",
        )
    _build(out, stage, options, object_file)
    return stage


def _build(out: Path, stage: Path, options: Mapping[str, Any], object_file: Path | None) -> None:
    """Write the stage under another name and rename it, so that a stopped demo leaves all of it or nothing."""
    building, there = out / BUILDING, out.exists()
    shutil.rmtree(building, ignore_errors=True)
    try:
        tables = _write(building, options, object_file=object_file)
        write_stage(building / "stage.toml", tables)
        write_atomically(building / MARK, json.dumps(options).encode())
        building.rename(stage)
        sync_folder(out)
    except BaseException:
        shutil.rmtree(building, ignore_errors=True)
        if not there:
            with contextlib.suppress(OSError):
                out.rmdir()
        raise


def _write(stage: Path, options: Mapping[str, Any], *, object_file: Path | None) -> Mapping[str, Any]:
    size = options["size"]
    try:
        bench = bench_of(stage, {"room": options["room"]})
        devices = bench.prepare(stage, size=size, object_file=object_file, seed=options["seed"])
    except DeviceError as error:
        kind = UsageError if error.code.startswith(("size-", "object-", "setting-")) else WorkError
        raise kind(error.code, what=error.what, remedy=error.remedy) from error
    _write_photograph(stage / PHOTOGRAPH)
    public = generate_key(stage / KEY_FILE)
    return {
        "stage": {"name": f"demo {size}"},
        **devices,
        "safety": {"power_down_s": POWER_DOWN_S},
        "bundle": {"trusted_keys": [public.hex()]},
        "appearances": list(APPEARANCES),
    }


def _read_mark(mark: Path) -> object:
    try:
        return {"room": "dark", **json.loads(mark.read_bytes())}  # a demo from before rooms has none
    except (OSError, ValueError, TypeError):
        return None


def _write_photograph(path: Path) -> None:
    encoded = np.rint(255 * linear_to_srgb(shipped_photograph())).astype(np.uint8)
    ok, data = cv2.imencode(".png", encoded[..., ::-1])
    assert ok
    write_atomically(path, data.tobytes())


def _object_digest(object_file: Path | None) -> str:
    if object_file is None:
        return ""
    if not object_file.is_file():
        raise UsageError(
            "object-missing",
            what=f"The file {object_file} does not exist.",
            remedy="Give OBJECT the path of a mesh, .obj or .ply.",
        )
    try:
        return sha256_of(object_file)
    except OSError as error:
        raise UsageError(
            "object-unreadable",
            what=f"{object_file} can't be read: {error.strerror}.",
            remedy="Check the file's permissions.",
        ) from error
