"""Building control through a real broker."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import shutil
import socket
import subprocess
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import aiomqtt
import anyio
import pytest

from controller.cli.commands.service import Broker
from controller.core.errors import UsageError
from controller.kiosk.state import KioskState
from controller.kiosk.store.accounts import Accounts
from controller.panel.app import make_panel
from controller.panel.context import PanelOptions
from controller.panel.mqtt.bridge import BuildingControl
from controller.panel.mqtt.options import BrokerOptions
from controller.panel.server import PanelServer
from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.ports import kept_port

MOSQUITTO = shutil.which("mosquitto") or "/usr/sbin/mosquitto"
pytestmark = pytest.mark.skipif(not Path(MOSQUITTO).exists(), reason="needs mosquitto (a package of the test set-up)")
CONNECT, PUBLISH, SUBSCRIBE = 1, 3, 8
ONCE_KEPT = 0b0011
"""Flags of a message that is confirmed, perhaps comes twice, and is kept for who comes later."""
USER, SECRET = "kiosk", "word for the broker"


@pytest.fixture
def port() -> Iterator[int]:
    with kept_port() as number:
        yield number


@contextlib.contextmanager
def broker(folder: Path, port: int) -> Iterator[None]:
    folder.mkdir(exist_ok=True)
    passwords = folder / "passwords"
    tool = shutil.which("mosquitto_passwd") or "/usr/bin/mosquitto_passwd"
    subprocess.run([tool, "-b", "-c", str(passwords), USER, SECRET], check=True, capture_output=True)
    passwords.chmod(0o644)
    folder.chmod(0o755)
    config = folder / "mosquitto.conf"
    config.write_text(f"listener {port} 127.0.0.1\nallow_anonymous false\npassword_file {passwords}\nuser root\n")
    with subprocess.Popen(
        [MOSQUITTO, "-c", str(config)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        try:
            until = time.monotonic() + 60
            while True:
                with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
                    break
                assert time.monotonic() < until, "the broker did not start"
                time.sleep(0.02)
            yield
        finally:
            process.terminate()


def options(folder: Path, port: int) -> BrokerOptions:
    secret = folder / "secret"
    secret.write_text(SECRET + "\n")
    return BrokerOptions("127.0.0.1", port, "hall/velatura", USER, secret)


@contextlib.asynccontextmanager
async def building(port: int) -> AsyncIterator[tuple[aiomqtt.Client, asyncio.Queue[tuple[str, str]]]]:
    """The building's side: everything that is published, and a client to publish with."""
    heard: asyncio.Queue[tuple[str, str]] = asyncio.Queue()
    async with aiomqtt.Client("127.0.0.1", port, username=USER, password=SECRET) as client:
        await client.subscribe("hall/velatura/#")

        async def listen() -> None:
            async for message in client.messages:
                assert isinstance(message.payload, bytes)
                heard.put_nowait((str(message.topic).removeprefix("hall/velatura/"), message.payload.decode()))

        listening = asyncio.create_task(listen())
        try:
            yield client, heard
        finally:
            listening.cancel()
            await asyncio.gather(listening, return_exceptions=True)


async def wait_for(heard: asyncio.Queue[tuple[str, str]], topic: str, words: str) -> str:
    async with asyncio.timeout(10):
        while True:
            where, said = await heard.get()
            if where == topic and words in said:
                return said


@contextlib.asynccontextmanager
async def controlled(kiosk: MemoryKiosk, settings: BrokerOptions, *, patience_s: float = 10) -> AsyncIterator[None]:
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(BuildingControl(kiosk, settings, first_pause_s=0.1, patience_s=patience_s).run)
        yield
        tasks.cancel_scope.cancel()


def test_a_building_opens_closes_and_plays_and_hears_what_came_of_it(tmp_path: Path, port: int) -> None:
    kiosk = MemoryKiosk(tmp_path / "pictures")

    async def story() -> None:
        async with building(port) as (client, heard), controlled(kiosk, options(tmp_path, port)):
            await wait_for(heard, "available", "online")
            state = json.loads(await wait_for(heard, "state", "playing"))
            assert state["problems"][0]["device"] == "right"
            await client.publish("hall/velatura/command/close")
            await wait_for(heard, "state", "cooling")
            await client.publish("hall/velatura/command/open")
            await wait_for(heard, "state", "powering")
            await client.publish("hall/velatura/command/play", "warm wood")
            await wait_for(heard, "state", "warm wood")
            for payload in ("../etc", "x" * 4000, "\x00", "", "no such thing"):
                await client.publish("hall/velatura/command/play", payload)
                await wait_for(heard, "answer", '"done": false')
            await client.publish("hall/velatura/command/format", "c:")
            await wait_for(heard, "answer", "command-unknown")
            assert kiosk.snapshot().playing == "warm wood"

    with broker(tmp_path / "broker", port):
        asyncio.run(story())


