"""The other computer's side: keeps its players running and on time, with the conductor or without it.

What is to be shown when is in each player. So a network that is cut, or a conductor that ends, changes nothing until
the time that the stage allows is over; then each player does what its rule says.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Final, Protocol

from controller.core.errors import UsageError, WorkError
from controller.core.storage import runtime_folder
from controller.stage.hosts.clock import HostClock
from controller.stage.hosts.remote import NO_UPDATE, Asked, Report, key, placed_rows
from controller.stage.hosts.screen import Screen, Setup
from controller.stage.link.joining import Joining, admit
from controller.stage.link.membership import Authority, membership
from controller.stage.link.session import BEAT, BEAT_S, Link, member_link
from controller.stage.link.transfer import Arrivals

PORT: Final = 7449
"""Of the conductor, for the agents."""
_NEVER_S: Final = -1e9


class Updates(Protocol):
    """The program's, of this computer; ``controller.kiosk.install.update`` has it."""

    def plays(self, state: str) -> tuple[str, str, str]: ...


class Devices(Protocol):
    """The stage's, on this computer; ``controller.stage.rig.elsewhere`` has it."""

    def step(self, silent_s: float) -> None: ...

    def end(self) -> None: ...


def keep(
    keys: Path, name: str | None, show: Callable[[str], AbstractContextManager[None]], cancel: threading.Event,
    devices: Callable[[Path, Link, str], Devices], updates: Callable[[Link, str], Updates] | None,
) -> dict[str, Any]:  # fmt: skip
    """An agent on this computer until ``cancel``; without a membership in ``keys`` it first joins by a code, which
    ``show`` shows meanwhile. ``devices``: makes those of this computer, from a folder for what lasts; ``updates``:
    takes those of the program that the link brings; None where the program is not an installed one.

    Raises as ``Joining`` and ``member_link``.
    """
    own = membership(keys)
    while own is None and not cancel.is_set():
        joining = Joining(keys, name or socket.gethostname().split(".")[0].lower())
        with joining, show(f"Code of this computer: {joining.code}"), contextlib.suppress(WorkError):
            own = joining.wait()
    if own is None:
        return {}
    clock = HostClock()
    runtime = runtime_folder(keys.resolve())

    def screen(display: str) -> Screen:
        return Screen(runtime / (display.strip(":") or "first"), clock, display=display)

    with member_link(own) as link:
        agent = Agent(link, own.name, keys.with_name("bundles"), clock, screen)
        agent.devices = devices(keys.resolve().parent, link, key(own.name, "device"))
        if updates is not None:
            agent.updates = updates(link, key(own.name, "program"))
        agent.run(cancel)
    return {"name": own.name}


def admitted(stage: Path, address: str, code: str) -> dict[str, Any]:
    """At the stage: the computer at ``address`` may have outputs of it from now on. Raises as ``admit``."""
    own = f"tls/{socket.gethostname()}.local:{PORT}", f"tls/{_address_towards(address)}:{PORT}"
    member = admit(Authority(stage / "keys" / "players", "players"), address, code, own)
    return {"name": member.name}


def _address_towards(address: str) -> str:
    """The address of this computer that another one reaches."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect((address.rsplit(":", 1)[0], PORT))
        return str(probe.getsockname()[0])


class Agent:
    """The players of this computer, for the conductor at the other end of ``link``; ``run`` it in the main thread.

    ``folder``: for the bundles; ``screen``: makes the player of an X screen.
    """

    def __init__(self, link: Link, name: str, folder: Path, clock: HostClock, screen: Callable[[str], Screen]) -> None:
        self._link, self._name, self._clock, self._make = link, name, clock, screen
        self._screens: dict[str, Screen] = {}
        self._bundles = Arrivals(folder, self._check)
        self._pictures: dict[tuple[str, str], Any] = {}
        self._heard_s, self._began_s = _NEVER_S, time.monotonic()
        self.updates: Updates | None = None
        self.devices: Devices | None = None
        self._lock = threading.Lock()
        link.answer(key(name, "prepare"), dict[str, Setup], self._prepare)
        link.answer(key(name, "ask"), Asked, self._ask)
        link.answer(key(name, "rows"), bytes, self._rows)
        self._bundles.listen(link, key(name, "bundle"))
        link.subscribe(BEAT, bytes, self._beat)
        link.appear(key(name, "there"))

    def run(self, ended: threading.Event) -> None:
        """Until ``ended``; then the players show black and end, and lamps are switched off."""
        while not ended.wait(BEAT_S):
            self.step()
        for screen in self._screens.values():
            screen.end()
        if self.devices is not None:
            self.devices.end()

    def step(self) -> None:
        """Look at the clock and at each player once, and report."""
        self._clock.look()
        silent_s = time.monotonic() - self._heard_s
        if self.devices is not None:
            self.devices.step(min(silent_s, time.monotonic() - self._began_s))
        with self._lock:
            states = {name: one.step(one.setup.keep_s - silent_s) for name, one in self._screens.items()}
        plays = "playing" if all(state.status is not None for state in states.values()) else "fault"
        told = self.updates.plays(plays if states else "off") if self.updates is not None else NO_UPDATE
        self._link.publish(key(self._name, "state"), Report(self._clock.trouble, states, told))

    def _beat(self, _: bytes) -> None:
        self._heard_s = time.monotonic()

    def _prepare(self, setups: dict[str, Setup]) -> None:
        self._heard_s = time.monotonic()
        with self._lock:
            for name in self._screens.keys() - setups.keys():
                self._screens.pop(name).end()
            for name, setup in setups.items():
                screen = self._screens.get(name) or self._make(name)
                screen.prepare(setup)
                screen.step(setup.keep_s)
                self._screens[name] = screen

    def _ask(self, asked: Asked) -> dict[str, Any]:
        request = dict(asked.request)
        if isinstance(request.get("bundle"), str):
            request["bundle"] = str(self._bundles.path(request["bundle"]))
        return self._screen(asked.screen).ask(request, within_s=asked.within_s)

    def _rows(self, message: bytes) -> None:
        try:
            screen, output = placed_rows(message, self._pictures)
        except ValueError as error:
            raise WorkError("link-message-wrong", what="A picture came damaged.", remedy="It is sent again.") from error
        self._screen(screen).put({output: self._pictures[screen, output]})

    def _check(self, bundle: Path) -> None:
        for screen in self._screens.values():
            screen.check(bundle)

    def _screen(self, name: str) -> Screen:
        if (screen := self._screens.get(name)) is None:
            raise UsageError(
                "host-not-prepared", what=f"{self._name} has no player for the screen {name!r}.",
                remedy="Wait a moment: the conductor starts it.",
            )  # fmt: skip
        return screen
