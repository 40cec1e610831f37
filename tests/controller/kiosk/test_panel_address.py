"""The address of the panel for people, and the lines that the projectors show."""

from __future__ import annotations

import ipaddress
import stat
from pathlib import Path

import pytest

from controller.kiosk import panel_address
from controller.kiosk.panel_address import PanelAccess, addresses, keep_first_login, own_addresses


def test_what_this_computer_alone_reaches_is_no_address_of_its_own() -> None:
    assert not [one for one in own_addresses() if ipaddress.ip_address(one).is_loopback]


def test_a_panel_that_listens_everywhere_has_an_address_in_every_network(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(panel_address, "own_addresses", lambda: ("192.0.2.7", "198.51.100.3"))
    assert addresses("https://0.0.0.0:8377/") == ("https://192.0.2.7:8377/", "https://198.51.100.3:8377/")
    assert addresses("http://127.0.0.1:8377/") == ("http://127.0.0.1:8377/",)


def test_the_password_is_shown_until_somebody_has_one_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    entered = False
    entrance = PanelAccess("https://0.0.0.0:8377/", ("technician", "abcd"), lambda: entered)
    monkeypatch.setattr(panel_address, "own_addresses", lambda: ("192.0.2.7",))
    assert entrance.lines() == ("velatura", "https://192.0.2.7:8377/", "technician", "abcd")
    entered = True
    assert entrance.lines() == ("velatura", "https://192.0.2.7:8377/")
    monkeypatch.setattr(panel_address, "own_addresses", tuple)
    assert entrance.lines() == ("velatura", "connect this computer to a network")


def test_the_kept_password_is_for_its_user_alone(tmp_path: Path) -> None:
    keep_first_login(tmp_path, "technician", "abcd")
    kept = tmp_path / panel_address.FIRST_LOGIN
    assert (kept.read_text(), stat.S_IMODE(kept.stat().st_mode)) == ("technician abcd\n", 0o600)
