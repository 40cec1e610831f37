"""Projectors on a serial line, with a table of commands (``firmware_configs/projectors``)."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeVar

from hal.codecs.projectors.profiles import ProjectorProfile
from hal.codecs.projectors.serial_protocol import Reply, UnaskedMessage, parse_hours, parse_power
from hal.codecs.projectors.serial_table import ADJUSTMENTS
from hal.deadline import Deadline, turn
from hal.errors import DeviceBusy, DeviceRefused, DeviceTimeout, ProtocolError
from hal.links import ByteLink
from hal.notices import Notice
from hal.registry import Driver, OpenContext
from hal.serial_link import SerialLink
from hal.values import DeviceIdentity, Power, ProjectorCapabilities, ProjectorStatus
from plugins.projectors.answers import OptionalAnswers, PowerView
from plugins.projectors.network.device_server import open_url
from plugins.projectors.profile_files import checked_address, read_settings, reported_powers, serial_table
from plugins.projectors.serial_conversation import COOLS, SERIAL_CHECK, SerialConversation

T = TypeVar("T")
_FIELDS: Final = {"lamp_hours": "lamp hours"}
UNNAMED_FAULT: Final = "error-standby"
"""The word for a projector that reports an unknown fault."""


class SerialProjector:
    """A projector with one of the table-driven serial protocols. Implements ``hal.interfaces.Projector``.

    Parameters
    ----------
    open_link : opens the serial port; called again whenever the link was lost
    profile : the family's table; it needs a ``serial`` part
    name : its name for the technician, for messages
    address : the projector's address on the line, or None for the profile's
    check : what a technician should check if it is silent
    """

    def __init__(
        self,
        open_link: Callable[[Deadline], ByteLink],
        profile: ProjectorProfile,
        *,
        name: str,
        address: str | None = None,
        check: str = SERIAL_CHECK,
    ) -> None:
        table = serial_table(profile)
        self._name = name
        self._profile = profile
        self._table = table
        self._view = PowerView(profile.lamp, reported_powers(table))
        self._lock = threading.Lock()
        self._open_link = open_link
        self._opened_at_s = time.monotonic()
        self._answered = False
        # Which shutter moves is known once one did: the commands of the other would not open it again.
        self._shutter = None if "lens_shutter_close" in table.commands else "shutter"
        self._optional = OptionalAnswers(name, _FIELDS)
        self._talk = SerialConversation(
            self._opened,
            name=name,
            timing=profile.timing,
            table=replace(table, address=checked_address(table, address)),
            notice=self._noticed,
            slow=self._may_be_starting,
            check=check,
        )

    def open(self, deadline: Deadline) -> None:
        """Open the port; sends nothing, because a booting projector must not be disturbed."""
        self._talk.open(deadline)

    def _opened(self, deadline: Deadline) -> ByteLink:
        link = self._open_link(deadline)
        self._opened_at_s, self._answered = time.monotonic(), False
        return link

    def _may_be_starting(self) -> bool:
        """Whether it must be asked seldom: it starts or cools, or may do so."""
        now_s = time.monotonic()
        if self._view.in_transition(now_s):
            return True
        if Power.WARMING in reported_powers(self._table):
            return not self._answered
        return now_s - self._opened_at_s < self._profile.lamp.warm_up_s

    @property
    def capabilities(self) -> ProjectorCapabilities:
        return ProjectorCapabilities(
            lamp_hours="lamp_hours" in self._table.queries and self._optional.knows("lamp_hours"),
            shutter="shutter_close" in self._table.commands,
            inputs=(),
            errors=bool(self._table.notices.trouble),
            lamp_rules=self._profile.lamp,
            power=self._switchable,
            answer_s=2 * self._profile.timing.question_s,
            switch_s=self._profile.timing.switch_s,
        )

    @property
    def _switchable(self) -> bool:
        return {"power_on", "power_off"} <= set(self._table.commands) and "power" in self._table.queries

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        with self._turn(deadline):
            model = self._answer("model", deadline, str)
            if model is None:
                self._power(deadline)  # a projector that answers belongs to this family
            known = f"{self._profile.family}, model code {model}" if model else self._profile.family
            return DeviceIdentity(self._profile.maker, known, firmware=self._answer("firmware", deadline, str) or "")

    def status(self, *, deadline: Deadline) -> ProjectorStatus:
        with self._turn(deadline):
            power = self._power(deadline)
            hours = self._optional.counted("lamp_hours", power, partial(self._hours, power), deadline)
            unnamed = power is Power.FAULT and not self._view.trouble
            return ProjectorStatus(power, (UNNAMED_FAULT,) if unnamed else self._view.trouble, hours)

    def adjustments(self, *, deadline: Deadline) -> dict[str, str]:
        """As ``hal.interfaces.AdjustedProjector.adjustments``: what its profile has queries for."""
        with self._turn(deadline):
            asked = [name for name in ADJUSTMENTS if name in self._table.queries]
            if not asked or self._power(deadline) is not Power.ON:
                return {}
            # Models of a family differ in their menus, so that a missing answer is nothing to report.
            parsed = {name.replace("_", " "): self._answer(name, deadline, str, lit=False) for name in asked}
            return {name: value for name, value in parsed.items() if value is not None}

    def switch_on(self, *, deadline: Deadline) -> None:
        with self._turn(deadline):
            self._require_switchable()
            power = self._power(deadline)
            if power in (Power.ON, Power.WARMING):
                return
            if power is Power.COOLING:
                raise self._refused("projector-cooling", "is still cooling its lamp and was not switched on")
            if power is Power.UNKNOWN:
                raise self._refused("projector-state-unknown", "is in an unknown state")
            reply = self._talk.command("power_on", deadline=deadline)
            if reply in (Reply.REFUSED, Reply.COOLING):
                raise self._refused("projector-refused-on", "refused to switch on; its lamp may still be cooling")
            if reply is Reply.ACCEPTED:
                self._view.switched_on(time.monotonic())
            self._confirm((Power.ON, Power.WARMING), "on", deadline)

    def switch_off(self, *, deadline: Deadline) -> None:
        with self._turn(deadline):
            self._require_switchable()
            if self._power(deadline) in (Power.OFF, Power.COOLING, Power.FAULT):
                return
            reply = self._talk.command("power_off", deadline=deadline)
            if reply in (Reply.REFUSED, Reply.COOLING):
                raise self._refused("projector-refused-off", "refused to switch off; it may still be starting")
            if reply is Reply.ACCEPTED:
                self._view.switched_off(time.monotonic())
            self._confirm((Power.OFF, Power.COOLING, Power.FAULT), "off", deadline)

    def set_shutter(self, closed: bool, *, deadline: Deadline) -> None:
        with self._turn(deadline):
            if not self.capabilities.shutter:
                raise self._refused("projector-no-shutter", "has no shutter")
            which = self._shutter
            reply = self._moved(which or "lens_shutter", closed, deadline)
            if which is None and reply is not Reply.ACCEPTED:
                which, reply = "shutter", self._moved("shutter", closed, deadline)
            if reply is Reply.ACCEPTED:
                self._shutter = which or "lens_shutter"
            if reply is None:
                raise self._talk.no_answer()
            if reply in (Reply.REFUSED, Reply.COOLING):
                raise self._refused("projector-refused-shutter", "refused to move its shutter; it may be off")

    def _moved(self, which: str, closed: bool, deadline: Deadline) -> Reply | None:
        return self._talk.command(f"{which}_close" if closed else f"{which}_open", deadline=deadline)

    def close(self) -> None:
        self._talk.close()

    def _power(self, deadline: Deadline) -> Power:
        if "power" not in self._table.queries:
            return self._power_without_codes(deadline)
        try:
            answer = parse_power(self._talk.query("power", deadline=deadline))
        except DeviceBusy as busy:
            if busy.code != COOLS:
                raise
            answer = Power.COOLING
        self._answered = True
        return self._view.answered(answer, time.monotonic())

    def _power_without_codes(self, deadline: Deadline) -> Power:
        """The power state if the family has no query for it: any other query shows that it is there, or cools."""
        try:
            self._talk.query(next(iter(self._table.queries)), deadline=deadline)
        except DeviceBusy as busy:
            return Power.COOLING if busy.code == COOLS else Power.UNKNOWN
        return Power.UNKNOWN

    def _require_switchable(self) -> None:
        if not self._switchable:
            raise DeviceRefused(
                "projector-power-unknown",
                what=f"The projector at {self._name} can't be switched: {self._profile.name} has no codes for it.",
                remedy="Switch it with its own button or remote control, or add its power codes to the profile.",
            )

    def _hours(self, power: Power, deadline: Deadline) -> int | None:
        if power in (Power.WARMING, Power.COOLING):
            return None  # a projector that is busy with its lamp is asked only for its power
        if "lamp_hours" not in self._table.queries:
            return None
        per_hour = self._table.queries["lamp_hours"].per_hour
        lit = power is Power.ON
        return self._answer("lamp_hours", deadline, lambda text: parse_hours(text, per_hour), lit=lit)

    def _answer(self, question: str, deadline: Deadline, parse: Callable[[str], T], *, lit: bool = True) -> T | None:
        """The answer to an optional query; None if it is refused, missing or not understood.

        Raises only Cancelled and the loss of the port. In standby (not ``lit``) some models do not answer queries
        or answer in another shape, which is normal.
        """
        if question not in self._table.queries or not self._optional.may_ask(question):
            return None
        try:
            parsed = parse(self._talk.query(question, deadline=deadline))
        except DeviceBusy:
            return None
        except DeviceTimeout:
            if not deadline.passed:
                self._optional.silent(question, usual=not lit)
            return None
        except ProtocolError as error:
            if lit:
                self._optional.odd(question, error.what)
            return None
        self._optional.understood(question)
        return parsed

    def notices(self) -> list[Notice]:
        """As ``hal.interfaces.WatchedProjector.notices``."""
        return self._optional.notices()

    def _confirm(self, wanted: tuple[Power, ...], word: str, deadline: Deadline) -> None:
        """Wait until the power state shows the effect of a command, even if its reply was lost."""
        patience = deadline.within(self._profile.timing.confirm_s)
        while (power := self._seen(deadline)) not in wanted:
            if word == "on" and (self._view.failed or power is Power.FAULT):
                trouble = ", ".join(self._view.trouble) or UNNAMED_FAULT
                raise self._refused("projector-fault", f"did not switch on: it reports {trouble}")
            if patience.passed:
                raise DeviceTimeout(
                    f"projector-not-{word}",
                    what=f"The projector at {self._name} did not switch {word}.",
                    remedy="Check its indicator lights. If it shows no fault, switch it once with its own button.",
                )
            patience.sleep(self._profile.timing.interval_s)

    def _seen(self, deadline: Deadline) -> Power | None:
        try:
            return self._power(deadline)
        except (DeviceBusy, DeviceTimeout):
            # Some models do not answer while they start; only the caller's deadline ends the waiting early.
            if deadline.passed:
                raise
            return None

    def _noticed(self, notice: UnaskedMessage) -> None:
        if notice.power is not None:
            self._view.noticed_power(notice.power, time.monotonic())
        if notice.trouble is not None:
            self._view.noticed_trouble(notice.trouble)

    def _refused(self, code: str, doing: str) -> DeviceRefused:
        return DeviceRefused(
            code,
            what=f"The projector at {self._name} {doing}.",
            remedy="Wait until it has cooled and shows standby. If it reports a fault, correct that first.",
        )

    @contextmanager
    def _turn(self, deadline: Deadline) -> Iterator[None]:
        """One caller at a time, and none after ``close``."""
        explained = self._talk.no_answer()
        check = partial(deadline.check, explained.code, what=explained.what, remedy=explained.remedy)
        check()
        with turn(self._lock, deadline, check):
            self._talk.check_open()
            yield


def open_serial_projector(settings: Mapping[str, Any], context: OpenContext, deadline: Deadline) -> SerialProjector:
    """Open the projector of a stage.toml table; see ``DRIVER`` for the settings."""
    profile, port, baud, address = read_settings(settings, context)
    transcript = context.transcript("serial", port.name if isinstance(port, Path) else port)

    def line(until: Deadline) -> ByteLink:
        if isinstance(port, Path):
            return SerialLink(port, baud=baud, deadline=until, transcript=transcript)
        return open_url(port, baud=baud, deadline=until, transcript=transcript)

    projector = SerialProjector(line, profile, name=str(settings["port"]), address=address)
    projector.open(deadline)
    return projector


DRIVER = Driver(
    kind="projector",
    name="serial",
    summary="Projectors on a serial line, with a table of commands.",
    open=open_serial_projector,
    settings={
        "profile": "the family's table: a shipped name such as optoma-later, or a .toml file of the stage",
        "port": "the serial port; a stable name such as /dev/serial/by-id/..., a path relative to the stage, or a port "
        "of a device server: socket://host:port or rfc2217://host:port",
        "baud": "baud rate (default: the profile's)",
        "address": "the projector's number on the line (default: the profile's)",
    },
    required=("profile", "port"),
    check=read_settings,
)
