"""Somebody with a browser, at another computer in the network of a booted kiosk."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from playwright.sync_api import Error, Page, expect

from tests.booted.kiosk import Kiosk
from tests.booted.machine import ADDRESS, STAGE, Machine
from tests.controller.panel.browser import CHROMIUM, chromium, tab

PANEL: Final = f"https://{ADDRESS}:8377"
_CABLE: Final = """
ip netns add visitor
ip link add port0 type veth peer name eth0 netns visitor
ip link set port0 master net0 up
ip -n visitor address add 192.0.2.8/24 dev eth0
ip -n visitor link set eth0 addrgenmode none up
"""
"""From a network with another computer alone in it to the machine's; the machine's net0 is a switch.

No address comes by itself: Chromium gives up a page when one does, a second after the cable is in.
"""
_FETCH: Final = """async ([path, authorization]) => {
  const answer = await fetch(path, {headers: {authorization}, credentials: "omit"});
  return [answer.status, await answer.text()];
}"""


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


def log_in(page: Page, password: str) -> None:
    page.goto("/login")
    page.get_by_label("Name").fill("technician")
    page.get_by_label("Password").fill(password)
    page.get_by_role("button", name="Log in").click()


def _opened(page: Page) -> bool:
    """The first page, where the panel listens: a service that starts answers its commands first."""
    with contextlib.suppress(Error):
        page.goto("/")
        return True
    return False


def check_damaged_settings(kiosk: Kiosk, page: Page) -> None:
    """A damaged stage.toml at the start: the last good settings give picture and panel, and the line is shown."""
    machine, described = kiosk.machine, kiosk.machine.at(STAGE / "stage.toml")
    good = described.read_text()
    shown = page.locator("p.warning", has_text="last good settings")
    described.write_text(f"{good}[[projectors\n")
    try:
        machine.call("systemctl", "kill", "--kill-whom=main", "--signal=KILL", "velatura-controller")
        machine.wait_for(lambda: kiosk.answers() and kiosk.status()["warnings"])
        machine.wait_for(lambda: _opened(page))
        line = good.count("\n") + 1
        expect(shown).to_contain_text(f"line {line}")
        assert kiosk.shows()
    finally:
        described.write_text(good)
    machine.wait_for(lambda: kiosk.answers() and not kiosk.status()["warnings"])
    machine.wait_for(lambda: kiosk.state == "playing")
    expect(shown).to_be_hidden()


def check_guessed_tokens(kiosk: Kiosk, page: Page) -> None:
    """A program that guesses, and one with a good token, at the same address."""
    made = kiosk.machine.call(
        "velatura", "kiosk", "account", "add-token", STAGE, "robot", "--role", "viewer", user="velatura"
    )
    token = re.search(r"velatura_[\w-]+", made)
    assert token is not None, made

    def answer(path: str, secret: str) -> tuple[int, str]:
        status, text = page.evaluate(_FETCH, [path, f"Bearer {secret}"])
        return int(status), str(text)

    assert {answer("/api/v1/state", "velatura_guess")[0] for _ in range(25)} == {401, 429}
    status, state = answer("/api/v1/state", token[0])
    assert (status, json.loads(state)["state"]) == (200, "playing")
    free = re.search(r"^velatura_disk_free_bytes\S* (\S+)$", answer("/metrics", token[0])[1], re.MULTILINE)
    assert free is not None
    assert float(free[1]) > 0
