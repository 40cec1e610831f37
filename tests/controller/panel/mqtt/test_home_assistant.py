"""Home Assistant's discovery: judged by Home Assistant itself at a real broker; what is retained, and what no more."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import subprocess
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import anyio
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.kiosk.interface import Kiosk
from controller.kiosk.operations.table import OPERATIONS
from controller.kiosk.state import DriftCheck
from controller.panel.mqtt.bridge import BuildingControl
from controller.panel.mqtt.home_assistant import messages, node
from controller.panel.mqtt.options import BrokerOptions
from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.controller.panel.mqtt.test_bridge import MOSQUITTO, SECRET, USER, broker, building, options, port, wait_for
from tests.waiting import wait_for as wait_until

__all__ = ["port"]
PYTHON = Path(__file__).parents[4] / ".venv-homeassistant" / "bin" / "python"
PROCESS = Path(__file__).with_name("home_assistant_process.py")
STAGE = "head_of_a_boy"
needs_broker = pytest.mark.skipif(not Path(MOSQUITTO).exists(), reason="needs mosquitto (a package of the test set-up)")


@contextlib.contextmanager
def home_assistant(port: int, folder: Path) -> Iterator[Callable[..., Any]]:
    """Yields what asks it; see ``home_assistant_process``."""
    command = [str(PYTHON), str(PROCESS), str(port), USER, SECRET, str(folder)]
    with (
        (folder.parent / "home-assistant.log").open("w") as log,
        subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True, cwd=folder.parent
        ) as process,
    ):
        assert process.stdin is not None
        assert process.stdout is not None
        told, heard = process.stdin, process.stdout

        def ask(**asked: Any) -> Any:
            told.write(json.dumps(asked) + "\n")
            told.flush()
            line = heard.readline()
            assert line, Path(log.name).read_text()[-2000:]
            return json.loads(line)

        try:
            yield ask
        finally:
            told.close()


@contextlib.contextmanager
def connected(kiosk: Kiosk, settings: BrokerOptions) -> Iterator[None]:
    """The stage's side, in a thread of its own."""

    async def run() -> None:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(BuildingControl(kiosk, settings, first_pause_s=0.1).run)
            await anyio.to_thread.run_sync(over.acquire, abandon_on_cancel=True)
            tasks.cancel_scope.cancel()

    over = threading.Semaphore(0)
    thread = threading.Thread(target=lambda: asyncio.run(run()), daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.release()
        thread.join(20)


def states(entities: dict[str, Any]) -> dict[str, str]:
    return {name.replace(f"{STAGE}_", ""): entity["state"] for name, entity in entities.items()}


def discovered(folder: Path, port: int) -> BrokerOptions:
    return replace(options(folder, port), discovery="homeassistant")


@needs_broker
@pytest.mark.skipif(
    not PYTHON.exists(), reason="needs Home Assistant (.ci/setup-peer homeassistant; Python 3.11 or 3.12)"
)
@pytest.mark.slow
def test_home_assistant_finds_a_stage_reads_it_and_controls_it(tmp_path: Path, port: int) -> None:
    kiosk = MemoryKiosk(tmp_path / "pictures")
    (tmp_path / "home").mkdir()
    with (
        broker(tmp_path / "broker", port),
        home_assistant(port, tmp_path / "home") as ask,
        connected(kiosk, discovered(tmp_path, port)),
    ):
        expected = {
            "switch.open": "on", "switch.black": "off", "switch.pause": "off", "switch.projector_names": "off",
            "button.next_appearance": "unknown", "button.playlist": "unknown",
            "select.appearance": "marble", "number.brightness": "100.0",
            "sensor.state": "playing", "binary_sensor.problem": "on",
            "sensor.light_dose": "12.34", "sensor.drift": "0.04", "sensor.advice_of_the_drift_check": "nothing",
            "binary_sensor.lamp_left": "on", "sensor.lamp_left_hours": "1204.0",
            "binary_sensor.lamp_right": "off", "sensor.lamp_right_hours": "3120.0",
        }  # fmt: skip
        wait_until(lambda: states(ask(wait=17)) == expected)
        found = ask(wait=17)
        assert found[f"select.{STAGE}_appearance"]["options"] == ["marble", "warm wood"]
        assert found[f"binary_sensor.{STAGE}_problem"]["problems"][0]["device"] == "right"
        assert "one projector" in found[f"sensor.{STAGE}_state"]["reason"]

        def do(call: str, entity: str, so: Callable[[], object], **data: Any) -> None:
            ask(call=call, data={"entity_id": f"{call.partition('.')[0]}.{STAGE}_{entity}", **data})
            wait_until(so)

        state = kiosk.snapshot
        do("select.select_option", "appearance", lambda: state().playing == "warm wood", option="warm wood")
        do("number.set_value", "brightness", lambda: state().brightness == 40, value=40)
        do("switch.turn_on", "black", lambda: state().black)
        do("switch.turn_off", "black", lambda: not state().black)
        do("switch.turn_on", "pause", lambda: state().paused)
        do("switch.turn_on", "projector_names", lambda: state().identifying)
        do("button.press", "next_appearance", lambda: state().playing == "marble")
        do("button.press", "playlist", lambda: state().in_turn)
        do("switch.turn_off", "open", lambda: state().state == "cooling")
        kiosk.change(lamps=state().lamps[:1], devices=(), drifts=(DriftCheck("night", 0.0, "look", None),))
        closed = {
            "switch.open": "off", "sensor.state": "cooling", "select.appearance": "unknown",
            "binary_sensor.problem": "off", "sensor.drift": "unknown", "sensor.advice_of_the_drift_check": "look",
        }  # fmt: skip
        wait_until(lambda: closed.items() <= states(ask(wait=15)).items())
        do("switch.turn_on", "open", lambda: state().state == "powering")
    log = (tmp_path / "home-assistant.log").read_text().splitlines()
    assert not [line for line in log if line.startswith(("ERROR", "WARNING")) and "'camera'" not in line]


@needs_broker
def test_what_is_there_no_more_is_removed_also_after_a_restart(tmp_path: Path, port: int) -> None:
    kiosk = MemoryKiosk(tmp_path / "pictures")
    right, other = (f"homeassistant/binary_sensor/{stage}/lamp-right/config" for stage in ("hall_2Fvelatura", "attic"))

    async def retained(*published: tuple[str, str]) -> set[str]:
        """What the broker sends to a new client; ``published`` before."""
        async with building(port) as (client, heard), asyncio.timeout(20):
            for topic, payload in published:
                await client.publish(topic, payload, qos=1, retain=True)
            await client.subscribe("homeassistant/#")
            await client.publish("hall/velatura/end", "")
            topics = set()
            while (topic := (await heard.get())[0]) != "end":
                topics.add(topic)
            return topics

    with broker(tmp_path / "broker", port):
        asyncio.run(retained((other, "{}")))
        with connected(kiosk, discovered(tmp_path, port)):
            wait_until(lambda: right in asyncio.run(retained()))
            names = next(topic for topic in asyncio.run(retained()) if "/select/" in topic)
        kiosk.change(lamps=kiosk.snapshot().lamps[:1])
        with connected(kiosk, discovered(tmp_path, port)):
            wait_until(lambda: right not in asyncio.run(retained()))
            kept = asyncio.run(retained())
            assert {names, other} < kept, "what it still has stays, and what belongs to others"


@needs_broker
def test_a_verb_alone_may_be_the_payload_and_without_the_option_nothing_is_announced(tmp_path: Path, port: int) -> None:
    kiosk = MemoryKiosk(tmp_path / "pictures")

    async def story() -> None:
        async with building(port) as (client, heard):
            await client.subscribe("homeassistant/#")
            await wait_for(heard, "available", "online")
            await wait_for(heard, "state", "playing")
            await client.publish("hall/velatura/command", "close")
            topics = set()
            while "cooling" not in (said := await heard.get())[1]:
                topics.add(said[0])
            assert topics <= {"command", "answer", "state"}
            for wrong in ("", "format", "play", "\x00" * 300):
                await client.publish("hall/velatura/command", wrong)
                answer = json.loads(await wait_for(heard, "answer", '"done": false'))
                assert answer["code"] in ("command-unknown", "field-missing"), answer

    with broker(tmp_path / "broker", port), connected(kiosk, options(tmp_path, port)):
        asyncio.run(story())


def test_each_verb_of_a_building_has_an_entity(tmp_path: Path) -> None:
    kiosk = MemoryKiosk(tmp_path / "pictures")
    entities = [json.loads(one) for one in messages("homeassistant", "hall", kiosk.snapshot(), ["a"], "1").values()]
    reached = {one["command_topic"].rpartition("/")[2] for one in entities if "command_topic" in one} - {"command"}
    alone = [one for one in entities if one.get("command_topic") == "hall/command"]
    for one in alone:
        reached |= {one[key] for key in ("payload_on", "payload_off", "payload_press") if key in one}
    assert reached == {one.building_verb for one in OPERATIONS} - {""}
    assert len({one["unique_id"] for one in entities}) == len(entities)


def test_what_a_stage_does_not_have_yet_has_no_entity(tmp_path: Path) -> None:
    new = replace(MemoryKiosk(tmp_path / "pictures").snapshot(), drifts=(), lamps=(), dose_klx_h=None)
    topics = messages("homeassistant", "hall", new, [], "1")
    assert not [one for one in topics if any(word in one for word in ("/select/", "drift", "lamp", "dose"))]


@given(st.lists(st.text(st.characters(blacklist_categories=["Cs"]), min_size=1), min_size=2, unique=True))
def test_two_topics_are_two_devices_and_their_names_are_allowed(topics: list[str]) -> None:
    nodes = {node(one) for one in topics}
    assert all(re.fullmatch(r"[A-Za-z0-9_-]+", one) for one in nodes)
    assert len(nodes) == len(topics)
