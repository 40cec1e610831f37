"""The table ``network`` of a projector profile: the projector's own LAN port."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from hal.codecs.projectors.logins import LOGINS
from hal.codecs.projectors.toml_table import Table

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
