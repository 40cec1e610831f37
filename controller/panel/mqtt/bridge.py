"""Building control over MQTT: publishes the kiosk's state, and accepts commands such as open, close and play."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import ssl
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, Final

import aiomqtt
import anyio
from anyio.abc import TaskGroup

from controller.core.files import read_text
from controller.kiosk.building.verbs import Verbs
from controller.kiosk.interface import Kiosk
from controller.kiosk.operations.operation import Operation
from controller.kiosk.operations.table import OPERATIONS
from controller.kiosk.panel_address import bracketed
from controller.kiosk.state import DriftCheck, KioskState
from controller.panel.answers import FAILURES
from controller.panel.mqtt import home_assistant
from controller.panel.mqtt.options import BrokerOptions
from controller.run.state_machine import State

_OPEN: Final = (State.POWERING, State.WARMING, State.READY, State.PLAYING, State.DEGRADED)
_OPEN_NAMES: Final = frozenset(state.value for state in _OPEN)


def published(now: KioskState) -> dict[str, Any]:
    """``open``: whether it shows appearances or its lamps warm up for that. Lamps in tenths of an hour, so that a
    lit lamp alone does not change the state every second.
    """
    return {
        "state": now.state,
        "open": now.state in _OPEN_NAMES,
        "reason": now.reason,
        "since_unix_s": now.since_unix_s,
        "playing": now.playing,
        "in_turn": now.in_turn,
        "paused": now.paused,
        "black": now.black,
        "brightness": now.brightness,
        "identifying": now.identifying,
        "warnings": list(now.warnings),
        "failures": [row.text for row in now.failures],
        "problems": [{"device": row.name, "problem": row.problem} for row in now.devices if row.problem],
        "lamps": {
            lamp.projector: {"lit": lamp.lit, "hours": round(lamp.hours, 1), "strikes": lamp.strikes}
            for lamp in now.lamps
        },
        "dose_klx_h": now.dose_klx_h,
        "drift": _drift(now.drifts[0]) if now.drifts else None,
    }


def _drift(check: DriftCheck) -> dict[str, Any]:
    moved = None if check.moved_px is None else round(check.moved_px, 3)
    return {"unix_s": check.unix_s, "advice": check.advice, "moved_px": moved}


LONGEST_PAUSE_S: Final = 60.0
MOST_COMMANDS_WAITING: Final = 20
MOST_ENTITIES: Final = 200
"""Discovery messages that the broker has retained and sends at the beginning."""
LONGEST_PAYLOAD: Final = 256
AGAIN_S: Final = 1.0
"""Pause after a state that could not be read."""
LEAVE_S: Final = 2.0
"""The longest time that a stop waits to publish "offline"."""
_LOG: Final = logging.getLogger("velatura.panel")


class BuildingControl:
    """The connection to a broker; it reconnects without end, with growing pauses.

    Topics: ``T/available`` "online" or "offline" (retained; sent by the broker if the connection is lost); ``T/state``
    JSON (retained); ``T/command/VERB`` for every operation with a ``building_verb`` (open, close, play, next,
    ...): the payload is its first value as text, or a JSON object; ``T/command``: the payload is a verb without values;
    ``T/answer``: the result. The broker decides who may publish to these. With ``options.discovery``, Home Assistant
    finds the stage. It reconnects to a broker that confirms nothing for ``patience_s``.
    """

    def __init__(
        self, kiosk: Kiosk, options: BrokerOptions, *, first_pause_s: float = 1.0, patience_s: float = 10.0,
        operations: Sequence[Operation] = OPERATIONS,
    ) -> None:  # fmt: skip
        self._kiosk, self._options = kiosk, options
        self._first_pause_s, self._patience_s = first_pause_s, patience_s
        self._verbs = Verbs(kiosk, "Building control", operations=operations)
        self._changed, self._missing = asyncio.Event(), False
        self._found: set[str] = set()
        """Discovery topics of this stage that the broker retained."""

    async def run(self) -> None:
        """Run until cancelled. A missing broker only causes retries."""
        loop = asyncio.get_running_loop()

        def notify() -> None:
            loop.call_soon_threadsafe(self._changed.set)

        unsubscribe = self._kiosk.subscribe(notify)
        pause_s = self._first_pause_s
        task = asyncio.current_task()
        try:
            while True:
                began_s = loop.time()
                try:
                    # A task group repeats its cancellation. `asyncio.wait_for`, inside every call of the client, can
                    # lose one that arrives together with the broker's answer (Python 3.11), and would wait without end.
                    async with anyio.create_task_group() as tasks:
                        tasks.start_soon(self._connected, tasks)
                except* ValueError as errors:
                    _LOG.warning("The MQTT password file is not text, or the topic is not valid: %s", errors.exceptions)
                except* (aiomqtt.MqttError, OSError) as errors:
                    # The kiosk continues without the broker; "available" shows "offline" to its clients.
                    self._lost(str(errors.exceptions[0]))
                except* Exception:  # noqa: BLE001 - one connection must not end the panel or the retries
                    _LOG.exception("The connection to the MQTT broker failed. Reconnecting.")
                # A group of errors replaces a cancellation that arrives in the same moment.
                if task is not None and task.cancelling():
                    raise asyncio.CancelledError
                pause_s = self._first_pause_s if loop.time() - began_s > LONGEST_PAUSE_S else pause_s
                await asyncio.sleep(pause_s)
                pause_s = min(LONGEST_PAUSE_S, 2 * pause_s)
        finally:
            unsubscribe()

    def _lost(self, why: str) -> None:
        """An event once, and a line of the status until it is connected."""
        if not self._missing:
            self._missing = True
            what = f"The MQTT broker at {bracketed(self._options.host)}:{self._options.port} can't be reached: {why}."
            self._kiosk.record("mqtt-lost", f"{what} It is tried again.", "warning")
            self._kiosk.warn("mqtt", what)

    def _back(self) -> None:
        if self._missing:
            self._missing = False
            self._kiosk.record("mqtt-back", "The MQTT broker is connected again.")
            self._kiosk.warn("mqtt", "")

    async def _connected(self, tasks: TaskGroup) -> None:
        options, topic = self._options, self._options.topic
        password = await anyio.to_thread.run_sync(_password, options.password_file)
        tls = ssl.create_default_context(cafile=options.certificates) if options.encrypted else None
        will = aiomqtt.Will(f"{topic}/available", "offline", qos=1, retain=True)
        async with aiomqtt.Client(
            options.host,
            options.port,
            username=options.username,
            password=password,
            will=will,
            tls_context=tls,
            timeout=self._patience_s,
            max_queued_incoming_messages=MOST_COMMANDS_WAITING + (MOST_ENTITIES if options.discovery else 0),
        ) as client:
            await client.subscribe([(f"{topic}/command/+", 1), (f"{topic}/command", 1)])
            if options.discovery:
                self._found.clear()
                await client.subscribe(home_assistant.own_topics(options.discovery, topic), qos=1)
            await client.publish(f"{topic}/available", "online", qos=1, retain=True)
            self._back()
            try:
                self._changed.set()
                tasks.start_soon(self._publish, client)
                async for message in client.messages:
                    if message.topic.matches(f"{topic}/command/#"):
                        await self._execute(client, message)
                    elif message.retain and message.payload:
                        self._found.add(str(message.topic))
                        self._changed.set()
            finally:
                # The broker publishes the will only after a lost connection, not after a regular one.
                with anyio.move_on_after(LEAVE_S, shield=True), contextlib.suppress(aiomqtt.MqttError):
                    await client.publish(f"{topic}/available", "offline", qos=1, retain=True)

    async def _publish(self, client: aiomqtt.Client) -> None:
        last: dict[str, str] = {}
        while True:
            await self._changed.wait()
            self._changed.clear()
            try:
                now = await anyio.to_thread.run_sync(self._retained)
            except Exception:  # noqa: BLE001 - the next state may succeed
                # Nothing restarts this task, and without it the broker would keep an old state.
                _LOG.exception("The state could not be published to MQTT. Trying again.")
                await asyncio.sleep(AGAIN_S)
                self._changed.set()
                continue
            # An empty message removes what the broker retained: a lamp or a choice that is there no more.
            gone = dict.fromkeys((self._found | set(last)) - set(now), "")
            for topic, payload in (gone | now).items():
                if last.get(topic) != payload:
                    await client.publish(topic, payload, qos=1, retain=True)
            last = now
            self._found.difference_update(gone)  # others may have come meanwhile
            await asyncio.sleep(0.2)

    def _retained(self) -> dict[str, str]:
        """What the broker is to retain, by topic; the state last, because Home Assistant has to know its values."""
        now, options = self._kiosk.snapshot(), self._options
        retained: dict[str, str] = {}
        if options.discovery:
            try:
                names = [one.name for one in self._kiosk.appearances()]
            except FAILURES:
                names = []  # a stage that is not set up
            version = metadata.version("velatura")
            retained |= home_assistant.messages(options.discovery, options.topic, now, names, version)
        return retained | {f"{options.topic}/state": json.dumps(published(now))}

    async def _execute(self, client: aiomqtt.Client, message: aiomqtt.Message) -> None:
        if message.retain:
            return  # an old command: a restart must not open a closed stage
        payload = message.payload if isinstance(message.payload, bytes) else b""
        word = str(message.topic).removeprefix(f"{self._options.topic}/command").removeprefix("/")
        if not word:
            word, payload = payload[:LONGEST_PAYLOAD].decode("utf-8", "replace"), b""
        if word not in self._verbs.names:
            answer = {"command": word[:40], "done": False, "code": "command-unknown"}
        else:
            try:
                await anyio.to_thread.run_sync(self._do, word, payload)
                answer = {"command": word, "done": True}
            except FAILURES as error:
                answer = {
                    "command": word,
                    "done": False,
                    "code": error.code,
                    "what": error.what,
                    "remedy": error.remedy,
                }
            except Exception:  # noqa: BLE001 - the panel's live pages must not end with one command
                _LOG.exception("An MQTT command failed.")
                answer = {"command": word, "done": False, "code": "crash"}
        await client.publish(f"{self._options.topic}/answer", json.dumps(answer), qos=1)

    def _do(self, word: str, payload: bytes) -> None:
        self._verbs.do(word, payload[:LONGEST_PAYLOAD])


def _password(file: Path | None) -> str | None:
    return None if file is None else read_text(file).strip()
