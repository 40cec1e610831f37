"""The player's socket messages: JSON lines to typed requests (docs/reference/player-protocol.md). No I/O.

``hal.codecs.player`` has the lines of its answers.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

from controller.core.errors import UsageError

MINOR: Final = 6
"""Raised when the protocol gets an addition that older clients can ignore."""
MAX_LINE_BYTES: Final = 256 * 1024
MAX_ITEMS: Final = 4096
MAX_RATE_HZ: Final = 1000.0
MAX_SECONDS: Final = 7 * 24 * 3600.0
MAX_FADE_S: Final = 600.0
MAX_RADIANCE: Final = 1e9
MAX_MOMENT_S: Final = 1e11
THEN: Final = ("on", "black", "still")


@dataclass(frozen=True, slots=True)
class Hello:
    """Who are you, and where is the inbox?"""


@dataclass(frozen=True, slots=True)
class Show:
    """Present the frames in the inbox, which have this (even) sequence number."""

    sequence: int


@dataclass(frozen=True, slots=True)
class Play:
    """Present an appearance of the loaded bundle, ``fade_s`` seconds long over what is shown.

    ``brightness``: the share of its light that is shown, 0..1.
    """

    appearance: str
    fade_s: float
    brightness: float = 1.0


@dataclass(frozen=True, slots=True)
class Sequence:
    """Present appearances in turn, (name, seconds, fade_s) each, ``repeat`` times (0: without end).

    An item lasts ``seconds``, in the first ``fade_s`` of which it fades in over the previous one.
    ``rate_hz``: during it pictures change at multiples of 1 / rate_hz seconds; None: at the player's own.
    ``brightness``: the share of their light that is shown, 0..1; ``first_fade_s``: for how long the first item comes
    in at the beginning, None: as it says.
    """

    items: tuple[tuple[str, float, float], ...]
    repeat: int
    rate_hz: float | None
    brightness: float = 1.0
    first_fade_s: float | None = None


@dataclass(frozen=True, slots=True)
class Suggested:
    """Present the playlist that the loaded bundle suggests, ``repeat`` times (0: without end)."""

    repeat: int


@dataclass(frozen=True, slots=True)
class Stop:
    """Present black, ``fade_s`` seconds long over what is shown."""

    fade_s: float


@dataclass(frozen=True, slots=True)
class Live:
    """Present what is written to the frame file ``file`` as it comes, until something else is asked for.

    ``white``: it holds targets, whose white has this radiance, for the loaded bundle's live section; None: frames.
    """

    file: str
    white: float | None


@dataclass(frozen=True, slots=True)
class Identify:
    """Present each output's number, name and size, in a test pattern."""


@dataclass(frozen=True, slots=True)
class Status:
    """What is presented, since when, and how evenly."""


@dataclass(frozen=True, slots=True)
class LoadBundle:
    """Use another bundle from now on; what is shown stays."""

    path: str


@dataclass(frozen=True, slots=True)
class Quit:
    """Present black and end."""


@dataclass(frozen=True, slots=True)
class Clock:
    """The common clock is ``ahead_s`` ahead of this computer's monotonic one.

    If this is not said again within ``keep_s`` (None: for ever), the player ``then`` continues ("on"), shows "black"
    or stays "still".
    """

    ahead_s: float
    keep_s: float | None
    then: str


@dataclass(frozen=True, slots=True)
class Reports:
    """When the pictures of schedules were presented, of those that count more than ``after``."""

    after: int


@dataclass(frozen=True, slots=True)
class Device:
    """Of a display of several computers: bring ``call`` to the devices of the computer ``host``."""

    host: str
    call: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Timed:
    """A request that takes effect at a moment of the common clock. ``bundle``: the file it is of from then on."""

    request: Show | Play | Sequence | Stop
    at_s: float
    bundle: str | None


Request: TypeAlias = (
    Hello | Show | Play | Sequence | Suggested | Live | Stop | Identify | Status | LoadBundle | Clock | Reports | Timed
    | Quit | Device
)  # fmt: skip


