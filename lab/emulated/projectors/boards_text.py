"""Control boards of protocols by lines of text: Acer, BenQ, Digital Projection, Epson, Sanyo, Sony.

See ``board``. Sources, beside docs/reference/projectors.md: the RS232 tables
of Acer's manuals, "Basic Serial Command Functional Specifications" of PLC-XM100 (Sanyo), Digital Projection's protocol
guide 115-482H as others read it, the manuals of E-Vision Laser 5000 and 6500, and Sony's manuals as programs of users
quote them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from plugins.emulated.projectors.board import LineBoard
from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase


class AcerBoard(LineBoard):
    """``* 0`` and a key code or a question; *000 or *001 first, then the answer.

    Warming is reported as lit, cooling as dark; a strike while it cools is refused.
    """

    start = b"*"

    def _answers(self, command: bytes, busy: bool) -> list[bytes]:
        if not command.startswith(b"* 0 "):
            return []
        return [b"*001\r" if busy else self._act(command[4:])]

    def _act(self, command: bytes) -> bytes:
        lamp = self._lamp
        match command:
            case b"IR 001":
                return b"*000\r" if lamp.phase is not LampPhase.COOLING and lamp.strike() else b"*001\r"
            case b"IR 002":
                lamp.extinguish()
                return b"*000\r"
            case b"Lamp ?":
                return b"*000\rLamp %d\r" % lamp.burning
            case b"Lamp":
                return b"*000\r%04d\r" % lamp.hours
        return b"*001\r"


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


class BenqBoard(LineBoard):
    """``<CR>*key=value#<CR>``."""

    start = b"*"

    def __init__(self, lamp: EmulatedLamp, quirks: BenqQuirks | None = None) -> None:
        super().__init__(lamp)
        self._quirks = quirks or BenqQuirks()
        self._menu = {b"sour": b"HDMI", b"lampm": b"LNOR", b"vkeystone": b"0"} if self._quirks.menus else {}
        self._prompt = b""

    def feed(self, data: bytes, *, busy: bool = False) -> list[bytes]:
        """See ``Board``. Prompts go out with the next answer."""
        answers = super().feed(data, busy=busy)
        prompt, self._prompt = self._prompt, b""
        return [*answers, prompt] if prompt else answers

    def _answers(self, command: bytes, busy: bool) -> list[bytes]:
        if not command.strip():
            self._prompt += b">" if self._quirks.prompt else b""
            return []
        prompt, self._prompt = self._prompt, b""
        return [prompt + self._reply(command, busy)]

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
        if key not in (items := (b"blank", b"modelname", *self._menu)) or standby:
            return b"*Block item#" if key in items else b"*Unsupported item#"
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


class DigitalProjectionBoard(LineBoard):
    """``*name = value``, ``*name ?`` or ``*name``; ``ack name = value`` or ``nack name``."""

    start = b"*"
    _STATES: Final = {LampPhase.STANDBY: b"0", LampPhase.WARMING: b"1", LampPhase.LIT: b"2", LampPhase.COOLING: b"3"}

    def _answers(self, command: bytes, busy: bool) -> list[bytes]:
        if not command.startswith(b"*"):
            return []
        name, _, value = command[1:].replace(b"?", b"=?").partition(b"=")
        name, value = name.strip(), value.strip(b"= ")
        done = None if busy else self._act(name, value)
        if done is None:
            return [b"nack " + name + b"\r"]
        return [b"ack " + name + (b" = " + done if done else b"") + b"\r"]

    def _act(self, name: bytes, value: bytes) -> bytes | None:
        lamp = self._lamp
        if value == b"?":
            replies = {
                b"status": b"4" if lamp.faulty else self._STATES[lamp.phase],
                b"laser.hours": b"%d" % lamp.hours,
                b"shutter": b"%d" % lamp.shutter_closed,
            }
            return replies.get(name)
        if name == b"power.on":
            return b"" if lamp.strike() else None
        if name == b"power.off":
            lamp.extinguish()
            return b""
        if name == b"shutter" and value in (b"0", b"1") and lamp.burning:
            lamp.shutter_closed = value == b"1"
            return value
        return None


class DigitalProjectionVBoard(LineBoard):
    """``V``, two digits of the projector's number, S or G, four digits, CR; P or F back. Warming is reported as on."""

    start = b"V"
    _STATES: Final = {LampPhase.STANDBY: b"1", LampPhase.WARMING: b"2", LampPhase.LIT: b"2", LampPhase.COOLING: b"3"}

    def _answers(self, command: bytes, busy: bool) -> list[bytes]:
        if command[1:3] not in (b"00", b"99"):
            return []
        return [(b"F" if busy else self._act(command[3:])) + b"\r"]

    def _act(self, command: bytes) -> bytes:
        match command:
            case b"S0001":
                return b"P" if self._lamp.strike() else b"F"
            case b"S0002":
                self._lamp.extinguish()
                return b"P"
            case b"G0004":
                return b"P%05d" % self._lamp.hours
            case b"G0007":
                return b"P" + self._STATES[self._lamp.phase]
            case b"G0008":
                return b"PMD05"
        return b"F"


@dataclass(frozen=True, slots=True)
class EpsonQuirks:
    """``deaf_while_warming``: nothing is answered until the lamp burns."""

    deaf_while_warming: bool = False


