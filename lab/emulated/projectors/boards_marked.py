"""Control boards whose messages lie between two marks: Barco in braces, Christie in parentheses, Panasonic in STX, ETX.

See ``board``. Sources, beside docs/reference/projectors.md: Barco's "Pulse API: JSON RPC Reference", and the command
lists of Panasonic's PT-DZ870 and PT-RZ34.
"""

from __future__ import annotations

import json
from typing import Any, Final

from plugins.emulated.projectors.board import LineBoard
from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase

_PANASONIC_PHASES: Final = {
    LampPhase.STANDBY: b"0",
    LampPhase.WARMING: b"1",
    LampPhase.LIT: b"2",
    LampPhase.COOLING: b"3",
}


class BarcoPulseBoard:
    """JSON-RPC objects one after the other. Power commands between two states do nothing, and are not refused.

    A change of state is reported unasked; real ones do that to those who subscribed.
    """

    _STATES: Final = {
        LampPhase.STANDBY: "ready",
        LampPhase.WARMING: "conditioning",
        LampPhase.LIT: "on",
        LampPhase.COOLING: "deconditioning",
    }

    def __init__(self, lamp: EmulatedLamp) -> None:
        self._lamp = lamp
        self._received = ""
        self._reported_state = self._state()

    def feed(self, data: bytes, *, busy: bool = False) -> list[bytes]:
        """See ``Board``."""
        self._received += data.decode("utf-8", "replace")
        answers = []
        while (start := self._received.find("{")) >= 0:
            try:
                request, end = json.JSONDecoder().raw_decode(self._received, start)
            except ValueError:
                if len(self._received) > 4096:
                    self._received = self._received[start + 1 :]
                    continue
                break
            self._received = self._received[end:]
            answers.append(self._reply(request, busy))
        return [json.dumps(answer).encode() for answer in answers if answer is not None]

    def notices(self) -> list[bytes]:
        """See ``Board``."""
        state, reported = self._state(), self._reported_state
        self._reported_state = state
        if state == reported:
            return []
        changed = {"property": [{"system.state": state}]}
        return [json.dumps({"jsonrpc": "2.0", "method": "property.changed", "params": changed}).encode()]

    def _state(self) -> str:
        return "error" if self._lamp.faulty else self._STATES[self._lamp.phase]

    def _reply(self, request: Any, busy: bool) -> dict[str, Any] | None:
        if not isinstance(request, dict) or "id" not in request:
            return None
        params = request.get("params", {})
        error = {"code": -32000, "message": "Busy"} if busy else None
        result = None if busy else self._act(str(request.get("method")), params if isinstance(params, dict) else {})
        if isinstance(result, dict):
            error, result = result, None
        body = {"result": result} if error is None else {"error": error}
        return {"jsonrpc": "2.0", "id": request["id"], **body}

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
            "system.state": self._state(),
            "system.modelname": "UDX-4K32",
            "system.firmwareversion": "2.5.2",
            "statistics.laserruntime.value": lamp.hours * 3600,
            "optics.shutter.position": "Closed" if lamp.shutter_closed else "Open",
        }
        if method == "property.get" and params.get("property") in replies:
            return replies[str(params["property"])]
        return {"code": -32601, "message": f"Property not found: {params.get('property')}"}


