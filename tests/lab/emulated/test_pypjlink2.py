"""The emulated PJLink projector against another client by other authors (pypjlink2)."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import pytest
from pypjlink import MUTE_VIDEO
from pypjlink import Projector as PyPjLink
from pypjlink.projector import ProjectorError

from lab.emulated.projectors.pjlink import EmulatedPjLinkProjector
from plugins.emulated.projectors.lamp import EmulatedLamp, LampTiming


@contextlib.contextmanager
def client(emulator: EmulatedPjLinkProjector) -> Iterator[Any]:
    """A connection of pypjlink2, not yet authenticated."""
    host, port = emulator.address.split(":")
    link = PyPjLink.from_address(host, int(port), timeout=20)
    try:
        yield link
    finally:
        link.close()


def test_it_switches_the_lamp_and_hears_the_refusal_while_that_cools() -> None:
    lamp = EmulatedLamp(LampTiming(0.0, 30.0))
    with EmulatedPjLinkProjector(lamp) as emulator, client(emulator) as link:
        assert link.authenticate() is None
        assert link.get_power() == "off"
        link.set_power("on")
        assert link.get_power() == "on"
        link.set_power("off")
        assert link.get_power() == "cooling"
        with pytest.raises(ProjectorError):
            link.set_power("on")
    assert lamp.strikes == 1


def test_it_reads_and_sets_everything_it_knows() -> None:
    lamp = EmulatedLamp(LampTiming(0.0, 5.0), hours=321.0)
    lamp.warm_now()
    with EmulatedPjLinkProjector(lamp, name="left") as emulator, client(emulator) as link:
        link.authenticate()
        link.set_mute(MUTE_VIDEO, True)
        assert link.get_mute() == (True, False)
        link.set_input("DIGITAL", 2)
        assert link.get_input() == ("DIGITAL", 2)
        assert ("DIGITAL", 2) in link.get_inputs()
        assert link.get_lamps() == [(321, True)]
        assert (link.get_manufacturer(), link.get_name()) == ("Velatura", "left")
        assert set(link.get_errors().values()) == {"ok"}
    assert lamp.light_level() == 0.0


def test_its_password_is_checked() -> None:
    with EmulatedPjLinkProjector(EmulatedLamp(LampTiming(0.0, 0.0)), password="JBMIAProjectorLink") as emulator:
        with client(emulator) as link:
            assert link.authenticate("JBMIAProjectorLink") is True
            assert link.get_power() == "off"
        with client(emulator) as link:
            assert link.authenticate("wrong") is False
