"""Barco Pulse: JSON-RPC objects one after the other.

Written from Barco's 'Pulse API: JSON RPC Reference' (docs/reference/projectors.md); shares no parser with the driver,
so that a common mistake would show.
"""

from __future__ import annotations

import json
from typing import Any, Final

from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase

_STATES: Final = {
    LampPhase.STANDBY: "ready",
    LampPhase.WARMING: "conditioning",
    LampPhase.LIT: "on",
    LampPhase.COOLING: "deconditioning",
}


class BarcoPulseBoard:
    """Power commands between two states do nothing, and are not refused. A change of state is reported unasked.

    ``tells``: whether it tells; real ones do that to those who subscribed.
    """

    def __init__(self, lamp: EmulatedLamp, *, tells: bool = True) -> None:
        self._lamp = lamp
        self._tells = tells
        self._kept = ""
        self._state = self._now()

    def feed(self, data: bytes, *, busy: bool = False) -> list[bytes]:
        self._kept += data.decode("utf-8", "replace")
        answers = []
        while (start := self._kept.find("{")) >= 0:
            try:
                asked, end = json.JSONDecoder().raw_decode(self._kept, start)
            except ValueError:
                if len(self._kept) > 4096:
                    self._kept = self._kept[start + 1 :]
                    continue
                break
            self._kept = self._kept[end:]
            answers.append(self._reply(asked, busy))
        return [json.dumps(answer).encode() for answer in answers if answer is not None]

    def notices(self) -> list[bytes]:
        now, before = self._now(), self._state
        self._state = now
        if now == before or not self._tells:
            return []
        changed = {"property": [{"system.state": now}]}
        return [json.dumps({"jsonrpc": "2.0", "method": "property.changed", "params": changed}).encode()]

    def _now(self) -> str:
        return "error" if self._lamp.faulty else _STATES[self._lamp.phase]

    def _reply(self, asked: Any, busy: bool) -> dict[str, Any] | None:
        if not isinstance(asked, dict) or "id" not in asked:
            return None
        params = asked.get("params", {})
        error = {"code": -32000, "message": "Busy"} if busy else None
        result = None if busy else self._act(str(asked.get("method")), params if isinstance(params, dict) else {})
        if isinstance(result, dict):
            error, result = result, None
        body = {"result": result} if error is None else {"error": error}
        return {"jsonrpc": "2.0", "id": asked["id"], **body}

    def _act(self, method: str, params: dict[str, Any]) -> object:
        lamp = self._lamp
        if method == "system.poweron":
            lamp.strike()
            return None
        if method == "system.poweroff":
            lamp.extinguish()
            return None
        if method == "property.set" and params.get("property") == "optics.shutter.target" and lamp.burning:
            lamp.shutter_closed = params.get("value") == "Closed"
            return True
        replies = {
            "system.state": self._now(),
            "system.modelname": "UDX-4K32",
            "system.firmwareversion": "2.5.2",
            "statistics.laserruntime.value": lamp.hours * 3600,
            "optics.shutter.position": "Closed" if lamp.shutter_closed else "Open",
        }
        if method == "property.get" and params.get("property") in replies:
            return replies[str(params["property"])]
        return {"code": -32601, "message": f"Property not found: {params.get('property')}"}
