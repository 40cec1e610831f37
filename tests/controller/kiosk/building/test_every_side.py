"""What each side may ask for: driven by peers by other authors, and held against the table of the how-to page."""

from __future__ import annotations

import asyncio
import contextlib
import csv
import json
import re
import socket
import subprocess
from collections.abc import Callable, Mapping
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import pytest
from aiopjlink import PJLinkERR3

from controller.kiosk.building.osc import message
from controller.kiosk.building.protocol import read, serving
from controller.kiosk.operations.table import OPERATIONS
from controller.kiosk.roles import Role
from hal.values import TECHNICIAN_KEYS
from tests.aiopjlink_client import talk
from tests.controller.kiosk.building.test_osc import liblo
from tests.controller.kiosk.building.test_pjlink import stage
from tests.controller.kiosk.building.test_sacn import desk, to_port
from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.controller.panel.mqtt import test_bridge as mqtt
from tests.controller.panel.served import served
from tests.ports import kept_port
from tests.waiting import eventually, wait_for

PAGE = Path(__file__).parents[4] / "docs" / "how-to" / "show-control.md"
VERBS = {operation.building_verb: operation for operation in OPERATIONS if operation.building_verb}
VALUES: Mapping[str, Mapping[str, Any]] = {
    "play": {"name": "warm wood", "fade_s": 1.5}, "rotate": {}, "next": {"fade_s": 0.5}, "black": {"on": True},
    "pause": {"on": True}, "brightness": {"percent": 40}, "identify": {"on": True}, "close": {}, "open": {},
}  # fmt: skip
"""Each verb with values, in an order in which all are possible."""
FAST = "per_second = 100\n"
Side = Callable[[MemoryKiosk, Path], None]


def table() -> dict[str, set[str]]:
    """The verbs that the page says of each side."""
    head, *rows = re.findall(r"^\| (.*) \|$", PAGE.read_text().split("## What each side may ask for")[1], re.MULTILINE)
    sides = [cell.strip() for cell in head.split("|")][1:]
    found: dict[str, set[str]] = {side: set() for side in sides}
    for row in rows:
        verb, *cells = (cell.strip() for cell in row.split("|"))
        if match := re.fullmatch("`([a-z]+)`", verb):
            for side, cell in zip(sides, cells, strict=True):
                found[side] |= {match[1]} if cell == "yes" else set()
    return found


def done(kiosk: MemoryKiosk) -> set[str]:
    """The verbs that the event log says were done."""
    said = [what.partition("): ")[2] or what.partition(": ")[2] for code, what in kiosk.recorded if code == "done-by"]
    return {verb for verb, operation in VERBS.items() if any(one.startswith(operation.about) for one in said)}


def by_http(kiosk: MemoryKiosk, folder: Path) -> None:
    with served(kiosk, folder / "private") as panel, panel.client() as client:
        headers = panel.token(Role.OPERATOR)
        for verb, values in VALUES.items():
            answer = client.request(VERBS[verb].method, "/api/v1" + VERBS[verb].path, json=values, headers=headers)
            assert answer.is_success, answer.text


def by_mqtt(kiosk: MemoryKiosk, folder: Path) -> None:
    async def story(port: int) -> None:
        async with mqtt.building(port) as (client, heard), mqtt.controlled(kiosk, mqtt.options(folder, port)):
            await mqtt.wait_for(heard, "available", "online")
            for verb, values in VALUES.items():
                await client.publish(f"hall/velatura/command/{verb}", json.dumps(values) if values else None)
                await mqtt.wait_for(heard, "answer", verb)

    with kept_port() as port, mqtt.broker(folder / "broker", port):
        asyncio.run(story(port))


def by_osc(kiosk: MemoryKiosk, folder: Path) -> None:
    kinds: dict[type, str] = {str: "s", float: "f", int: "f", bool: "i"}
    with kept_port() as port:
        (folder / "building.toml").write_text(f"[osc]\nport = {port}\n{FAST}")
        with serving(kiosk, read(folder)):
            for verb, values in VALUES.items():
                # a button that has no value of its own says that it is pressed
                pressed = [] if any(field.required for field in VERBS[verb].fields) else [("i", "1")]
                told = [(kinds[type(one)], str(int(one) if isinstance(one, bool) else one)) for one in values.values()]
                words = ["".join(kind for kind, _ in pressed + told), *(value for _, value in pressed + told)]
                address = ["127.0.0.1", str(port), f"/velatura/{verb}"]

                def send(verb: str = verb, command: list[str] = ["oscsend", *address, *words]) -> bool:  # noqa: B006
                    if verb not in done(kiosk):
                        subprocess.run(command, check=True)
                    return eventually(lambda: verb in done(kiosk), within_s=0.3)

                wait_for(send)


