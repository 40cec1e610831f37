"""The demo's stage: written once, used again by a demo that goes on."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from controller.bundle.signing import generate_key
from controller.config import write_stage
from controller.errors import UsageError
from controller.services import KEY_FILE
from controller.solve.targets import linear_to_srgb, shipped_photograph
from controller.storage import sha256_of, write_atomically
from hal.deadline import in_seconds
from hal.interfaces import Bench
from hal.registry import Drivers, OpenContext, load_drivers

MARK = "demo.json"
PHOTOGRAPH = "photograph.png"

APPEARANCES: tuple[dict[str, Any], ...] = (
    {"name": "photograph", "kind": "photograph", "file": PHOTOGRAPH},
    {"name": "new-pattern", "kind": "pattern"},
    {"name": "checkerboard", "kind": "checkerboard"},
    {"name": "gloss", "kind": "gloss"},
)


def bench_of(stage: Path, drivers: Drivers | None = None) -> Bench:
    """The bench that this installation has. Raises PluginError("driver-unknown") where there is none."""
    driver = (drivers or load_drivers()).get("bench", "emulated")
    bench: Bench = driver.open({}, OpenContext(stage=stage), in_seconds(10))
    return bench


def prepare(out: Path, *, size: str, object_file: Path | None, seed: int) -> Path:
    """The stage folder ``out/stage`` for these wishes: made now, or found as an earlier demo left it.

    Raises UsageError("demo-folder-taken") if ``out`` holds a stage of other wishes, and what the bench refuses (a mesh
    without faces, an unknown size) before anything is written.
    """
    stage = out / "stage"
    wishes = {"size": size, "seed": seed, "object": _object_digest(object_file)}
    mark = stage / MARK
    if mark.exists():
        if json.loads(mark.read_text()) != wishes:
            raise UsageError(
                "demo-folder-taken",
                what=f"{out} holds a demo of another size, object or seed.",
                remedy="Choose another folder with --out, or remove this one.",
            )
        return stage
    if stage.exists() and any(stage.iterdir()):
        raise UsageError(
            "demo-folder-taken",
            what=f"{stage} is not empty and was not made by the demo.",
            remedy="Choose another folder with --out.",
        )
    tables = _write(stage, size=size, object_file=object_file, seed=seed)
    write_stage(stage / "stage.toml", tables)
    write_atomically(mark, json.dumps(wishes).encode())
    return stage


def _write(stage: Path, *, size: str, object_file: Path | None, seed: int) -> Mapping[str, Any]:
    devices = bench_of(stage).prepare(stage, size=size, object_file=object_file, seed=seed)
    stage.mkdir(parents=True, exist_ok=True)
    _write_photograph(stage / PHOTOGRAPH)
    public = generate_key(stage / KEY_FILE)
    return {
        "stage": {"name": f"demo {size}"},
        **devices,
        "bundle": {"trusted_keys": [public.hex()]},
        "appearances": list(APPEARANCES),
    }


def _write_photograph(path: Path) -> None:
    encoded = np.rint(255 * linear_to_srgb(shipped_photograph("astronaut"))).astype(np.uint8)
    ok, data = cv2.imencode(".png", encoded[..., ::-1])
    assert ok
    write_atomically(path, data.tobytes())


def _object_digest(object_file: Path | None) -> str:
    if object_file is None:
        return ""
    if not object_file.is_file():
        raise UsageError(
            "object-missing",
            what=f"There is no file {object_file}.",
            remedy="Give OBJECT the path of a mesh, .obj or .ply.",
        )
    return sha256_of(object_file)
