"""Devices on other computers of the display: projectors and mains relays.

The stage asks the player's socket, and the conductor there brings the question to the agent (``stage.hosts``). The
agent opens the device with the same driver, and keeps its lamp by the same ``LampGuard`` as the stage does. What it
opens is written down first. So an agent that starts again, and hears nothing of the stage, knows what may burn.
"""

from __future__ import annotations

import contextlib
import threading
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Final

from pydantic import TypeAdapter, ValidationError
from pydantic_core import to_json, to_jsonable_python

from controller.core.storage import runtime_path, write_atomically
from controller.play.control.launch import SOCKET_NAME
from controller.play.control.notify import log
from controller.stage.rig.lamp_guard import LampGuard
from controller.stage.rig.lamp_ledger import LampFile
from controller.stage.rig.power import power_down
from hal import errors
from hal.deadline import Deadline, in_seconds
from hal.errors import CodedError, DeviceError, DeviceGone, DeviceRefused
from hal.notices import Notice
from hal.player import PlayerClient
from hal.registry import Driver, Drivers, OpenContext, check_device, load_drivers, open_device
from hal.values import DeviceIdentity, LampRules, ProjectorCapabilities, ProjectorStatus

if TYPE_CHECKING:
    from controller.stage.link.session import Link

METHODS: Final[Mapping[str, Mapping[str, Any]]] = {
    "projector": {
        "identity": DeviceIdentity, "status": ProjectorStatus, "switch_on": None, "switch_off": None,
        "set_shutter": None, "adjustments": dict[str, str], "notices": list[Notice], "close": None,
    },
    "power_switch": {"identity": DeviceIdentity, "channels": int, "state": bool, "switch": None, "close": None},
}  # fmt: skip
"""What a device of each kind can be asked, and what it answers (``hal.interfaces``)."""
_LATER_S: Final = 2.0
"""An answer comes at most so much later than it does on the device's own computer."""
_SHORT_S: Final = 2.0
"""For calls that have no deadline."""
_OPEN_S: Final = 20.0


@dataclass(frozen=True, slots=True)
class DeviceElsewhere:
    """A device of the computer ``host``. ``rules``: the stage's own, for lamps.

    ``alone_s``: its lamp is switched off after so long without the stage; None: it is left as it is.
    """

    host: str
    kind: str
    name: str
    driver: str
    settings: dict[str, Any]
    rules: LampRules
    alone_s: float | None = None

    @property
    def key(self) -> str:
        return f"{self.kind} {self.name}"

    def opened_by(self, driver: Driver) -> Driver:
        """What opens it from here; ``driver``: the one that has its name on this computer."""
        return replace(driver, open=lambda settings, context, deadline: self._open(context, deadline))

    def _open(self, context: OpenContext, deadline: Deadline) -> object:
        answers = METHODS[self.kind]
        can = TypeAdapter(ProjectorCapabilities | None).validate_python(self.ask(context, "open", deadline=deadline))

        def method(name: str) -> Callable[..., Any]:
            def call(*arguments: Any, deadline: Deadline | None = None) -> Any:
                answer = self.ask(context, name, *arguments, deadline=deadline or in_seconds(_SHORT_S))
                return TypeAdapter(answers[name]).validate_python(answer)

            return call

        return SimpleNamespace(capabilities=can, **{name: method(name) for name in answers})

    def ask(self, context: OpenContext, method: str, *arguments: Any, deadline: Deadline) -> Any:
        """Its answer to "check" (of driver and settings), "open" or a method, as JSON has it.

        Raises its own errors, and DeviceGone if its computer can't be asked.
        """
        call = Call(self, method, deadline.left_s(), list(arguments))
        request = {"op": "device", "host": self.host, "call": to_jsonable_python(call)}
        client = PlayerClient()
        try:
            until = replace(deadline, at_s=deadline.at_s + _LATER_S)
            answer = client.request((context.runtime or runtime_path(context.stage)) / SOCKET_NAME, request, until)
        except DeviceRefused as error:
            raise DeviceGone(error.code, what=error.what, remedy=error.remedy) from error
        finally:
            client.hang_up()
        if (raised := answer.get("raised")) is not None:
            kind, code, what, remedy = raised
            raise getattr(errors, kind, DeviceError)(code, what=f"The computer {self.host}: {what}", remedy=remedy)
        return answer["value"]


@dataclass(frozen=True, slots=True)
class Call:
    """What is asked of a device; see ``DeviceElsewhere.ask``."""

    device: DeviceElsewhere
    method: str
    within_s: float
    arguments: list[Any] = field(default_factory=list)