class EpsonBoard(LineBoard):
    """ESC/VP21. The prompt after PWR ON comes with the light, unasked; in an error state there is no prompt at all."""

    def __init__(self, lamp: EmulatedLamp, quirks: EpsonQuirks | None = None) -> None:
        super().__init__(lamp)
        self._quirks = quirks or EpsonQuirks()
        self._owes_prompt = False
        self._menu = {b"SOURCE": b"30", b"VKEYSTONE": b"128", b"LUMINANCE": b"00"}

    def notices(self) -> list[bytes]:
        """See ``Board``."""
        if self._owes_prompt and self._lamp.phase is LampPhase.LIT:
            self._owes_prompt = False
            return [b":"]
        return []

    def _answers(self, command: bytes, busy: bool) -> list[bytes]:
        if self._quirks.deaf_while_warming and self._lamp.phase is LampPhase.WARMING:
            return []
        prompt = b"" if self._lamp.faulty else b":"
        reply = b"ERR" if busy else self._act(command.strip(b"\n "))
        answer = b"" if reply is None else (reply + b"\r" if reply else b"") + prompt
        return [answer] if answer else []

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


class SanyoBoard(LineBoard):
    """The basic serial commands of the PLC series: three characters and CR; ACK or ``?`` back.

    ``lamps``: a model with several tells the hours of each. ``deaf``: it answers 02 to everybody who asks.
    """

    _ACK: Final = b"\x06\r"
    _NO: Final = b"?\r"

    def __init__(self, lamp: EmulatedLamp, *, lamps: int = 1, deaf: bool = False) -> None:
        super().__init__(lamp)
        self._lamps = lamps
        self.deaf = deaf

    def _answers(self, command: bytes, busy: bool) -> list[bytes]:
        # Only the last three characters count: noise before them is passed over.
        return [self._NO if busy else self._act(command[-3:])]

    def _act(self, command: bytes) -> bytes:
        lamp = self._lamp
        match command:
            case b"CR0":
                return self._state() + b"\r"
            case b"CR3":
                return b" ".join([b"%05d" % lamp.hours] * self._lamps) + b"\r"
            case b"C00":
                return self._ACK if lamp.strike() else self._NO
            case b"C01":
                lamp.extinguish()
                return self._ACK
            case b"C0D" | b"C0E" if lamp.phase is LampPhase.LIT:
                lamp.shutter_closed = command == b"C0D"
                return self._ACK
        return self._NO

    def _state(self) -> bytes:
        if self.deaf:
            return b"02"
        phase = self._lamp.phase
        dark = phase in (LampPhase.STANDBY, LampPhase.COOLING)
        if dark and self._lamp.too_hot:
            return b"28" if phase is LampPhase.COOLING else b"88"
        if dark and self._lamp.failed and self._lamp.strikes:
            return b"21" if phase is LampPhase.COOLING else b"81"
        codes = {LampPhase.STANDBY: b"80", LampPhase.WARMING: b"40", LampPhase.LIT: b"00", LampPhase.COOLING: b"20"}
        return codes[phase]


class AdcpBoard(LineBoard):
    """Sony: lines that end in CR LF; values in quotes, answers to questions as JSON."""

    end = b"\n"
    _PHASES: Final = {
        LampPhase.STANDBY: b"standby",
        LampPhase.WARMING: b"startup",
        LampPhase.LIT: b"on",
        LampPhase.COOLING: b"cooling1",
    }

    def __init__(self, lamp: EmulatedLamp) -> None:
        super().__init__(lamp)
        self._menu = {b"input": b'"hdmi1"', b"light_output_mode": b'"high"'}

    def _answers(self, command: bytes, busy: bool) -> list[bytes]:
        line = command.strip()
        return [(b"err_inactive" if busy else self._act(line)) + b"\r\n"] if line else []

    def _act(self, line: bytes) -> bytes:
        lamp = self._lamp
        replies = {
            b"power_status ?": b'"%s"' % self._PHASES[lamp.phase],
            b"timer ?": b'[{"operation":%d},{"light_src":%d},{"prev_light_src":7}]' % (lamp.hours + 9, lamp.hours),
            b"modelname ?": b'"VPL-FHZ75"',
        }
        if line in replies:
            return replies[line]
        key, _, value = line.partition(b" ")
        if key == b"blank" or key in self._menu:
            return self._chosen(key, value)
        if line == b'power "on"':
            return b"ok" if lamp.strike() else b"err_inactive"
        if line == b'power "off"':
            lamp.extinguish()
            return b"ok"
        return b"err_val" if key == b"power" else b"err_cmd"

    def _chosen(self, key: bytes, value: bytes) -> bytes:
        """What a menu tells, or how it is set; ``blank`` also tells while it is dark."""
        lamp, burning = self._lamp, self._lamp.burning
        if value == b"?" and (burning or key == b"blank"):
            return (self._menu | {b"blank": b'"on"' if lamp.shutter_closed else b'"off"'})[key]
        if key == b"blank" and value not in (b'"on"', b'"off"'):
            return b"err_val"
        if not burning:
            return b"err_inactive"
        if key == b"blank":
            lamp.shutter_closed = value == b'"on"'
        else:
            self._menu[key] = value
        return b"ok"
