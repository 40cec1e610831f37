"""Where the broker of a building's control is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class BrokerOptions:
    """Where the broker is. ``password_file`` holds the password and nothing else: it stands in no settings and no
    export.

    ``topic`` the first part of all topics; ``certificates`` the authorities (PEM) with which the broker's TLS is
    checked.
    """

    host: str
    port: int = 1883
    topic: str = "velatura"
    username: str | None = None
    password_file: Path | None = None
    certificates: Path | None = None