class DevicesHere:
    """At the agent: the stage's devices on this computer, asked for at ``key``. ``folder``: for what lasts."""

    def __init__(self, folder: Path, link: Link, key: str, drivers: Drivers | None = None) -> None:
        self._context, self._drivers = OpenContext(stage=folder), drivers
        self._file, self._ledger = folder / "devices.json", LampFile(folder / LampFile.NAME)
        self._opened: dict[str, Any] = {}
        self._locks: dict[str, threading.RLock] = defaultdict(threading.RLock)
        self._writing, self._darkening = threading.Lock(), threading.Lock()
        self._noted: dict[str, DeviceElsewhere] = {}
        with contextlib.suppress(OSError, ValidationError):
            self._noted = TypeAdapter(dict[str, DeviceElsewhere]).validate_json(self._file.read_bytes())
        link.answer(key, Call, self.call)

    def call(self, call: Call) -> dict[str, Any]:
        """The ``value``, or the error that was ``raised``."""
        try:
            with self._locks[call.device.key]:
                return {"value": to_jsonable_python(self._answer(call))}
        except CodedError as error:
            return {"raised": [type(error).__name__, error.code, error.what, error.remedy]}

    def step(self, silent_s: float) -> None:
        """Switch lamps off that are without the stage for too long; nothing was heard of it for ``silent_s``."""
        burning = [one for one in self._burning() if one.alone_s is not None and silent_s > one.alone_s]
        if burning and not self._darkening.locked():
            threading.Thread(target=self._darken, args=(burning,), daemon=True).start()

    def end(self) -> None:
        """Switch off what burns: nothing here could do it later."""
        self._darken(self._burning(), ends=True)
        for key in list(self._opened):
            self._close(key)

    def _answer(self, call: Call) -> Any:
        device, deadline = call.device, in_seconds(call.within_s)
        if call.method == "check":
            driver = self._driver(device.kind, device.driver)
            return check_device(driver, device.settings, self._context, name=device.name)
        if call.method == "open":
            return getattr(self._open(device, deadline), "capabilities", None)
        if call.method == "close":
            return self._close(device.key)
        opened = self._opened.get(device.key)
        if opened is None or call.method not in METHODS[device.kind]:
            raise DeviceGone("device-not-open", what=f"{device.name} is not open.", remedy="It is opened again.")
        until = {} if call.method == "notices" else {"deadline": deadline}
        return getattr(opened, call.method)(*call.arguments, **until)

    def _driver(self, kind: str, name: str) -> Driver:
        if self._drivers is None:
            self._drivers = load_drivers(benches=False)
        return self._drivers.get(kind, name)

    def _open(self, device: DeviceElsewhere, deadline: Deadline) -> Any:
        self._close(device.key)
        driver = self._driver(device.kind, device.driver)
        self._note(device)
        made = open_device(driver, device.settings, self._context, deadline, name=device.name)
        if device.kind == "projector":
            made = LampGuard(device.name, made, self._ledger, at_least=device.rules)
        self._opened[device.key] = made
        return made

    def _close(self, key: str) -> None:
        """The lamp stays as it is."""
        if (opened := self._opened.pop(key, None)) is not None:
            opened.close()

    def _note(self, device: DeviceElsewhere) -> None:
        with self._writing:
            noted = {**self._noted, device.key: device}
            if noted != self._noted:
                write_atomically(self._file, to_json(noted), mode=0o600)
                self._noted = noted

    def _burning(self) -> list[DeviceElsewhere]:
        """Whose lamps may burn."""
        projectors = [device for device in self._noted.values() if device.kind == "projector"]
        return [one for one in projectors if (record := self._ledger.read(one.name)) is not None and record.lit]

    def _darken(self, devices: Sequence[DeviceElsewhere], *, ends: bool = False) -> None:
        """Switch their lamps off; unless this program ``ends``, one that warms up is left to the next step."""
        with self._darkening:
            guards = []
            for device in devices:
                with contextlib.suppress(CodedError), self._locks[device.key]:
                    guard = self._opened.get(device.key) or self._open(device, in_seconds(_OPEN_S))
                    rules = guard.capabilities.lamp_rules
                    warm = guard.stable_left_s() <= max(0.0, rules.stable_s - rules.warm_up_s)
                    guards += [guard] if warm or ends else []
            failed = [failure.projector for failure in power_down(guards)]
            for guard in guards:
                log(f"Projector {guard.name} {'could not be' if guard.name in failed else 'was'} switched off here.")