def test_a_command_kept_by_the_broker_is_not_obeyed_after_a_restart(tmp_path: Path, port: int) -> None:
    kiosk = MemoryKiosk(tmp_path / "pictures")

    async def story() -> None:
        async with building(port) as (client, heard):
            await client.publish("hall/velatura/command/close", retain=True)
            async with controlled(kiosk, options(tmp_path, port)):
                await wait_for(heard, "state", "playing")
                await client.publish("hall/velatura/command/play", "warm wood")
                await wait_for(heard, "answer", "play")
                assert kiosk.snapshot().state == "playing"

    with broker(tmp_path / "broker", port):
        asyncio.run(story())


def test_a_broker_that_goes_and_comes_is_found_again(tmp_path: Path, port: int) -> None:
    kiosk = MemoryKiosk(tmp_path / "pictures")

    async def story() -> None:
        async with controlled(kiosk, options(tmp_path, port)):
            await asyncio.sleep(0.3)
            for _ in range(2):
                started = broker(tmp_path / "broker", port)
                await asyncio.to_thread(started.__enter__)
                async with building(port) as (_, heard):
                    await wait_for(heard, "available", "online")
                await asyncio.to_thread(started.__exit__, None, None, None)

    asyncio.run(story())


@contextlib.asynccontextmanager
async def forgetful_broker(
    asked: asyncio.Event | None = None,
) -> AsyncIterator[tuple[int, asyncio.Queue[tuple[int, int]]]]:
    """Speaks as much of MQTT 3.1.1 as a publisher needs, but does not confirm a state on its first connection. Yields
    its port, and for every state the number of its connection and its flags. ``asked`` is set with the answer to a
    subscription.
    """
    states: asyncio.Queue[tuple[int, int]] = asyncio.Queue()
    connections = itertools.count()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        connection = next(connections)
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError), contextlib.closing(writer):
            while True:
                kind, flags = divmod((await reader.readexactly(1))[0], 16)
                length, shift, more = 0, 0, 0x80
                while more & 0x80:
                    more = (await reader.readexactly(1))[0]
                    length, shift = length | (more & 0x7F) << shift, shift + 7
                body = await reader.readexactly(length)
                if kind == CONNECT:
                    writer.write(bytes((0x20, 2, 0, 0)))
                elif kind == SUBSCRIBE:
                    writer.write(bytes((0x90, 3, *body[:2], 1)))
                    if asked:
                        asked.set()
                elif kind == PUBLISH:
                    topic_end = 2 + int.from_bytes(body[:2], "big")
                    state = body[2:topic_end].endswith(b"/state")
                    if state:
                        states.put_nowait((connection, flags))
                    if connection or not state:
                        writer.write(bytes((0x40, 2, *body[topic_end : topic_end + 2])))

    server = await asyncio.start_server(serve, "127.0.0.1")
    async with server:
        yield server.sockets[0].getsockname()[1], states


def test_a_broker_that_does_not_confirm_a_state_is_told_it_again_on_a_new_connection(tmp_path: Path) -> None:
    kiosk = MemoryKiosk(tmp_path / "pictures")

    async def story() -> None:
        async with forgetful_broker() as (port, states), controlled(kiosk, options(tmp_path, port), patience_s=0.5):
            async with asyncio.timeout(30):
                assert [await states.get(), await states.get()] == [(0, ONCE_KEPT), (1, ONCE_KEPT)]

    asyncio.run(story())


def test_a_building_hears_that_the_panel_takes_its_leave(tmp_path: Path, port: int) -> None:
    kiosk = MemoryKiosk(tmp_path / "pictures")
    settings = PanelOptions(folder=tmp_path / "panel", port=0, broker=options(tmp_path, port))
    panel = PanelServer(make_panel(kiosk, Accounts(settings.folder / "accounts.json"), settings), settings)

    async def story() -> None:
        async with building(port) as (_, heard):
            await asyncio.to_thread(panel.start)
            await wait_for(heard, "available", "online")
            await asyncio.to_thread(panel.stop)
            await wait_for(heard, "available", "offline")

    with broker(tmp_path / "broker", port):
        asyncio.run(story())


class Fragile(MemoryKiosk):
    """Meets an error that no one thought of when it is to close."""

    def stop(self) -> None:
        raise RuntimeError("nobody thought of this")


def test_an_error_that_nobody_knows_ends_neither_the_connection_nor_the_panel(tmp_path: Path, port: int) -> None:
    kiosk = Fragile(tmp_path / "pictures")

    async def story() -> None:
        async with building(port) as (client, heard), controlled(kiosk, options(tmp_path, port)):
            await wait_for(heard, "available", "online")
            await client.publish("hall/velatura/command/close")
            assert json.loads(await wait_for(heard, "answer", "close"))["code"] == "crash"
            await client.publish("hall/velatura/command/play", "warm wood")
            await wait_for(heard, "state", "warm wood")

    with broker(tmp_path / "broker", port):
        asyncio.run(story())


