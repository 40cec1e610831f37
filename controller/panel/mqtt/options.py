"""The settings of the MQTT broker."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class BrokerOptions:
    """The address of the broker. ``password_file`` contains only the password, so that no settings and no export do.

    ``topic``: the first part of all topics; ``certificates``: the certificate authorities (PEM) for the broker's TLS.
    """

    host: str
    port: int = 1883
    topic: str = "velatura"
    username: str | None = None
    password_file: Path | None = None
    certificates: Path | None = None
