"""What switches outlets over a network has in common: calls of an asyncio library with deadlines, and its checks."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Coroutine
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeout
from functools import partial
from importlib.util import find_spec
from typing import Any, Final, TypeVar

from hal.deadline import SLICE_S, Deadline, turn
from hal.errors import DeviceGone, DeviceRefused, PluginError
from hal.interfaces import PowerSwitch

Result = TypeVar("Result")
AnySwitch = TypeVar("AnySwitch", bound=PowerSwitch)
_END_S: Final = 0.7
_LEFT_S: Final = 5.0


def answering(switch: AnySwitch, deadline: Deadline) -> AnySwitch:
    """``switch``, if it answers; else it is closed, and its error raised."""
    try:
        switch.identity(deadline=deadline)
    except BaseException:
        switch.close()
        raise
    return switch


def require_library(name: str) -> None:
    """Raises PluginError("extra-missing") if the library of the extra ``mains`` is not installed."""
    if find_spec(name) is None:
        raise PluginError(
            "extra-missing",
            what=f"The Python module {name} is not installed.",
            remedy="Run `pip install 'velatura[mains]'` in Velatura's environment.",
        )


class Outlets:
    """One caller at a time; the library's calls run on the loop of a thread.

    ``name``: of the device, for messages; ``count``: how many outlets it has.
    """

    def __init__(self, name: str, count: int) -> None:
        self.name = name
        self.count = count
        self._turn = threading.Lock()
        self._closed = False
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._serve, name="outlets", daemon=True)
        self._thread.start()

    def run(self, work: Coroutine[Any, Any, Result], deadline: Deadline) -> Result:
        """The result of ``work``. Raises what it raises, DeviceTimeout, Cancelled, and DeviceGone once closed.

        At the deadline ``work`` is left to its own time limits: the libraries do not end well when they are cancelled.
        """
        future: Future[Result] | None = None
        try:
            with turn(self._turn, deadline, partial(self.check, deadline)):
                self.check(deadline)
                future = asyncio.run_coroutine_threadsafe(work, self._loop)
                return self._waited(future, deadline)
        finally:
            if future is None:
                work.close()

    def check(self, deadline: Deadline) -> None:
        """Raise DeviceGone once closed, Cancelled, and DeviceTimeout("outlets-no-answer") after the deadline."""
        if self._closed:
            raise DeviceGone("outlets-closed", what=f"{self.name} was closed.", remedy="Open the stage again.")
        deadline.check(
            "outlets-no-answer",
            what=f"{self.name} did not answer in time.",
            remedy="Check its network cable, its address, and its community or unit in stage.toml.",
        )

    def require(self, channel: int) -> None:
        """Raises DeviceRefused("relay-no-channel")."""
        if not 1 <= channel <= self.count:
            raise DeviceRefused(
                "relay-no-channel",
                what=f"{self.name} has no channel {channel}.",
                remedy=f"Use a channel from 1 to {self.count}, or correct channels in stage.toml.",
            )

    def stuck(self, channel: int, closed: bool) -> DeviceRefused:
        """The error of an outlet that did not follow its command."""
        return DeviceRefused(
            "relay-stuck",
            what=f"Channel {channel} of {self.name} did not switch {'on' if closed else 'off'}.",
            remedy="If in doubt, switch its mains off by hand. Check that remote control is allowed in its menu.",
        )

    def close(self) -> None:
        """End; the outlets stay as they are. Harmless when called twice."""
        if not self._closed:
            self._closed = True
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join(_END_S)

    def _serve(self) -> None:
        self._loop.run_forever()
        left = asyncio.all_tasks(self._loop)
        if left:
            self._loop.run_until_complete(asyncio.wait(left, timeout=_LEFT_S))
        self._loop.close()

    def _waited(self, future: Future[Result], deadline: Deadline) -> Result:
        while True:
            try:
                return future.result(min(SLICE_S, deadline.left_s()))
            except FutureTimeout:
                if future.done():
                    raise  # the library's own
                self.check(deadline)
