"""Device profiles of projector families, as validated values (``firmware_configs/``). A profile has a table of serial
commands, a table ``network`` for the projector's own LAN port, or both.

Words for faults: a word that ends in ``-warning`` (``lamp-hours-warning``) needs attention later; any other
(``lamp-failed``, ``over-temperature``, ``fan-failed``, ``cover-open``) means that the projector can't work.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from hal.codecs.projectors.logins import LOGINS
from hal.codecs.projectors.serial_table import MAY_BE_UNKNOWN, SerialTable, parse_serial
from hal.codecs.projectors.toml_table import Table, parse_toml
from hal.values import LampRules

LONGEST_PASSWORD: Final = {"escvpnet": 16, "jvc": 64, "ntcontrol": 64, "adcp": 64}
"""Characters of a password, by login."""


@dataclass(frozen=True, slots=True)
class NetworkTable:
    """``port``: TCP port; ``login``: what comes before the commands (``hal.codecs.projectors.logins``);
    ``user``: the usual account, for logins that have accounts."""

    port: int
    login: str
    user: str = ""


def parse_network(table: Table) -> NetworkTable:
    """Read the table. Raises ProtocolError("profile-wrong")."""
    made = NetworkTable(
        port=table.integer("port", 1, 65_535),
        login=table.choice("login", LOGINS, "none"),
        user=table.string("user", ""),
    )
    table.finish()
    return made


_DAY_S: Final = 86_400.0


@dataclass(frozen=True, slots=True)
class Timing:
    """A driver's time limits, in seconds.

    ``answer_s``: until an answer counts as lost; ``late_s``: until a lost answer can no longer arrive late;
    ``command_s``: until a power command is acknowledged; ``confirm_s``: until an accepted power command shows in the
    power state; ``interval_s``, ``boot_interval_s``: shortest time between two questions, ordinarily and while the
    projector starts or cools.
    """

    answer_s: float
    late_s: float
    command_s: float
    confirm_s: float
    interval_s: float
    boot_interval_s: float

    @property
    def question_s(self) -> float:
        """The longest time of a query: waiting after one with a lost answer, and then two answers."""
        return self.boot_interval_s + self.late_s + 2 * self.answer_s

    @property
    def switch_s(self) -> float:
        """The longest time of switching: a query before it, the command, and its confirmation."""
        return 2 * self.question_s + self.command_s + self.confirm_s


@dataclass(frozen=True, slots=True)
class ProjectorProfile:
    """A family of projectors. ``serial`` is None for PJLink; ``network``: its own LAN port, if it takes these commands.

    ``unknown``: commands and queries with unknown codes; the driver refuses calls that need them.
    """

    name: str
    maker: str
    family: str
    source: str
    lamp: LampRules
    timing: Timing
    serial: SerialTable | None
    network: NetworkTable | None = None
    unknown: tuple[str, ...] = ()


def parse_profile(text: str, *, file: str = "profile") -> ProjectorProfile:
    """Read a profile from TOML text.

    Raises
    ------
    ProtocolError("profile-wrong")  naming the key, its line where it has one, and what is allowed
    """
    root = parse_toml(text, file=file)
    head = root.table("profile")
    protocol = head.string("protocol")
    if protocol not in ("serial", "pjlink"):
        raise head.wrong("protocol", f"{protocol!r} is not one of serial, pjlink")
    unknown = head.strings("unknown", ())
    for name in unknown:
        if name not in MAY_BE_UNKNOWN or protocol != "serial":
            raise head.wrong("unknown", f"{name!r} is not one of {', '.join(MAY_BE_UNKNOWN)} of a serial profile")
    profile = ProjectorProfile(
        name=head.string("name"),
        maker=head.string("maker"),
        family=head.string("family"),
        source=head.string("source"),
        lamp=_lamp(root.table("lamp")),
        timing=_timing(root.table("timing")),
        serial=parse_serial(root, unknown) if protocol == "serial" else None,
        network=parse_network(root.table("network")) if protocol == "serial" and root.has("network") else None,
        unknown=unknown,
    )
    head.finish()
    root.finish()
    return profile


def _lamp(table: Table) -> LampRules:
    rules = LampRules(
        warm_up_s=table.seconds("warm_up_s", 0, 3600),
        stable_s=table.seconds("stable_s", 0, _DAY_S),
        cool_down_s=table.seconds("cool_down_s", 0, 3600),
        minimum_off_s=table.seconds("minimum_off_s", 0, _DAY_S),
    )
    if rules.stable_s < rules.warm_up_s:
        raise table.wrong("stable_s", "it must not be less than warm_up_s")
    if rules.minimum_off_s < rules.cool_down_s:
        raise table.wrong("minimum_off_s", "it must not be less than cool_down_s")
    table.finish()
    return rules


def _timing(table: Table) -> Timing:
    timing = Timing(
        answer_s=table.seconds("answer_s", 0.01, 60),
        late_s=table.seconds("late_s", 0.01, 120),
        command_s=table.seconds("command_s", 0.01, 300),
        confirm_s=table.seconds("confirm_s", 0.01, 300),
        interval_s=table.seconds("interval_s", 0, 60),
        boot_interval_s=table.seconds("boot_interval_s", 0, 60),
    )
    if timing.late_s < timing.answer_s:
        raise table.wrong("late_s", "it must not be less than answer_s")
    if timing.boot_interval_s < timing.interval_s:
        raise table.wrong("boot_interval_s", "it must not be less than interval_s")
    if timing.confirm_s < timing.boot_interval_s:
        raise table.wrong("confirm_s", "it must leave time for one query (boot_interval_s)")
    table.finish()
    return timing