class Dazed(MemoryKiosk):
    """Cannot say how it is for a while."""

    dazed = False

    def snapshot(self) -> KioskState:
        if self.dazed:
            raise RuntimeError("nobody thought of this either")
        return super().snapshot()


def test_a_state_that_cannot_be_told_for_a_while_is_told_afterwards(tmp_path: Path, port: int) -> None:
    kiosk = Dazed(tmp_path / "pictures")

    async def story() -> None:
        async with building(port) as (client, heard), controlled(kiosk, options(tmp_path, port)):
            await wait_for(heard, "state", "playing")
            kiosk.dazed = True
            await client.publish("hall/velatura/command/close")
            await wait_for(heard, "answer", "close")
            await asyncio.sleep(0.3)  # so that the change itself meets the error
            kiosk.dazed = False
            await wait_for(heard, "state", "cooling")

    with broker(tmp_path / "broker", port):
        asyncio.run(story())


def test_a_password_file_that_is_no_text_is_tried_again_until_it_is_mended(tmp_path: Path, port: int) -> None:
    kiosk = MemoryKiosk(tmp_path / "pictures")
    settings = options(tmp_path, port)
    assert settings.password_file is not None
    settings.password_file.write_bytes(b"\xff\xfe\x00")

    async def story() -> None:
        async with building(port) as (_, heard), controlled(kiosk, settings):
            await asyncio.sleep(0.15)
            assert heard.empty()
            options(tmp_path, port)
            await wait_for(heard, "available", "online")

    with broker(tmp_path / "broker", port):
        asyncio.run(story())


def test_a_broker_that_is_away_is_an_event_and_a_line_of_the_status_until_it_is_back(tmp_path: Path, port: int) -> None:
    async def life() -> None:
        kiosk = MemoryKiosk(tmp_path / "pictures")
        control = BuildingControl(kiosk, options(tmp_path, port), first_pause_s=0.05)
        running = asyncio.create_task(control.run())
        with anyio.fail_after(60):
            while not kiosk.snapshot().warnings:
                await asyncio.sleep(0.02)
            await asyncio.sleep(0.3)  # it tries again, and says nothing more
            assert [code for code, _ in kiosk.recorded] == ["mqtt-lost"]
            assert f"127.0.0.1:{port}" in kiosk.snapshot().warnings[0]
            with broker(tmp_path / "broker", port):
                while kiosk.snapshot().warnings:
                    await asyncio.sleep(0.02)
        assert [code for code, _ in kiosk.recorded] == ["mqtt-lost", "mqtt-back"]
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    asyncio.run(life())


@pytest.mark.parametrize("turns", range(4))
def test_it_ends_also_when_it_is_cancelled_as_the_broker_answers(tmp_path: Path, turns: int) -> None:
    """A cancellation so many turns of the loop after the answer to its first request."""

    async def story() -> None:
        asked = asyncio.Event()
        async with forgetful_broker(asked) as (port, _):
            control = BuildingControl(MemoryKiosk(tmp_path / "pictures"), options(tmp_path, port))
            running = asyncio.create_task(control.run())
            await asked.wait()
            for _ in range(turns):
                await asyncio.sleep(0)
            running.cancel()
            done, _ = await asyncio.wait([running], timeout=60)
            assert done

    asyncio.run(story())


@pytest.mark.parametrize(
    ("written", "address"),
    [
        ("broker", ("broker", 1883, False)),
        ("broker:1884", ("broker", 1884, False)),
        ("mqtt://broker", ("broker", 1883, False)),
        ("mqtts://broker/", ("broker", 8883, True)),
        ("mqtts://kiosk@broker:8884", ("broker", 8884, True)),
        ("[2001:db8::1]", ("2001:db8::1", 1883, False)),
        ("2001:db8::1", ("2001:db8::1", 1883, False)),
        ("mqtts://[2001:db8::1]:99", ("2001:db8::1", 99, True)),
    ],
)
def test_the_address_of_a_broker_in_all_its_forms(written: str, address: tuple[str, int, bool]) -> None:
    made = Broker(mqtt=written).options()
    assert made is not None
    assert (made.host, made.port, made.encrypted) == address
    assert made.username == ("kiosk" if "@" in written else None)


@pytest.mark.parametrize(
    "written", ["http://broker", "mqtt://kiosk:secret@broker", "broker:0", "mqtt://", "mqtt://a/b", "[broker]:1"]
)
def test_other_addresses_of_a_broker_are_refused_without_their_password(written: str) -> None:
    with pytest.raises(UsageError) as caught:
        Broker(mqtt=written).options()
    assert caught.value.code in ("address-wrong", "mqtt-address-wrong")
    assert "secret" not in str(caught.value)
