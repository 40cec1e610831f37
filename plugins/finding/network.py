"""Projectors and cameras on the network: PJLink's search, and the addresses in stage.toml."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Final

from hal.codecs.projectors.pjlink import PORT
from hal.deadline import Deadline
from hal.errors import DeviceError
from hal.finding import Finder, Found, SearchScope
from hal.links import host_and_port
from hal.notices import Notice
from hal.registry import OpenContext
from plugins.projectors.pjlink import open_pjlink_projector
from plugins.projectors.pjlink_listener import PjLinkListener

ANSWER_S: Final = 8.0


def find(wanted: SearchScope, deadline: Deadline) -> Sequence[Found]:
    """Projectors that answer the search (class 2), and those in stage.toml (any class)."""
    known = {str(settings.get("address", "")): settings for settings in wanted.of("projector", "pjlink")}
    found = [_tried(address, settings, wanted, deadline) for address, settings in known.items()]
    hosts = {host for address in known if (host := _host(address))}
    try:
        answers = _searched(wanted, deadline)
    except DeviceError as error:
        problem = Notice.of(error)
        return [*found, Found("network", "PJLink search", "search for projectors", problems=(problem,))]
    for host, mac in answers:
        if host in hosts:
            found = [
                dataclasses.replace(device, identity=mac) if _host(device.address) == host else device
                for device in found
            ]
        else:
            found.append(dataclasses.replace(_tried(host, {"address": host}, wanted, deadline), identity=mac))
    return found


def _searched(wanted: SearchScope, deadline: Deadline) -> list[tuple[str, str]]:
    if wanted.search is None:
        return []
    with PjLinkListener(*wanted.listen) as listener:
        answers = listener.search(deadline=deadline, to=wanted.search, patience_s=wanted.search_s)
        return [(answer.host, answer.mac) for answer in answers]


def _tried(address: str, settings: Mapping[str, Any], wanted: SearchScope, deadline: Deadline) -> Found:
    table = {"address": address, **{key: value for key, value in settings.items() if key in ("password", "profile")}}
    found = Found("network", address, "PJLink projector", "projector", "pjlink", table)
    try:
        projector = open_pjlink_projector(table, OpenContext(wanted.stage), deadline.within(ANSWER_S))
    except DeviceError as error:
        return dataclasses.replace(found, problems=(Notice.of(error),))
    with contextlib.closing(projector):
        try:
            identity = projector.identity(deadline=deadline.within(ANSWER_S))
        except DeviceError as error:
            return dataclasses.replace(found, problems=(Notice.of(error),))
    return dataclasses.replace(found, what=f"PJLink projector, {identity.maker} {identity.model}")


def _host(address: str) -> str:
    with contextlib.suppress(DeviceError):
        return host_and_port(address, PORT)[0]
    return ""


FINDER: Final = Finder("network", find)
