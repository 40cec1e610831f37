"""The device and its driver."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, TypeVar

from acme_light.protocol import END, LONGEST, PORT, parse_identity, parse_lux
from hal.deadline import Deadline
from hal.errors import DeviceGone
from hal.links import TcpLink, host_and_port
from hal.registry import Driver, OpenContext, setting
from hal.values import DeviceIdentity

Value = TypeVar("Value")


class AcmeLight:
    """``hal.interfaces.LightSensor``; one connection a question, so that no answer is ever stale."""

    def __init__(self, host: str, port: int) -> None:
        self._host, self._port = host, port
        self._closed = False

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        model, serial = self._ask(b"ID?", parse_identity, deadline)
        return DeviceIdentity("Acme", model, serial)

    def illuminance_lux(self, *, deadline: Deadline) -> float:
        lux: float = self._ask(b"LUX?", parse_lux, deadline)
        return lux

    def close(self) -> None:
        self._closed = True

    def _ask(self, question: bytes, parse: Callable[[bytes], Value], deadline: Deadline) -> Value:
        if self._closed:
            raise DeviceGone("acme-light-closed", what="The light post was closed.", remedy="Open it again.")
        link = TcpLink(self._host, self._port, deadline=deadline)
        try:
            link.write(question + END, deadline=deadline)
            return parse(link.read_until(END, limit=LONGEST, deadline=deadline))
        finally:
            link.close()


def open_acme_light(settings: Mapping[str, Any], context: OpenContext, deadline: Deadline) -> AcmeLight:
    """Open the light post of a stage's table; it must answer."""
    sensor = AcmeLight(*host_and_port(setting(settings, "address", str), PORT))
    sensor.identity(deadline=deadline)
    return sensor


DRIVER: Final = Driver(
    kind="light_sensor",
    name="acme-light",
    summary="Acme's light posts on the network.",
    open=open_acme_light,
    settings={"address": "host:port of the light post (default port 5900)"},
    required=("address",),
)
