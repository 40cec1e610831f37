"""What projectors of text protocols do with the bytes on their serial line: Epson, BenQ, Christie, Panasonic.

Each is written from the makers' command lists (docs/reference/projectors.md) and shares no parser with the driver,
so that a common mistake would show. Bytes in, bytes out; the lamp is the only state they act on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from plugins.emulated.projectors.families.line_buffer import LineBuffer
from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase


@dataclass(frozen=True, slots=True)
class EpsonQuirks:
    """``deaf_while_warming``: nothing is answered until the lamp burns."""

    deaf_while_warming: bool = False


class EpsonBoard:
    """ESC/VP21. The prompt after PWR ON comes with the light, unasked; in an error state there is no prompt at all."""

    def __init__(self, lamp: EmulatedLamp, quirks: EpsonQuirks | None = None) -> None:
        self._lamp = lamp
        self._quirks = quirks or EpsonQuirks()
        self._lines = LineBuffer(ord("\r"))
        self._owes_prompt = False
        self._menu = {b"SOURCE": b"30", b"VKEYSTONE": b"128", b"LUMINANCE": b"00"}

    def feed(self, data: bytes, *, busy: bool = False) -> list[bytes]:
        answers = [self._answer(line, busy) for line in self._lines.feed(data)]
        return [answer for answer in answers if answer]

    def notices(self) -> list[bytes]:
        if self._owes_prompt and self._lamp.phase is LampPhase.LIT:
            self._owes_prompt = False
            return [b":"]
        return []

    def _answer(self, line: bytes, busy: bool) -> bytes:
        if self._quirks.deaf_while_warming and self._lamp.phase is LampPhase.WARMING:
            return b""
        prompt = b"" if self._lamp.faulty else b":"
        reply = b"ERR" if busy else self._act(line.strip(b"\n "))
        return b"" if reply is None else (reply + b"\r" if reply else b"") + prompt

    def _act(self, line: bytes) -> bytes | None:
        """The reply before the prompt: b"" nothing, None: the prompt comes later."""
        burning = self._lamp.burning
        if line in (b"PWR ON", b"PWR OFF"):
            return self._switch(line == b"PWR ON")
        if line in (b"MUTE ON", b"MUTE OFF") and burning:
            self._lamp.shutter_closed = line == b"MUTE ON"
            return b""
        reply = {b"PWR?": b"PWR=" + self._power(), b"SNO?": b"SNO=VE0000001", b"": b""}
        if burning:
            reply[b"LAMP?"] = b"LAMP=%d" % self._lamp.hours
            reply |= {key + b"?": key + b"=" + value for key, value in self._menu.items()}
            key, _, value = line.partition(b" ")
            if key in self._menu and value.isalnum():
                self._menu[key] = value
                return b""
        return reply.get(line, b"ERR")

    def _switch(self, on: bool) -> bytes | None:
        if not on:
            self._lamp.extinguish()
            return b""
        if not self._lamp.strike():
            return b"ERR"
        self._owes_prompt = self._lamp.phase is LampPhase.WARMING
        return None if self._owes_prompt else b""

    def _power(self) -> bytes:
        if self._lamp.faulty:
            return b"05"
        codes = {LampPhase.STANDBY: b"00", LampPhase.LIT: b"01", LampPhase.WARMING: b"02", LampPhase.COOLING: b"03"}
        return codes[self._lamp.phase]


@dataclass(frozen=True, slots=True)
class BenqQuirks:
    """By model: the prompt, which answers an empty line; how many times a command comes back, an answer glued to its
    echo in standby (W700), hours with spaces and without # (W1100), answers that lose their * in standby (W1110);
    whether source, lamp mode and keystone can be read and set."""

    prompt: bool = True
    echoes: int = 1
    glued_in_standby: bool = False
    bare_hours: bool = False
    starless_in_standby: bool = False
    menus: bool = True


class BenqBoard:
    """``<CR>*key=value#<CR>``."""

    def __init__(self, lamp: EmulatedLamp, quirks: BenqQuirks | None = None) -> None:
        self._lamp = lamp
        self._quirks = quirks or BenqQuirks()
        self._lines = LineBuffer(ord("\r"), ord("*"))
        self._menu = {b"sour": b"HDMI", b"lampm": b"LNOR", b"vkeystone": b"0"} if self._quirks.menus else {}

    def feed(self, data: bytes, *, busy: bool = False) -> list[bytes]:
        answers, prompt = [], b""
        for line in self._lines.feed(data):
            if line.strip():
                answers.append(prompt + self._reply(line, busy))
                prompt = b""
            elif self._quirks.prompt:
                prompt += b">"
        return [*answers, prompt] if prompt else answers

    def notices(self) -> list[bytes]:
        return []

    def _reply(self, line: bytes, busy: bool) -> bytes:
        quirks, standby = self._quirks, not self._lamp.burning
        answer = b"*Block item#" if busy else self._act(line.lower())
        if quirks.starless_in_standby and standby and b"=" in answer:
            answer = answer.removeprefix(b"*")
        echo = (line + b"\r\n") * quirks.echoes or b"\r\n"
        if quirks.glued_in_standby and standby:
            echo = line
        return echo + answer + b"\r\n"

    def _act(self, line: bytes) -> bytes:
        key, equals, value = line.removeprefix(b"*").removesuffix(b"#").partition(b"=")
        if not (line.startswith(b"*") and line.endswith(b"#") and equals):
            return b"*Illegal format#"
        if key == b"pow" and value in (b"on", b"off"):
            return self._switch(value == b"on")
        standby = not self._lamp.burning
        if value == b"?" and key in (b"pow", b"ltim"):
            hours = b"*LTIM= %d" if self._quirks.bare_hours else b"*LTIM=%d#"
            return hours % self._lamp.hours if key == b"ltim" else b"*POW=OFF#" if standby else b"*POW=ON#"
        if key not in (known := (b"blank", b"modelname", *self._menu)) or standby:
            return b"*Block item#" if key in known else b"*Unsupported item#"
        return self._lit(key, value)

    def _lit(self, key: bytes, value: bytes) -> bytes:
        """What is answered only while the lamp burns."""
        if key in self._menu:
            self._menu[key] = self._menu[key] if value == b"?" else value.upper()
            return b"*%s=%s#" % (key.upper(), self._menu[key])
        if key == b"modelname":
            return b"*MODELNAME=W1110#"
        self._lamp.shutter_closed = value == b"on"
        return b"*BLANK=%s#" % value.upper()

    def _switch(self, on: bool) -> bytes:
        if on and not self._lamp.strike():
            return b"*Block item#"
        if not on:
            self._lamp.extinguish()
        return b"*POW=ON#" if on else b"*POW=OFF#"