def by_cues(kiosk: MemoryKiosk, folder: Path) -> None:
    soon = datetime.now(ZoneInfo("Europe/Vienna")) + timedelta(seconds=1.5)
    with (folder / "cues.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["time", "verb", "values"])
        for n, (verb, values) in enumerate(VALUES.items()):
            rows.writerow([f"{soon:%H:%M:%S}" if n == 0 else "+0.1", verb, json.dumps(values) if values else ""])
    (folder / "building.toml").write_text(f'[cues]\nfile = "{folder}/cues.csv"\n{FAST}')
    with serving(kiosk, read(folder)):
        wait_for(lambda: len(done(kiosk)) == len(VALUES))


def by_pjlink(kiosk: MemoryKiosk, folder: Path) -> None:
    async def drive(link: Any) -> None:
        sources = link.sources
        for mode, number, *_ in await sources.available_with_names():
            await sources.set(mode, number)
        await link.mute.both(True)
        await link.freeze.set(True)
        await link.power.turn_off()
        await link.power.turn_on()

    with stage(kiosk, folder, more=FAST) as port:
        talk(f"127.0.0.1:{port}", drive)


def by_sacn(kiosk: MemoryKiosk, folder: Path) -> None:
    with kept_port() as port:
        (folder / "building.toml").write_text(f'[sacn]\nport = {port}\nuniverse = 7\nlost = "black"\n')
        with serving(kiosk, read(folder)), to_port(port), desk(port) as sender:
            for first in range(1, 256, 127):
                sender[7].dmx_data = (first, 102, 5)
                eventually(lambda: kiosk.snapshot().in_turn, within_s=0.6)
            wait_for(lambda: done(kiosk) >= {"play", "rotate", "brightness"})
            sender.deactivate_output(7)
            wait_for(lambda: kiosk.snapshot().black)


SIDES: Mapping[str, Any] = {
    "HTTP": by_http,
    "MQTT": pytest.param(by_mqtt, marks=mqtt.pytestmark),
    "OSC": pytest.param(by_osc, marks=liblo),
    "cue list": by_cues,
    "PJLink": by_pjlink,
    "sACN, Art-Net": by_sacn,
}


@pytest.mark.parametrize(("side", "drive"), [
    pytest.param(side, *getattr(drive, "values", (drive,)), marks=getattr(drive, "marks", ()), id=side)
    for side, drive in SIDES.items()
])  # fmt: skip
def test_a_side_does_what_the_page_says_and_nothing_else(kiosk: MemoryKiosk, tmp_path: Path, side: str,
                                                         drive: Side) -> None:  # fmt: skip
    drive(kiosk, tmp_path)
    assert done(kiosk) == table()[side]


def test_the_page_names_every_verb_and_every_side() -> None:
    told = table()
    assert set().union(*told.values()) == set(VERBS)
    assert set(told) == {*SIDES, "keys"}
    assert told["HTTP"] == told["MQTT"] == told["OSC"] == told["cue list"] == set(VERBS)
    # what a key is called for a technician, and the verb that it is
    assert told["keys"] == {
        {"play": "open", "stop": "close"}[name] for name in TECHNICIAN_KEYS if name in ("play", "stop")
    }


def test_a_token_that_only_looks_may_do_nothing_by_http_and_none_may_ask_without_end(
    kiosk: MemoryKiosk, tmp_path: Path
) -> None:
    with served(kiosk, tmp_path / "private") as panel, panel.client() as client:
        looks, operates = panel.token(Role.VIEWER), panel.token(Role.OPERATOR)
        assert client.post("/api/v1/stop", headers=looks).status_code == 403
        assert done(kiosk) == set()
        answers = [client.post("/api/v1/next", json={}, headers=operates) for _ in range(60)]
        refused = [one for one in answers if not one.is_success]
        assert refused
        assert {(one.status_code, one.json()["code"]) for one in refused} == {(429, "too-many-verbs")}
        assert answers[0].is_success
        assert client.get("/api/v1/state", headers=operates).is_success, "who looks is not counted"
        assert client.post("/api/v1/next", json={}, headers=panel.token(Role.OPERATOR)).is_success, "each has its own"


@mqtt.pytestmark
def test_a_building_that_asks_without_end_by_mqtt_is_refused(kiosk: MemoryKiosk, tmp_path: Path) -> None:
    async def story(port: int) -> None:
        async with mqtt.building(port) as (client, heard), mqtt.controlled(kiosk, mqtt.options(tmp_path, port)):
            await mqtt.wait_for(heard, "available", "online")
            for _ in range(3):
                for _ in range(15):
                    await client.publish("hall/velatura/command/next")
                await mqtt.wait_for(heard, "answer", "next")
            await mqtt.wait_for(heard, "answer", "too-many-verbs")

    with kept_port() as port, mqtt.broker(tmp_path / "broker", port):
        asyncio.run(story(port))


def limited(kiosk: MemoryKiosk, folder: Path, text: str, send: Callable[[int], object]) -> set[str]:
    """What a side with this text in building.toml has done after ``send``, which gets its port."""
    with kept_port() as port:
        (folder / "building.toml").write_text(text.replace("PORT", str(port)))
        with serving(kiosk, read(folder)):
            send(port)
    return done(kiosk)


@pytest.mark.parametrize(("limit", "allowed"), [('role = "viewer"', 0), ("per_second = 0.01", 2)])
def test_a_cue_list_keeps_to_its_role_and_its_rate(
    kiosk: MemoryKiosk, tmp_path: Path, limit: str, allowed: int
) -> None:
    # a source is a line here, so only one that comes again can be too fast: the role alone refuses
    soon = datetime.now(ZoneInfo("Europe/Vienna")) + timedelta(seconds=1.5)
    (tmp_path / "cues.csv").write_text(f"time,verb,values\n{soon:%H:%M:%S},next\n+0.1,black,true\n")
    text = f'[cues]\nfile = "{tmp_path}/cues.csv"\n{limit}\n'

    def seen() -> list[str]:
        return [code for code, _ in kiosk.recorded if code in ("cue-refused", "done-by")]

    found = limited(kiosk, tmp_path, text, lambda _: wait_for(lambda: len(seen()) == 2))
    assert len(found) == allowed


@pytest.mark.parametrize(("limit", "allowed"), [('role = "viewer"', 0), ("per_second = 0.01", 2)])
def test_pjlink_keeps_to_its_role_and_its_rate(kiosk: MemoryKiosk, tmp_path: Path, limit: str, allowed: int) -> None:
    async def drive(link: Any) -> None:
        for ask in (lambda: link.mute.both(True), lambda: link.freeze.set(True), link.power.turn_off):
            with contextlib.suppress(PJLinkERR3):
                await ask()

    with stage(kiosk, tmp_path, more=limit + "\n") as port:
        talk(f"127.0.0.1:{port}", drive)
    assert len(done(kiosk)) == allowed


@pytest.mark.parametrize(
    ("limit", "code"), [('role = "viewer"', "verb-not-allowed"), ("per_second = 0.01", "too-many-verbs")]
)
def test_osc_keeps_to_its_role_and_its_rate(kiosk: MemoryKiosk, tmp_path: Path, limit: str, code: str) -> None:
    def send(port: int) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asker:
            asker.settimeout(0.2)

            def refused() -> bool:
                with contextlib.suppress(OSError):
                    asker.sendto(message("next", 1), ("127.0.0.1", port))
                    return code.encode() in asker.recv(4096)
                return False

            wait_for(refused)

    found = limited(kiosk, tmp_path, f"[osc]\nport = PORT\n{limit}\n", send)
    assert found == (set() if code == "verb-not-allowed" else {"next"})


def test_a_desk_that_only_looks_changes_nothing(kiosk: MemoryKiosk, tmp_path: Path) -> None:
    def send(port: int) -> None:
        with to_port(port), desk(port) as sender:
            sender[7].dmx_data = (2, 102, 5)
            assert not eventually(lambda: done(kiosk), within_s=0.8)

    assert limited(kiosk, tmp_path, '[sacn]\nport = PORT\nuniverse = 7\nrole = "viewer"\n', send) == set()
