"""The kiosk's state as JSON values: what ``T/state`` says."""

from __future__ import annotations

from typing import Any, Final

from controller.kiosk.interface import DriftCheck, KioskState
from controller.run.state_machine import State

_OPEN: Final = (State.POWERING, State.WARMING, State.READY, State.PLAYING, State.DEGRADED)
_OPEN_NAMES: Final = frozenset(state.value for state in _OPEN)


def published(now: KioskState) -> dict[str, Any]:
    """``open``: whether it shows appearances or its lamps warm up for that. Lamps in tenths of an hour, so that a
    lit lamp alone does not change the state every second.
    """
    return {
        "state": now.state,
        "open": now.state in _OPEN_NAMES,
        "reason": now.reason,
        "since_unix_s": now.since_unix_s,
        "playing": now.playing,
        "in_turn": now.in_turn,
        "paused": now.paused,
        "black": now.black,
        "brightness": now.brightness,
        "identifying": now.identifying,
        "warnings": list(now.warnings),
        "failures": [row.text for row in now.failures],
        "problems": [{"device": row.name, "problem": row.problem} for row in now.devices if row.problem],
        "lamps": {
            lamp.projector: {"lit": lamp.lit, "hours": round(lamp.hours, 1), "strikes": lamp.strikes}
            for lamp in now.lamps
        },
        "dose_klx_h": now.dose_klx_h,
        "drift": _drift(now.drifts[0]) if now.drifts else None,
    }


def _drift(check: DriftCheck) -> dict[str, Any]:
    moved = None if check.moved_px is None else round(check.moved_px, 3)
    return {"unix_s": check.unix_s, "advice": check.advice, "moved_px": moved}