class ChristieBoard:
    """Messages in parentheses; a command is acknowledged only if # asks for it. Status lines come unasked.

    ``lamps`` False: a model with lasers, which has no lamp hours and tells none.
    """

    _FYI: Final = b'(65535 00000 FYI00000 "(SST+LAMP?001) Lamp Hours = %d:00 (h:m)")'
    _ERROR: Final = b'(65535 00000 ERR00000 "System Error: (SST+LAMP?002) Lamp = Failed to strike")'
    _WORDS: Final = {
        LampPhase.STANDBY: b'000 "Standby"',
        LampPhase.LIT: b'001 "On"',
        LampPhase.COOLING: b'010 "Cooling Down"',
        LampPhase.WARMING: b'011 "Warming Up"',
    }

    def __init__(self, lamp: EmulatedLamp, *, lamps: bool = True) -> None:
        self._lamp = lamp
        self._lamps = lamps
        self._lines = LineBuffer(ord(")"), ord("("))
        self._phase = lamp.phase
        self._reported_faulty = False

    def feed(self, data: bytes, *, busy: bool = False) -> list[bytes]:
        lines = [line for line in self._lines.feed(data) if line.startswith(b"(")]
        return [answer for answer in (self._reply(line[1:], busy) for line in lines) if answer]

    def notices(self) -> list[bytes]:
        due = []
        if self._lamp.phase is not self._phase:
            self._phase = self._lamp.phase
            due += [self._FYI % self._lamp.hours] if self._lamps else []
        faulty = self._lamp.faulty
        if faulty and not self._reported_faulty:
            due.append(self._ERROR)
        self._reported_faulty = faulty
        return due

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


class PanasonicBoard:
    """STX command ETX, for one projector with one lamp."""

    def __init__(self, lamp: EmulatedLamp) -> None:
        self._lamp = lamp
        self._lines = LineBuffer(0x03, 0x02)

    def feed(self, data: bytes, *, busy: bool = False) -> list[bytes]:
        lines = [line for line in self._lines.feed(data) if line.startswith(b"\x02")]
        return [b"\x02" + (b"ER401" if busy else self._act(line[1:])) + b"\x03" for line in lines]

    def notices(self) -> list[bytes]:
        return []

    def _act(self, line: bytes) -> bytes:
        codes = {LampPhase.STANDBY: b"0", LampPhase.WARMING: b"1", LampPhase.LIT: b"2", LampPhase.COOLING: b"3"}
        reply = {b"Q$S": codes[self._lamp.phase], b"Q$L": b"%04d" % self._lamp.hours}
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
