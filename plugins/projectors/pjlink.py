"""Projectors on the network with PJLink, class 1 or 2."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

from hal.codecs.projectors import pjlink
from hal.codecs.projectors.pjlink import Failure
from hal.codecs.projectors.profiles import ProjectorProfile
from hal.deadline import Deadline, turn
from hal.errors import DeviceBusy, DeviceGone, DeviceRefused, DeviceTimeout, PluginError, ProtocolError
from hal.links import ByteLink, TcpLink, host_and_port
from hal.notices import Notice
from hal.registry import Driver, OpenContext, setting
from hal.values import DeviceIdentity, Power, ProjectorCapabilities, ProjectorStatus
from plugins.projectors.pjlink_conversation import PjLinkConversation
from plugins.projectors.profile_files import load_profile


class PjLinkProjector:
    """A projector with PJLink. Implements ``hal.interfaces.Projector``.

    One connection is kept: the control boards of some projectors stop for good after some ten thousand of them. It is
    closed where an answer is lost, and where the projector closes its own.

    Parameters
    ----------
    connect : opens a connection
    profile : its time limits and its lamp, which the protocol does not give
    name : its name for the technician, for messages
    password : at most 32 characters, or None
    """

    def __init__(
        self,
        connect: Callable[[Deadline], ByteLink],
        profile: ProjectorProfile,
        *,
        name: str,
        password: str | None = None,
    ) -> None:
        self._talk = PjLinkConversation(connect, name, password, profile)
        self._habits = self._talk.habits
        self._timing = profile.timing
        self._lamp = profile.lamp
        self._name = name
        self._lock = threading.Lock()
        self._inputs: tuple[str, ...] = ()

    def open(self, deadline: Deadline) -> None:
        """Reach the projector once, check the password, and learn its inputs."""
        with self._turn(deadline) as talk:
            with contextlib.suppress(DeviceBusy):
                talk.power(deadline)
            self._inputs = talk.optional("INST", pjlink.parse_inputs, deadline) or ()
            # Asked once now, so that ``capabilities`` is correct.
            talk.optional("LAMP", pjlink.parse_lamps, deadline)
            talk.optional("ERST", pjlink.parse_errors, deadline)

    @property
    def capabilities(self) -> ProjectorCapabilities:
        return ProjectorCapabilities(
            lamp_hours=self._habits.knows("LAMP"),
            shutter=True,
            inputs=self._inputs,
            errors=self._habits.knows("ERST"),
            lamp_rules=self._lamp,
            answer_s=3 * self._timing.question_s,
            switch_s=self._timing.switch_s,
        )

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        with self._turn(deadline) as talk:
            maker, model = (talk.text(name, deadline) for name in ("INF1", "INF2"))
            second = talk.optional("CLSS", pjlink.parse_class, deadline) == 2
            serial = talk.text("SNUM", deadline, 2) if second else ""
            firmware = talk.text("SVER", deadline, 2) if second else talk.text("INFO", deadline)
            return DeviceIdentity(maker or "unknown", model or "PJLink projector", serial, firmware)

    def status(self, *, deadline: Deadline) -> ProjectorStatus:
        with self._turn(deadline) as talk:
            power = talk.power(deadline)
            if power in (Power.WARMING, Power.COOLING):
                return ProjectorStatus(power)  # one that is busy with its lamp is asked only for its power
            trouble = talk.optional("ERST", pjlink.parse_errors, deadline) or ()
            if power is Power.FAULT and not trouble:
                trouble = ("projector-failed",)
            failed = any(not word.endswith("-warning") for word in trouble)
            hours = self._habits.counted("LAMP", power, partial(self._hours, talk), deadline)
            return ProjectorStatus(Power.FAULT if failed and power is Power.OFF else power, trouble, hours)

    def _hours(self, talk: PjLinkConversation, deadline: Deadline) -> int | None:
        lamps = talk.optional("LAMP", pjlink.parse_lamps, deadline) or ()
        return max((lamp.hours for lamp in lamps), default=None)

    def adjustments(self, *, deadline: Deadline) -> dict[str, str]:
        """As ``hal.interfaces.AdjustedProjector.adjustments``: PJLink has only the input."""
        with self._turn(deadline) as talk:
            if talk.power(deadline) is not Power.ON:
                return {}
            reply = talk.optional("INPT", pjlink.parse_input, deadline)
            return {} if reply is None else {"input": reply}

    def switch_on(self, *, deadline: Deadline) -> None:
        with self._turn(deadline) as talk:
            power = talk.power(deadline)
            if power is Power.COOLING:
                raise self._refused("projector-cooling", "is still cooling its lamp and was not switched on")
            if power is Power.OFF:
                self._command(talk, "POWR", "1", "switch on", deadline, lambda: talk.power(deadline) is Power.OFF)
        if power is Power.OFF:
            self._confirm((Power.ON, Power.WARMING), "on", deadline)

    def switch_off(self, *, deadline: Deadline) -> None:
        with self._turn(deadline) as talk:
            lit, power = (Power.ON, Power.WARMING), None
            with contextlib.suppress(DeviceBusy):
                power = talk.power(deadline)
            if power in (Power.OFF, Power.COOLING) and self._habits.unavailable_since_s is None:
                return
            try:
                self._command(talk, "POWR", "0", "switch off", deadline, lambda: talk.power(deadline) in lit)
            except DeviceRefused:
                if power in (Power.OFF, Power.COOLING, Power.FAULT):
                    return  # what it does not say for certain
                raise
        self._confirm((Power.OFF, Power.COOLING, Power.FAULT), "off", deadline)

    def set_shutter(self, closed: bool, *, deadline: Deadline) -> None:
        with self._turn(deadline) as talk:

            def is_open() -> bool:
                reply = talk.query("AVMT", deadline)
                if isinstance(reply, Failure):
                    raise talk.no_answer()
                return pjlink.parse_mute(reply).video is not closed

            reply = self._sent(talk, "AVMT", f"{self._habits.mute}{closed:d}", deadline, is_open)
            if reply in (Failure.PARAMETER, Failure.UNDEFINED):
                # Some projectors mute picture and sound together or not at all.
                other = "3" if self._habits.mute == "1" else "1"
                reply = self._sent(talk, "AVMT", f"{other}{closed:d}", deadline, is_open)
                if isinstance(reply, str):
                    self._habits.mute = other
            if not self._accepted(reply, "move its shutter") and is_open():
                raise talk.no_answer()

    def notices(self) -> list[Notice]:
        """As ``hal.interfaces.WatchedProjector.notices``."""
        return self._habits.notices()

    def close(self) -> None:
        self._talk.close()

    def _command(
        self, talk: PjLinkConversation, name: str, parameter: str, doing: str, deadline: Deadline,
        unchanged: Callable[[], bool],
    ) -> bool:  # fmt: skip
        """Send a command as ``_sent``; False if its answer was lost (it may have worked: look at the state)."""
        return self._accepted(self._sent(talk, name, parameter, deadline, unchanged), doing)

    def _sent(
        self, talk: PjLinkConversation, name: str, parameter: str, deadline: Deadline, unchanged: Callable[[], bool]
    ) -> str | Failure | None:
        """Send a command, and return its answer; None if that was lost.

        It is sent a second time in one case only: the connection was used before, was closed without an answer, and
        the state is ``unchanged``. Then the projector had closed it after the previous answer, and never read this.
        """
        try:
            return talk.set(name, parameter, deadline)
        except DeviceTimeout:
            if deadline.passed:
                raise
            return None
        except DeviceGone:
            if deadline.passed:
                raise
            if not talk.reused:
                return None
        with contextlib.suppress(DeviceBusy, DeviceTimeout, DeviceGone, ProtocolError):
            if unchanged():
                return talk.set(name, parameter, deadline)
        return None

    def _accepted(self, reply: str | Failure | None, doing: str) -> bool:
        if reply is Failure.UNAVAILABLE:
            raise self._refused("projector-not-now", f"refuses to {doing} in its present state")
        if isinstance(reply, Failure):
            raise self._refused("projector-refused", f"cannot {doing}: it answered {reply.value}")
        if reply is not None:
            pjlink.accepted(reply)
        return reply is not None

    def _confirm(self, wanted: tuple[Power, ...], word: str, deadline: Deadline) -> None:
        """Wait until the power state shows the effect of a command, even if its answer was lost."""
        patience = deadline.within(self._timing.confirm_s)
        while not self._shows(wanted, patience):
            if patience.passed:
                raise DeviceTimeout(
                    f"projector-not-{word}",
                    what=f"The projector at {self._name} did not switch {word}.",
                    remedy="Check its indicator lights. If it shows no fault, switch it once with its own button.",
                )
            patience.sleep(self._timing.boot_interval_s)

    def _shows(self, wanted: tuple[Power, ...], deadline: Deadline) -> bool:
        try:
            with self._turn(deadline) as talk:
                return talk.power(deadline) in wanted
        except (DeviceBusy, DeviceTimeout, DeviceGone):
            # A starting projector may not answer for a while.
            self._talk.check_open()
            return False

    def _refused(self, code: str, doing: str) -> DeviceRefused:
        return DeviceRefused(
            code,
            what=f"The projector at {self._name} {doing}.",
            remedy="Wait until it has cooled and shows standby. If it reports a fault, correct that first.",
        )

    @contextlib.contextmanager
    def _turn(self, deadline: Deadline) -> Iterator[PjLinkConversation]:
        """One caller at a time, none after ``close``."""
        check = partial(self._talk.check, deadline)
        check()
        with turn(self._lock, deadline, check):
            self._talk.check_open()
            yield self._talk


def _settings(settings: Mapping[str, Any], context: OpenContext) -> tuple[str, int, str | None, ProjectorProfile]:
    """Host, port, password and profile of a stage.toml table. Raises PluginError and ProtocolError."""
    host, port = host_and_port(str(setting(settings, "address", str)), pjlink.PORT)
    password = setting(settings, "password", str)
    if password is not None and not 0 < len(password) <= pjlink.LONGEST_PASSWORD:
        raise PluginError(
            "setting-wrong",
            what=f"The password has {len(password)} characters; PJLink allows 1 to {pjlink.LONGEST_PASSWORD}.",
            remedy="Correct password in stage.toml, or remove it.",
        )
    return host, port, password, load_profile(setting(settings, "profile", str, "pjlink"), context.stage)


def open_pjlink_projector(settings: Mapping[str, Any], context: OpenContext, deadline: Deadline) -> PjLinkProjector:
    """Open the projector of a stage.toml table; see ``DRIVER`` for the settings."""
    host, port, password, profile = _settings(settings, context)
    transcript = context.transcript("pjlink", f"{host}-{port}", secret=password or "")
    projector = PjLinkProjector(
        lambda until: TcpLink(host, port, deadline=until, transcript=transcript),
        profile,
        name=str(settings["address"]),
        password=password,
    )
    projector.open(deadline)
    return projector


DRIVER = Driver(
    kind="projector",
    name="pjlink",
    summary="Projectors on the network with PJLink, class 1 or 2.",
    open=open_pjlink_projector,
    settings={
        "address": 'host:port, or only host for port 4352, e.g. "192.168.0.20"',
        "password": "the PJLink password, if the projector has one",
        "profile": "times of its lamp: pjlink (the default), or a .toml file of the stage",
    },
    required=("address",),
    check=_settings,
)
