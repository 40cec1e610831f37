"""The stage of a simulated kiosk on disk, with three tiny appearances in a signed bundle."""

from __future__ import annotations

import contextlib
import itertools
import sqlite3
from collections.abc import Collection
from pathlib import Path
from typing import Final

import numpy as np
from nacl.signing import SigningKey

from controller.bundle.format import PlaylistEntry
from controller.bundle.install import install, revision_floor
from controller.bundle.signing import Trust
from controller.bundle.writer import NewAppearance, NewBundle, write_bundle
from controller.config.writer import toml_text
from controller.kiosk.state import EventRow
from controller.kiosk.store.bundle_store import slots_without
from controller.kiosk.store.event_log import EventLog
from controller.kiosk.values import Schedule

NAMES: Final = ("left", "right", "above")
OUTPUTS: Final = {name: f"P{number}" for number, name in enumerate(NAMES, 1)}
"""The output that each projector is at."""
APPEARANCES: Final = ("glass", "marble", "shine")
RUN: Final = "20260101-030000-calibrate"
_KEY: Final = SigningKey(bytes(range(32)))
TRUST: Final = Trust((bytes(_KEY.verify_key),))
_SIDE_PX: Final = 8


def make_stage(folder: Path, schedule: Schedule, bundles: int) -> None:
    """Write all that a kiosk needs to play; so many bundles are published, one after the other."""
    folder.mkdir()
    (folder / "stage.toml").write_text(_text(schedule), "utf-8")
    for number in range(bundles):
        publish(folder, 1_767_225_600 + number)


def write_log(folder: Path, events: int, ends_unix_s: float) -> list[EventRow]:
    """The log of a kiosk that has already run for a while, one of these events every quarter of an hour."""
    if not events:
        return []
    rows = [
        EventRow(number, ends_unix_s - (events - number) * 900.0, "info", f"The player shows {name}.", "playing")
        for number, name in zip(range(1, events + 1), itertools.cycle(APPEARANCES))
    ]
    path = folder / EventLog.FILE
    EventLog(path, durable=False).close()
    with contextlib.closing(sqlite3.connect(path)) as database, database:
        database.executemany(
            "INSERT INTO events (number, unix_s, level, code, text) VALUES (?, ?, ?, ?, ?)",
            [(row.number, row.unix_s, row.level, row.code, row.text) for row in rows],
        )
    return rows


def publish(folder: Path, created_unix_s: int, missing: Collection[str] = ()) -> Path:
    """Install a new bundle, or the frames without some projectors. Raises as ``bundle.install.install``."""
    slots = slots_without(folder, missing) if missing else folder / "bundles"
    built = folder / "runs" / "built.vel"
    revision = revision_floor(slots, TRUST) + 1
    names = [name for name in NAMES if name not in missing]
    write_bundle(
        built,
        NewBundle(
            stage="Simulated",
            calibration=RUN,
            created_unix_s=created_unix_s,
            revision=revision,
            outputs=[(output, _SIDE_PX, _SIDE_PX) for output in OUTPUTS.values()],
            schedule=[PlaylistEntry(name, 30_000, 1_000) for name in APPEARANCES],
        ),
        key=_KEY,
        appearances=[
            NewAppearance(
                name,
                {
                    output: np.full((_SIDE_PX, _SIDE_PX, 3), shade * 40 if lit in names else 0, np.uint8)
                    for lit, output in OUTPUTS.items()
                },
            )
            for shade, name in enumerate(APPEARANCES, 1)
        ],
    )
    try:
        return install(built, slots, trusted=TRUST.keys)
    finally:
        with contextlib.suppress(OSError):
            built.unlink()


def _text(schedule: Schedule) -> str:
    rows = [{"day": row.day, "opens": row.opens, "closes": row.closes} for row in schedule.rows]
    return toml_text({
        "stage": {"name": "Simulated"},
        "projectors": [
            {"name": name, "output": OUTPUTS[name], "driver": "pjlink", "address": f"192.0.2.{number}"}
            for number, name in enumerate(NAMES, 1)
        ],
        "camera": {"driver": "ptp", "iso": 100, "address": "ptpip:192.0.2.9", "focal_length_px": 4100.0},
        "display": {"driver": "player", "outputs": [
            {"name": output, "width_px": _SIDE_PX, "height_px": _SIDE_PX} for output in OUTPUTS.values()
        ]},
        "bundle": {"trusted_keys": [TRUST.keys[0].hex()]},
        "schedule": {"time_zone": schedule.time_zone, "drift_check": schedule.drift_check, "hours": rows},
        "safety": {"power_up_s": 300.0, "power_down_s": 20.0},
        "alerts": {"webhook": "https://example.org/velatura", "least": "warning"},
        "appearances": [{"name": name, "kind": "pattern"} for name in APPEARANCES],
    })  # fmt: skip
