"""The settings of the MQTT broker."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from controller.core.errors import UsageError
from controller.kiosk.panel_address import is_loopback


@dataclass(frozen=True, slots=True)
class BrokerOptions:
    """The address of the broker. ``password_file`` contains only the password, so that no settings and no export do.

    ``topic``: the first part of all topics; ``tls``: the connection is encrypted; ``certificates``: the certificate
    authorities (PEM) for it, None: those of this computer;
    ``discovery``: Home Assistant's discovery prefix, empty if it is not to find the stage.
    """

    host: str
    port: int = 1883
    topic: str = "velatura"
    username: str | None = None
    password_file: Path | None = None
    certificates: Path | None = None
    discovery: str = ""
    tls: bool = False

    @property
    def encrypted(self) -> bool:
        return self.tls or self.certificates is not None


def check_broker(options: BrokerOptions) -> None:
    """Raises UsageError("mqtt-topic-wrong"), and ("mqtt-password-without-tls"): passwords must not cross a network
    unencrypted.
    """
    if set("+#\0") & set(options.topic + options.discovery):
        raise UsageError(
            "mqtt-topic-wrong", what="An MQTT topic must not contain + or #.", remedy="Choose another name for it."
        )
    if options.password_file is None or options.encrypted or is_loopback(options.host):
        return
    raise UsageError(
        "mqtt-password-without-tls",
        what=f"The password for the MQTT broker {options.host} would be sent without TLS.",
        remedy="Use mqtts:// or --mqtt-certificates, or a broker on this computer.",
    )
