"""Somebody with a browser, at another computer in the network of a booted kiosk."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from playwright.sync_api import Page

from tests.booted.machine import ADDRESS, Machine
from tests.controller.panel.browser import CHROMIUM, chromium, tab

PANEL: Final = f"https://{ADDRESS}:8377"
_CABLE: Final = """
ip netns add visitor
ip link add port0 type veth peer name eth0 netns visitor
ip link set port0 master net0 up
ip -n visitor address add 192.0.2.8/24 dev eth0
ip -n visitor link set eth0 up
"""
"""From a network with another computer alone in it to the machine's; the machine's net0 is a switch."""


@contextmanager
def visiting(machine: Machine, folder: Path) -> Iterator[Page]:
    """A page of this computer's Chromium, which has the visitor's network and no other. ``folder``: an empty one."""
    machine.call("sh", "-ec", _CABLE)
    program = folder / "chromium"
    network = machine.seen_here(Path("/run/netns/visitor"))
    program.write_text(f'#!/bin/sh\nexec nsenter --net={network} {CHROMIUM} "$@"\n')
    program.chmod(0o755)
    # The certificate is the kiosk's own, of which a visitor is warned.
    with chromium("--ignore-certificate-errors", program=program) as browser, tab(browser, PANEL) as page:
        yield page
    machine.call("ip", "netns", "delete", "visitor")