class ChristieBoard(LineBoard):
    """Messages in parentheses; a command is acknowledged only if # asks for it. Status lines come unasked.

    ``lamps`` False: a model with lasers, which has no lamp hours and tells none.
    """

    start, end = b"(", b")"
    _FYI: Final = b'(65535 00000 FYI00000 "(SST+LAMP?001) Lamp Hours = %d:00 (h:m)")'
    _ERROR: Final = b'(65535 00000 ERR00000 "System Error: (SST+LAMP?002) Lamp = Failed to strike")'
    _WORDS: Final = {
        LampPhase.STANDBY: b'000 "Standby"',
        LampPhase.LIT: b'001 "On"',
        LampPhase.COOLING: b'010 "Cooling Down"',
        LampPhase.WARMING: b'011 "Warming Up"',
    }

    def __init__(self, lamp: EmulatedLamp, *, lamps: bool = True) -> None:
        super().__init__(lamp)
        self._lamps = lamps
        self._phase = lamp.phase
        self._reported_faulty = False

    def notices(self) -> list[bytes]:
        """See ``Board``."""
        due = []
        if self._lamp.phase is not self._phase:
            self._phase = self._lamp.phase
            due += [self._FYI % self._lamp.hours] if self._lamps else []
        faulty = self._lamp.faulty
        if faulty and not self._reported_faulty:
            due.append(self._ERROR)
        self._reported_faulty = faulty
        return due

    def _answers(self, command: bytes, busy: bool) -> list[bytes]:
        answer = self._reply(command[1:], busy) if command.startswith(b"(") else b""
        return [answer] if answer else []

    def _reply(self, message: bytes, busy: bool) -> bytes:
        wants_echo, bare = message.startswith(b"#"), message.lstrip(b"#$")
        if busy:
            return self._error(b"00007", bare[:3], b"Could not be executed")
        if bare.endswith(b"?"):
            return self._answer(bare[:-1])
        name, _, parameter = bare.partition(b" ")
        if name not in (b"PWR", b"SHU"):
            return self._error(b"00009", name, b"Unknown request")
        if parameter not in (b"0", b"1"):
            return self._error(b"00005", name, b"Too Few Parameters")
        if not self._act(name, parameter == b"1"):
            return self._error(b"00007", name, b"Could not be executed")
        return b"(" + message + b")" if wants_echo else b""

    def _act(self, name: bytes, one: bool) -> bool:
        if name == b"SHU":
            self._lamp.shutter_closed = one
            return True
        if one:
            self._reported_faulty = False
            return self._lamp.strike()
        self._lamp.extinguish()
        return True

    def _answer(self, name: bytes) -> bytes:
        values = {
            b"PWR": self._WORDS[self._lamp.phase],
            b"SHU": b"%d" % self._lamp.shutter_closed,
            b"LPH": b"%04d" % self._lamp.hours,
        }
        if name not in values or (name == b"LPH" and not self._lamps):
            return self._error(b"00009", name, b"Unknown request")
        return b"(" + name + b"!" + values[name] + b")"

    def _error(self, code: bytes, name: bytes, text: bytes) -> bytes:
        return b'(65535 00000 ERR%s "%s: %s")' % (code, name, text)


class PanasonicBoard(LineBoard):
    """STX command ETX, for one projector with one lamp."""

    start, end = b"\x02", b"\x03"

    def _answers(self, command: bytes, busy: bool) -> list[bytes]:
        if not command.startswith(b"\x02"):
            return []
        return [b"\x02" + (b"ER401" if busy else self._act(command[1:])) + b"\x03"]

    def _act(self, line: bytes) -> bytes:
        reply = {b"Q$S": _PANASONIC_PHASES[self._lamp.phase], b"Q$L": b"%04d" % self._lamp.hours}
        if line in reply:
            return reply[line]
        done = False
        if line == b"PON":
            done = self._lamp.strike()
        elif line == b"POF":
            self._lamp.extinguish()
            done = True
        elif line in (b"OSH:0", b"OSH:1") and self._lamp.burning:
            self._lamp.shutter_closed = line == b"OSH:1"
            done = True
        return line if done else b"ER402" if line.startswith(b"OSH:") else b"ER401"


class PanasonicDzBoard(LineBoard):
    """PT-DZ and PT-RZ: ``AD``, its ``number`` on the line, ``;`` and a command; ZZ is for all, and for the LAN port."""

    start, end = b"\x02", b"\x03"

    def __init__(self, lamp: EmulatedLamp, *, number: bytes = b"01") -> None:
        super().__init__(lamp)
        self._number = number
        self._menu = {b"IIS": b"HD1", b"LPM": b"0"}

    def _answers(self, command: bytes, busy: bool) -> list[bytes]:
        head, _, line = command.partition(b";")
        if head not in (b"\x02AD" + self._number, b"\x02ADZZ"):
            return []
        return [b"\x02" + (b"ER401" if busy else self._act(line)) + b"\x03"]

    def _act(self, command: bytes) -> bytes:
        lamp = self._lamp
        replies = {
            b"Q$S": _PANASONIC_PHASES[lamp.phase],
            b"Q$L:1": b"%d" % lamp.hours,
            b"QID": b"DZ870",
            b"QPW": b"001" if lamp.burning else b"000",
            b"QSH": b"%d" % lamp.shutter_closed,
        }
        if lamp.burning:
            replies |= {b"QIN": self._menu[b"IIS"], b"QSL": self._menu[b"LPM"]}
            key, _, value = command.partition(b":")
            if key in self._menu and value:
                self._menu[key] = value
                return command
        if command in replies:
            return replies[command]
        if command == b"POF":
            lamp.extinguish()
            return b"POF"
        if command in (b"OSH:0", b"OSH:1") and lamp.burning:
            lamp.shutter_closed = command == b"OSH:1"
            return command
        if command == b"PON" and lamp.strike():
            return b"PON"
        return b"ER402" if command.startswith(b"OSH") else b"ER401"
