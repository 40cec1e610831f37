"""A mains switch from two functions: ``set(channel, on)`` and ``get(channel)``.

What every driver of mains needs beside them is here: deadlines, one caller at a time, a check that the outlet has
followed, the refusal of channels that are not there, and the entry in the list of drivers. CONTRIBUTING.md has an
example ("A mains switch in 30 lines"). The caller keeps the lamp rules.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, Final, TypeVar

from hal.deadline import Deadline
from hal.errors import DeviceError, DeviceGone, DeviceRefused, DeviceTimeout, PluginError, ProtocolError
from hal.registry import Driver, OpenContext, setting
from hal.runtime.call_threads import CallThread
from hal.values import DeviceIdentity

Result = TypeVar("Result")
_END_S: Final = 0.7
_LOOK_S: Final = 0.2


@dataclass(frozen=True, slots=True)
class Outlets:
    """What a device that switches mains can do. Its functions may block; they run on one thread.

    Parameters
    ----------
    name : for messages, e.g. ``"The PDU at 10.0.0.3:161"``
    count : how many channels it has, counted from 1
    get : whether a channel passes current, asked at the device
    set : switches a channel; sends its command once only
    describe : its model, asked at the device; without it, the first channel is read to see that it answers
    settle_s : a channel may follow its command so much later

    They raise errors of ``hal.errors``; an ``OSError`` becomes one, too.
    """

    name: str
    count: int
    get: Callable[[int], bool]
    set: Callable[[int, bool], object]
    describe: Callable[[], str] | None = None
    settle_s: float = 0.0


class OutletSwitch:
    """``hal.interfaces.PowerSwitch`` of ``outlets``."""

    def __init__(self, outlets: Outlets) -> None:
        self._outlets = outlets
        self._thread = CallThread("outlets", check=self._check, closed=self._was_closed)

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        """The model that the device says. Raises as ``state``."""

        def ask() -> str:
            if self._outlets.describe is not None:
                return self._outlets.describe()
            self._outlets.get(1)
            return ""

        return DeviceIdentity("", self._run(ask, deadline) or self._outlets.name)

    def channels(self, *, deadline: Deadline) -> int:
        """How many channels it has, without asking it."""
        self._thread.require_open()
        self._check(deadline)
        return self._outlets.count

    def state(self, channel: int, *, deadline: Deadline) -> bool:
        """See ``hal.interfaces.PowerSwitch.state``.

        Raises DeviceRefused("relay-no-channel"), DeviceTimeout("outlets-no-answer"), DeviceGone("outlets-gone" or
        "outlets-closed"), Cancelled, and what ``get`` raises.
        """
        self._require(channel)
        return self._run(lambda: self._outlets.get(channel), deadline)

    def switch(self, channel: int, closed: bool, *, deadline: Deadline) -> None:
        """Switch a channel, and check it; no effect if it is so already. Raises as ``state``, "relay-stuck" too."""
        if self.state(channel, deadline=deadline) is closed:
            return
        lost: DeviceError | None = None
        try:
            self._run(lambda: self._outlets.set(channel, closed), deadline)
        except (DeviceGone, DeviceTimeout, ProtocolError) as error:
            self._thread.require_open()
            lost = error  # the answer may be lost, and not the command: the outlet shows which
        patience = deadline.within(self._outlets.settle_s)
        while self.state(channel, deadline=deadline) is not closed:
            if patience.passed:
                if lost is not None:
                    raise lost
                raise DeviceRefused(
                    "relay-stuck",
                    what=f"Channel {channel} of {self._outlets.name} did not switch {'on' if closed else 'off'}.",
                    remedy="If in doubt, switch its mains off by hand. Check that its menu allows remote control.",
                )
            patience.sleep(_LOOK_S)

    def close(self) -> None:
        """End; the outlets stay as they are. Harmless when called twice."""
        self._thread.close(_END_S)

    def _run(self, work: Callable[[], Result], deadline: Deadline) -> Result:
        def unless_given_up(until: Deadline) -> Result:
            until.sleep(0.0)  # an outlet must not move minutes later
            return work()

        try:
            return self._thread.run(unless_given_up, deadline)
        except OSError as error:
            raise DeviceGone(
                "outlets-gone",
                what=f"{self._outlets.name} can't be reached: {error.strerror or error}.",
                remedy="Check its power, its network cable and its address in stage.toml.",
            ) from error

    def _require(self, channel: int) -> None:
        if not 1 <= channel <= self._outlets.count:
            raise DeviceRefused(
                "relay-no-channel",
                what=f"{self._outlets.name} has no channel {channel}.",
                remedy=f"Use a channel from 1 to {self._outlets.count}, or correct channels in stage.toml.",
            )

    def _was_closed(self) -> DeviceGone:
        return DeviceGone("outlets-closed", what=f"{self._outlets.name} was closed.", remedy="Open the stage again.")

    def _check(self, deadline: Deadline) -> None:
        deadline.check(
            "outlets-no-answer",
            what=f"{self._outlets.name} did not answer in time.",
            remedy="Check its network cable, its address, and its other settings in stage.toml.",
        )


def outlets_driver(
    name: str,
    *,
    summary: str,
    settings: Mapping[str, str],
    required: tuple[str, ...],
    outlets: Callable[[Mapping[str, Any]], Outlets],
    library: str = "",
) -> Driver:
    """The driver ``name`` of mains switches.

    ``settings`` explains the keys of its table in stage.toml. ``outlets`` reads such a table and raises PluginError for
    wrong values; it asks the device nothing. ``library``: a module of the extra ``mains`` that has to be installed.
    """

    def check(table: Mapping[str, Any], context: OpenContext) -> None:
        outlets(table)

    def open_switch(table: Mapping[str, Any], context: OpenContext, deadline: Deadline) -> OutletSwitch:
        if library and find_spec(library) is None:
            raise PluginError(
                "extra-missing",
                what=f"The Python module {library} is not installed.",
                remedy="Run `pip install 'velatura[mains]'` in Velatura's environment.",
            )
        switch = OutletSwitch(outlets(table))
        try:
            switch.identity(deadline=deadline)
        except BaseException:
            switch.close()
            raise
        return switch

    return Driver("power_switch", name, summary, open_switch, settings, required=required, check=check)


def whole_number(settings: Mapping[str, Any], key: str, low: int, high: int, usual: int | None = None) -> int:
    """A whole number from ``low`` to ``high`` of a table; ``usual`` where it has none.

    Raises PluginError("setting-wrong").
    """
    number: int = setting(settings, key, int, usual)
    if not low <= number <= high:
        raise PluginError(
            "setting-wrong",
            what=f"The setting '{key}' is {number}, not {low} to {high}.",
            remedy=f"Correct {key} in stage.toml.",
        )
    return number
