"""A douser by sACN (ANSI E1.31): a motor with blades before a lens, on a channel of a DMX node.

DMX has no way back: that the blades have moved can't be read, only seen.
"""

from __future__ import annotations

import ipaddress
import uuid
from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any, Final

from hal.deadline import Deadline
from hal.errors import DeviceGone, PluginError
from hal.links import host_and_port
from hal.registry import Driver, OpenContext, setting
from hal.values import DeviceIdentity
from plugins.dousers.stream import Target, joined, left

PORT: Final = 5568
MULTICAST: Final = "multicast"


class SacnDouser:
    """``hal.interfaces.Douser``. ``levels``: (open, closed); ``travel_s``: time that the blades need."""

    def __init__(self, target: Target, channel: int, *, levels: tuple[int, int], travel_s: float) -> None:
        self._target = target
        self._stream = joined(target)
        self._channel = channel
        self._levels = levels
        self._travel_s = travel_s
        self._sent_closed: bool | None = None
        self._over = False

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        self._check(deadline)
        return DeviceIdentity("", f"sACN douser, universe {self._target.universe}, channel {self._channel}")

    def move(self, closed: bool, *, deadline: Deadline) -> None:
        """See ``hal.interfaces.Douser.move``. Raises DeviceGone("douser-gone"); the node still gets it later."""
        self._check(deadline)
        before, self._sent_closed = self._sent_closed, closed
        self._stream.put(self._channel, self._levels[closed], deadline=deadline)
        if before is not closed:
            deadline.sleep(self._travel_s)
            self._check(deadline)

    def closed(self, *, deadline: Deadline) -> bool | None:
        """What was sent last. Raises DeviceGone("douser-gone") if it does not reach the node now."""
        self._check(deadline)
        self._stream.verify(deadline=deadline)
        return self._sent_closed

    def close(self) -> None:
        """End the stream if this is the last douser of its universe: the node then does what its settings say."""
        if not self._over:
            self._over = True
            left(self._target)

    def _check(self, deadline: Deadline) -> None:
        if self._over:
            raise DeviceGone("douser-closed", what="The douser was closed.", remedy="Open the stage again.")
        deadline.check(
            "douser-no-answer",
            what="The time for the douser's movement was too short.",
            remedy="Check travel_s in stage.toml.",
        )


_ALLOWED: Final = {
    "universe": (1, 63_999), "channel": (1, 512), "open_level": (0, 255), "closed_level": (0, 255),
    "priority": (1, 200), "travel_s": (0, 3),
}  # fmt: skip
_DEFAULTS: Final = {"open_level": 255, "closed_level": 0, "priority": 100, "travel_s": 1.0}


def _read(settings: Mapping[str, Any]) -> tuple[Target, dict[str, Any]]:
    numbers: dict[str, Any] = {}
    for key, (low, high) in _ALLOWED.items():
        kinds = (int, float) if key == "travel_s" else int
        numbers[key] = setting(settings, key, kinds, _DEFAULTS.get(key))
        if not low <= numbers[key] <= high:
            raise _wrong(key, f"is {numbers[key]}, not {low} to {high}")
    if numbers["open_level"] == numbers["closed_level"]:
        raise _wrong("closed_level", "is the same as open_level")
    address = str(setting(settings, "address", str))
    interface = str(setting(settings, "interface", str, ""))
    host, port = ("", PORT) if address == MULTICAST else host_and_port(address, PORT)
    for key, value in (("address", host), ("interface", interface)):
        if value and not _is_ipv4(value):
            raise _wrong(key, f"is {value!r}, not an IPv4 address such as 192.168.0.40")
    # The same source after a restart: a node merges two sources until the older one counts as lost.
    place = f"velatura/{uuid.getnode()}/{address}/{numbers['universe']}/{numbers['priority']}"
    identity = uuid.uuid5(uuid.NAMESPACE_URL, place).hex
    target = Target(host, port, numbers["universe"], numbers["priority"], not host, interface, identity)
    return target, numbers


def _is_ipv4(text: str) -> bool:
    try:
        ipaddress.IPv4Address(text)
    except ValueError:
        return False
    return True


def _wrong(key: str, problem: str) -> PluginError:
    return PluginError("setting-wrong", what=f"The setting '{key}' {problem}.", remedy=f"Correct {key} in stage.toml.")


def open_sacn_douser(settings: Mapping[str, Any], context: OpenContext, deadline: Deadline) -> SacnDouser:
    """Open the douser of a stage's table. Nothing is sent before its first movement."""
    if find_spec("sacn") is None:
        raise PluginError(
            "extra-missing",
            what="The Python module sacn is not installed.",
            remedy="Run `pip install 'velatura[building]'` in Velatura's environment.",
        )
    target, numbers = _read(settings)
    levels = (numbers["open_level"], numbers["closed_level"])
    return SacnDouser(target, numbers["channel"], levels=levels, travel_s=float(numbers["travel_s"]))


DRIVER: Final = Driver(
    kind="douser",
    name="sacn",
    summary="A douser on a channel of a DMX node, by sACN (needs the extra building).",
    open=open_sacn_douser,
    settings={
        "address": 'the node\'s IPv4 address, e.g. "192.168.0.40", with :port if it is not 5568, or "multicast"',
        "universe": "1 to 63999, as in the node's menu",
        "channel": "the douser's channel, 1 to 512",
        "open_level": "the level that opens it, 0 to 255 (default: 255)",
        "closed_level": "the level that closes it, 0 to 255 (default: 0)",
        "travel_s": "seconds that the blades need, 0 to 3 (default: 1)",
        "priority": "the stream's priority, 1 to 200 (default: 100)",
        "interface": "an IPv4 address of this computer, for multicast (default: the system's choice)",
    },
    required=("address", "universe", "channel"),
    check=lambda settings, context: _read(settings),
)
