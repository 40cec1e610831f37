"""Serial ports, and the projectors that answer there.

Each port gets the power query of every shipped profile, one after the other: only queries, never commands, not more
often than the profile allows. Without an answer at the usual rate, other rates are tried if stage.toml has the port,
or if the answer was not understood. Ports are searched in parallel.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from serial.tools import list_ports

from hal.codecs.projectors.profiles import ProjectorProfile
from hal.codecs.projectors.serial_protocol import Answer, Reply, parse_line, query_bytes
from hal.codecs.projectors.serial_table import Query, SerialTable
from hal.codecs.ptp.values import printable
from hal.deadline import Deadline
from hal.errors import DeviceBusy, DeviceError, DeviceGone, DeviceTimeout, ProtocolError
from hal.finding import Finder, Found, SearchScope
from hal.notices import Notice
from hal.serial_link import SerialLink
from plugins.finding.access import forbidden, holders
from plugins.projectors.network.device_server import is_url
from plugins.projectors.profile_files import load_profile, shipped_profiles
from plugins.projectors.serial_conversation import read_message

RULES: Final = "70-velatura-serial.rules"
WRITE_S: Final = 1.0
END: Final = b"\r"
BAUDS: Final = (9600, 19200, 38400, 57600, 115200)
MOST_PORTS: Final = 64
AT_ONCE: Final = 8
SLOW: Final = 3
LISTENED: Final = 3
"""A device that sends data unasked in so many waits is not a projector at a wrong rate."""


@dataclass(frozen=True, slots=True)
class Port:
    """A port by its most stable name. ``settings``: its table in stage.toml, None if it has none."""

    name: str
    path: Path
    what: str
    settings: Mapping[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class Heard:
    """The profile that answered and its baud rate (None: no answer), whether any data came, and came unasked."""

    profile: ProjectorProfile | None
    baud: int = 0
    anything: bool = False
    unasked: bool = False


def find(wanted: SearchScope, deadline: Deadline) -> Sequence[Found]:
    """Every serial port of this machine and of stage.toml."""
    profiles = [load_profile(name, wanted.stage) for name in shipped_profiles()]
    profiles = [profile for profile in profiles if profile.serial is not None and profile.serial.baud]
    with ThreadPoolExecutor(AT_ONCE, thread_name_prefix="ports") as pool:
        return list(pool.map(lambda port: _found(port, wanted, profiles, deadline), _ports(wanted)))


def _ports(wanted: SearchScope) -> list[Port]:
    """Each port once, although it has many names: first by its name in stage.toml, then by its stable name."""
    ports: dict[str, Port] = {}
    for settings in wanted.of("projector", "serial"):
        name = str(settings.get("port", ""))
        if is_url(name):
            continue  # behind a device server: it is tested by its driver
        path = wanted.stage / name
        ports[str(path.resolve())] = Port(name, path, "named in stage.toml", settings)
    with contextlib.suppress(OSError):
        for path in sorted(wanted.serial_ports.iterdir()):
            if not path.is_symlink() and not path.is_char_device():
                continue  # such as the lock of a link to a pseudo terminal
            ports.setdefault(str(path.resolve()), Port(str(path), path, "serial adapter"))
    for listed in list_ports.comports() if wanted.system_ports else ():
        # Ports of a missing board have no hardware number.
        if listed.hwid != "n/a":
            path = Path(listed.device)
            ports.setdefault(str(path.resolve()), Port(listed.device, path, printable(listed.description or "port")))
    return list(ports.values())[:MOST_PORTS]


def _found(port: Port, wanted: SearchScope, profiles: Sequence[ProjectorProfile], deadline: Deadline) -> Found:
    problem = forbidden(port.path, "serial port", RULES, "tty") if port.path.exists() else None
    if problem is not None:
        return Found("serial", port.name, port.what, identity=port.name, problems=(problem,))
    try:
        own = None if port.settings is None else load_profile(str(port.settings.get("profile", "")), wanted.stage)
        return _asked(port, own, profiles, wanted.answer_s, deadline)
    except DeviceBusy as busy:
        who = ", ".join(holders(port.path))
        held = Notice.warning("port-taken", f"{port.name} is in use{f' by {who}' if who else ''}.", busy.remedy)
        return Found("serial", port.name, port.what, identity=port.name, problems=(held,))
    except DeviceError as error:
        return Found("serial", port.name, port.what, identity=port.name, problems=(Notice.of(error),))


def _asked(
    port: Port, own: ProjectorProfile | None, profiles: Sequence[ProjectorProfile], answer_s: float, deadline: Deadline
) -> Found:
    settings = port.settings or {}
    written = int(settings.get("baud", own.serial.baud if own is not None and own.serial is not None else 0))
    heard = _who(port, _order(own, written, profiles), answer_s, deadline)
    if heard.profile is None and heard.anything and not heard.unasked:
        # A device is there: an adapter or a computer under load may only have been slow.
        usual = ((baud, known, only_if) for baud, known, only_if in _order(own, written, profiles) if not only_if)
        heard = _who(port, usual, SLOW * answer_s, deadline)
        heard = replace(heard, anything=True)
    if heard.profile is None:
        return _nobody(port, own, heard, written)
    profile, baud = heard.profile, heard.baud
    assert profile.serial is not None
    table: dict[str, Any] = {"profile": settings.get("profile", profile.name), "port": port.name}
    if baud != profile.serial.baud or (own is not None and baud != written):
        table["baud"] = baud
    problems = []
    if own is not None and profile.name != own.name:
        table["profile"] = profile.name
        problems.append(
            Notice.warning(
                "serial-other-profile",
                f'The projector at {port.name} needs the profile "{profile.name}", but stage.toml has "{own.name}".',
                f'Write profile = "{profile.name}" for {port.name} into stage.toml.',
            )
        )
    elif own is not None and baud != written:
        problems.append(
            Notice.warning(
                "serial-wrong-baud",
                f"The projector at {port.name} answers at {baud} baud, but stage.toml has {written}.",
                f"Write baud = {baud} for {port.name} into stage.toml, or set {written} in the projector's menu.",
            )
        )
    what = f"projector, {profile.maker} ({profile.name}), {baud} baud"
    return Found("serial", port.name, what, "projector", "serial", table, port.name, tuple(problems))


def _nobody(port: Port, own: ProjectorProfile | None, heard: Heard, written: int) -> Found:
    if own is None and not heard.anything:
        return Found("serial", port.name, f"{port.what}, no answer", identity=port.name)
    code, remedy = (
        "serial-no-answer",
        "Check the projector's power, the cable (it may need a null modem cable), and the profile.",
    )
    what = f"Nothing at {port.name} answers to any profile at any usual baud rate."
    if heard.anything:
        code = "serial-garbage"
        what = f"A device at {port.name} answers, but no profile fits at any usual baud rate."
        remedy = "If it is a projector, write a profile for it (docs/how-to/projector-profile.md)."
    return Found("serial", port.name, port.what, identity=port.name, problems=(Notice.warning(code, what, remedy),))


def _order(
    own: ProjectorProfile | None, written: int, profiles: Sequence[ProjectorProfile]
) -> Iterator[tuple[int, Sequence[ProjectorProfile], bool]]:
    """Rates with the profiles to try there; True: only if data came back, or stage.toml has a profile."""
    if own is not None:
        yield written, [own], False
    usual: dict[int, list[ProjectorProfile]] = {}
    # Last those whose queries do not end in a carriage return: other devices wait for the rest of such a line.
    for profile in sorted(profiles, key=lambda profile: not _question(profile)[1].endswith(END)):
        if profile.serial is not None:
            usual.setdefault(profile.serial.baud, []).append(profile)
    yield from ((baud, known, False) for baud, known in usual.items())
    for baud in BAUDS:
        others = [profile for profile in profiles if profile.serial is not None and profile.serial.baud != baud]
        yield baud, others if own is None else [own], True


def _who(
    port: Port, order: Iterable[tuple[int, Sequence[ProjectorProfile], bool]], answer_s: float, deadline: Deadline
) -> Heard:
    anything, listened, named = False, False, port.settings is not None
    for baud, profiles, only_if in order:
        if only_if and not (anything or named):
            continue
        try:
            link = SerialLink(port.path, baud=baud, deadline=deadline)
        except DeviceGone:
            if port.path.exists():
                continue  # a rate that this adapter does not have
            raise
        try:
            if only_if and anything and not listened:
                listened = True
                if _speaks_unasked(link, answer_s, deadline):
                    return Heard(None, anything=True, unasked=True)
            # Queries at another rate arrived as noise: it must not be on the same line as the first query.
            link.write(END, deadline=deadline.within(WRITE_S))
            for profile in profiles:
                answered, came = _answers(link, profile, answer_s, deadline)
                anything |= came
                if answered:
                    return Heard(profile, baud, True)
        finally:
            link.close()
    return Heard(None, anything=anything)


def _speaks_unasked(link: SerialLink, answer_s: float, deadline: Deadline) -> bool:
    """Whether data comes all the time, without a query."""
    link.drain()
    for _ in range(LISTENED):
        deadline.sleep(answer_s)
        if not link.drain():
            return False
    return True


def _answers(link: SerialLink, profile: ProjectorProfile, answer_s: float, deadline: Deadline) -> tuple[bool, bool]:
    """Send one query of a profile; whether its answer is valid, and whether any data came."""
    table = profile.serial
    assert table is not None
    query, said = _question(profile)
    deadline.sleep(profile.timing.interval_s)
    came = bool(link.drain())
    link.write(said, deadline=deadline.within(WRITE_S))
    patience = deadline.within(answer_s)
    while True:
        try:
            line = _line(link, table, patience)
        except DeviceTimeout:
            deadline.check(
                "doctor-too-slow", what="The search took too long.", remedy="Unplug devices that are not needed."
            )
            if not said.endswith(END):
                link.write(END, deadline=deadline.within(WRITE_S))  # the next query starts on a new line
            return False, came or bool(link.drain())
        came = True
        with contextlib.suppress(ProtocolError):
            meaning = parse_line(table, line, query, sent=said)
            if isinstance(meaning, Answer) or meaning is Reply.COOLING:
                return True, True


def _question(profile: ProjectorProfile) -> tuple[Query, bytes]:
    """The query for the power state, or another one if a family has none, and its bytes."""
    table = profile.serial
    assert table is not None
    query = table.queries["power"] if "power" in table.queries else next(iter(table.queries.values()))
    return query, query_bytes(table, query, table.address)


def _line(link: SerialLink, table: SerialTable, deadline: Deadline) -> bytes:
    """The next message, or other data."""
    try:
        return read_message(link, table, deadline)
    except ProtocolError:
        return link.drain()


FINDER: Final = Finder("serial", find)
