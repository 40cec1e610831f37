"""Projectors on the network, by real datagrams and connections."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from hal.deadline import in_seconds
from hal.finding import Found, Known, SearchScope
from lab.emulated.projectors.pjlink import EmulatedPjLinkProjector
from plugins.emulated.projectors.lamp import EmulatedLamp, LampTiming
from plugins.finding import network


def look(folder: Path, *known: dict[str, Any]) -> list[Found]:
    wanted = SearchScope(folder, tuple(Known("projector", "pjlink", table) for table in known), search=None)
    return list(network.find(wanted, in_seconds(20)))


def test_a_projector_of_the_stage_is_asked_who_it_is_and_not_switched(tmp_path: Path) -> None:
    lamp = EmulatedLamp(LampTiming(0.1, 0.1))
    with EmulatedPjLinkProjector(lamp, password="secret") as projector:
        (found,) = look(tmp_path, {"address": projector.address, "password": "secret"})
    assert found.problems == ()
    assert found.what.startswith("PJLink projector, Velatura")
    assert lamp.strikes == 0


@pytest.mark.parametrize("password", ["wrong", None])
def test_a_wrong_password_is_named(tmp_path: Path, password: str | None) -> None:
    with EmulatedPjLinkProjector(EmulatedLamp(LampTiming(0.1, 0.1)), password="secret") as projector:
        table = {"address": projector.address} | ({} if password is None else {"password": password})
        (found,) = look(tmp_path, table)
    (problem,) = found.problems
    assert "password" in problem.what
    assert problem.remedy


def test_nobody_at_the_address_is_named(tmp_path: Path) -> None:
    with EmulatedPjLinkProjector(EmulatedLamp(LampTiming(0.1, 0.1))) as projector:
        address = projector.address
    (found,) = look(tmp_path, {"address": address})
    assert [problem.code for problem in found.problems] == ["link-lost"]