def parse_request(line: bytes) -> tuple[Any, Request]:
    """Read one line: the request's ``id`` (any JSON scalar, None if absent) and the request.

    Raises InvalidRequest, which carries the id as far as it could be read.
    """
    try:
        message = json.loads(line.decode(), parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise InvalidRequest(None, "it is not one JSON object in UTF-8 on one line") from error
    if not isinstance(message, dict):
        raise InvalidRequest(None, "it is not a JSON object")
    ticket = message.pop("id", None)
    if not isinstance(ticket, str | int | None):
        raise InvalidRequest(None, "its id is neither text nor a whole number")
    operation = message.pop("op", None)
    reader = _READERS.get(operation) if isinstance(operation, str) else None
    if reader is None:
        raise InvalidRequest(ticket, f"its op is not one of {', '.join(_READERS)}")
    try:
        if message.get("at") is not None and operation in _TIMED:
            at_s, bundle = _number(message.pop("at"), "at", MAX_MOMENT_S), message.pop("bundle", None)
            return ticket, Timed(reader(**message), at_s, None if bundle is None else _text(bundle, "bundle"))
        return ticket, reader(**message)
    except TypeError as error:
        raise InvalidRequest(ticket, f"op {operation} has missing or unknown keys") from error
    except ValueError as error:
        raise InvalidRequest(ticket, str(error)) from error


class InvalidRequest(UsageError):
    """A line that is not a request. ``ticket`` is its id, as far as it could be read."""

    def __init__(self, ticket: Any, detail: str) -> None:
        super().__init__(
            "request-wrong",
            what=f"The request was not understood: {detail}.",
            remedy="Send requests as docs/reference/player-protocol.md describes them.",
        )
        self.ticket = ticket


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is not JSON")


def _integer(value: Any, key: str, most: int) -> int:
    if type(value) is not int or not 0 <= value <= most:
        raise ValueError(f"{key} is not a whole number from 0 to {most}")
    return value


def _number(value: Any, key: str, most: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value <= most or math.isnan(value):
        raise ValueError(f"{key} is not a number above 0 and at most {most:g}")
    return float(value)


def _text(value: Any, key: str) -> str:
    if not isinstance(value, str) or not 1 <= len(value) <= MAX_ITEMS or "\0" in value:
        raise ValueError(f"{key} is not a text")
    return value


def _show(*, sequence: Any) -> Show:
    return Show(_integer(sequence, "sequence", 2**64 - 1))


def _play(*, appearance: Any, fade_s: Any = 0.0, brightness: Any = 1.0) -> Play:
    return Play(_text(appearance, "appearance"), _fade(fade_s), _share(brightness))


def _stop(*, fade_s: Any = 0.0) -> Stop:
    return Stop(_fade(fade_s))


def _clock(*, ahead_s: Any, keep_s: Any = None, then: Any = "on") -> Clock:
    if isinstance(ahead_s, bool) or not isinstance(ahead_s, int | float) or not abs(ahead_s) <= MAX_MOMENT_S:
        raise ValueError(f"ahead_s is not a number of at most {MAX_MOMENT_S:g} either way")
    if then not in THEN:
        raise ValueError(f"then is not one of {', '.join(THEN)}")
    return Clock(float(ahead_s), None if keep_s is None else _number(keep_s, "keep_s", MAX_SECONDS), then)


def _reports(*, after: Any = 0) -> Reports:
    return Reports(_integer(after, "after", 2**63 - 1))


def _device(*, host: Any, call: Any) -> Device:
    if not isinstance(call, dict):
        raise ValueError("call is not an object")
    return Device(_text(host, "host"), call)


def _share(value: Any) -> float:
    return 0.0 if value == 0 and not isinstance(value, bool) else _number(value, "brightness", 1.0)


def _fade(value: Any) -> float:
    return 0.0 if value == 0 and not isinstance(value, bool) else _number(value, "fade_s", MAX_FADE_S)


def _live(*, file: Any, white: Any = None) -> Live:
    return Live(_text(file, "file"), None if white is None else _number(white, "white", MAX_RADIANCE))


def _sequence(
    *, items: Any, repeat: Any = 0, rate_hz: Any = None, brightness: Any = 1.0, first_fade_s: Any = None
) -> Sequence:
    if not isinstance(items, list) or not 1 <= len(items) <= MAX_ITEMS:
        raise ValueError(f"items is not a list of 1 to {MAX_ITEMS}")
    return Sequence(
        items=tuple(_item(item) for item in items),
        repeat=_integer(repeat, "repeat", 2**31),
        rate_hz=None if rate_hz is None else _number(rate_hz, "rate_hz", MAX_RATE_HZ),
        brightness=_share(brightness),
        first_fade_s=None if first_fade_s is None else _fade(first_fade_s),
    )


def _suggested(*, repeat: Any = 0) -> Suggested:
    return Suggested(_integer(repeat, "repeat", 2**31))


def _item(item: Any) -> tuple[str, float, float]:
    if not isinstance(item, list) or len(item) not in (2, 3):
        raise ValueError("an item is neither [appearance, seconds] nor [appearance, seconds, fade_s]")
    name, seconds, fade_s = (*item, 0.0)[:3]
    found = _text(name, "an item's appearance"), _number(seconds, "an item's seconds", MAX_SECONDS), _fade(fade_s)
    if found[2] > found[1]:
        raise ValueError("an item's fade_s is longer than its seconds")
    return found


def _load_bundle(*, path: Any) -> LoadBundle:
    return LoadBundle(_text(path, "path"))


_READERS: Final[dict[str, Any]] = {
    "hello": Hello,
    "show": _show,
    "play": _play,
    "sequence": _sequence,
    "suggested": _suggested,
    "live": _live,
    "stop": _stop,
    "identify": Identify,
    "status": Status,
    "load-bundle": _load_bundle,
    "clock": _clock,
    "reports": _reports,
    "quit": Quit,
    "device": _device,
}
_TIMED: Final = ("show", "play", "sequence", "stop")
