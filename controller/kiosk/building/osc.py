"""OSC over UDP: ``/velatura/VERB`` with the verb's values as arguments, and the state as messages of the same kind.

A verb without required values may be sent by a button: its first argument is then 1 when pressed, and 0 is passed over;
values follow. ``/velatura/status`` asks for all of the state.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Coroutine, Iterator, Sequence
from typing import Any, Final, TypeAlias

from pydantic import Field, field_validator
from pythonosc.osc_message_builder import OscMessageBuilder
from pythonosc.osc_packet import OscPacket, ParseError

from controller.core.errors import SEND_DIAGNOSTICS, VelaturaError
from controller.kiosk.building.protocol import NetworkOptions, Protocol, changes
from controller.kiosk.building.verbs import Verbs
from controller.kiosk.operations.fields import Field as Value
from controller.kiosk.state import KioskState
from hal.errors import DeviceError
from hal.links import host_and_port

ROOT: Final = "/velatura/"
MOST_WAITING: Final = 50
LONGEST_WAIT_S: Final = 3600.0
"""A bundle of a later time is refused: the clock of its sender, or this one, is wrong."""
EVERY_S: Final = 0.05
"""Between two messages of state, so that a fader does not flood a network."""
_LOG: Final = logging.getLogger("velatura.building")
Address: TypeAlias = tuple[str, int]
State: TypeAlias = dict[str, str | int | float]


class OscOptions(NetworkOptions):
    """``feedback``: HOST:PORT of those that hear every change of the state."""

    port: int = Field(default=9000, ge=1, le=65535)
    feedback: tuple[str, ...] = ()

    @field_validator("feedback")
    @classmethod
    def _addresses(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for text in value:
            try:
                host_and_port(text, 0)
            except DeviceError:
                raise ValueError(f"{text!r} is not HOST:PORT") from None
        return value

    @property
    def listeners(self) -> tuple[Address, ...]:
        return tuple(host_and_port(text, 0) for text in self.feedback)


def state_of(now: KioskState) -> State:
    """The state as OSC tells it, by the last part of each address."""
    problems = [row for row in now.devices if row.problem]
    return {
        "state": now.state,
        "reason": now.reason,
        "playing": now.playing,
        "in-turn": int(now.in_turn),
        "paused": int(now.paused),
        "black": int(now.black),
        "brightness": float(now.brightness),
        "problems": len(problems) + len(now.warnings) + len(now.failures),
    }


def message(name: str, *values: str | int | float) -> bytes:
    """One OSC message to ``/velatura/name``."""
    builder = OscMessageBuilder(ROOT + name)
    for value in values:
        builder.add_arg(value)
    return builder.build().dgram


def requests(datagram: bytes) -> Iterator[tuple[float, str, list[Any]]]:
    """(Unix time to do it, verb, arguments) of each message to ``/velatura/`` in a datagram.

    The time is that of its bundle, or now. Nothing for what is not OSC.
    """
    try:
        messages = OscPacket(datagram).messages
    except (ParseError, ValueError, IndexError, OverflowError, RecursionError):
        return
    for timed in messages:
        if timed.message.address.startswith(ROOT):
            yield timed.time, timed.message.address.removeprefix(ROOT).strip("/"), list(timed.message.params)


def named(fields: Sequence[Value], arguments: Sequence[Any]) -> dict[str, Any] | None:
    """The values of a verb by name, from arguments in the order of its fields; None for a button that is let go.

    Arguments beyond the fields get names that no verb has, so that they are refused.
    """
    left = list(arguments)
    if left and not any(field.required for field in fields):
        pressed = left.pop(0)
        if not pressed:
            return None
    values: dict[str, Any] = {}
    for at, argument in enumerate(left):
        if at >= len(fields):
            values[f"argument {at + 1}"] = argument
        elif fields[at].kind is bool and argument in (0, 1):
            values[fields[at].name] = bool(argument)
        else:
            values[fields[at].name] = argument
    return values


class Listener(asyncio.DatagramProtocol):
    def __init__(self, options: OscOptions) -> None:
        self.waiting: asyncio.Queue[tuple[bytes, Address]] = asyncio.Queue(MOST_WAITING)
        self._options = options

    def datagram_received(self, data: bytes, addr: Any) -> None:
        # More than can be done is dropped, as a full network would.
        if self._options.allows(addr[0]) and not self.waiting.full():
            self.waiting.put_nowait((data, (addr[0], addr[1])))


async def serve(options: OscOptions, verbs: Verbs) -> None:
    """Serve until cancelled. Raises OSError if it can't listen."""
    loop = asyncio.get_running_loop()
    channel, listener = await loop.create_datagram_endpoint(
        lambda: Listener(options), local_addr=(options.host, options.port)
    )
    logging.getLogger().addFilter(_not_the_librarys)
    later = set[asyncio.Task[None]]()
    try:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(_send_feedback(channel, options.listeners, verbs))
            while True:
                datagram, source = await listener.waiting.get()
                for at_unix_s, verb, arguments in requests(datagram):
                    wait_s = at_unix_s - time.time()
                    if wait_s <= 0:
                        await _answer(channel, verbs, verb, arguments, source)
                    elif wait_s > LONGEST_WAIT_S or len(later) >= MOST_WAITING:
                        channel.sendto(message("error", verb[:40], "too-late", _TOO_LATE), source)
                    else:
                        task = tasks.create_task(_later(wait_s, _answer(channel, verbs, verb, arguments, source)))
                        later.add(task)
                        task.add_done_callback(later.discard)
    finally:
        logging.getLogger().removeFilter(_not_the_librarys)
        channel.close()


_TOO_LATE: Final = "Its time tag is more than an hour ahead, or too many bundles wait. Check both clocks."


async def _later(wait_s: float, work: Coroutine[Any, Any, None]) -> None:
    try:
        await asyncio.sleep(wait_s)
    except asyncio.CancelledError:
        work.close()
        raise
    await work


def _not_the_librarys(record: logging.LogRecord) -> bool:
    """The library logs each argument of a type that it does not know: a broken sender would fill the journal."""
    return "pythonosc" not in record.pathname


async def _answer(
    channel: asyncio.DatagramTransport, verbs: Verbs, verb: str, arguments: list[Any], source: Address
) -> None:
    if verb == "status":
        for name, value in state_of(verbs.status()).items():
            channel.sendto(message(name, value), source)
        return
    try:
        values = named(verbs.fields(verb), arguments)
        if values is not None:
            await asyncio.to_thread(verbs.do, verb, values, source=source[0])
    except VelaturaError as error:
        channel.sendto(message("error", verb[:40], error.code, f"{error.what} {error.remedy}"), source)
    except Exception:  # noqa: BLE001 - one message must not end the protocol
        _LOG.exception("An OSC message failed.")
        channel.sendto(message("error", verb[:40], "crash", SEND_DIAGNOSTICS), source)


async def _send_feedback(channel: asyncio.DatagramTransport, listeners: Sequence[Address], verbs: Verbs) -> None:
    """Send each value to the listeners when it has changed; all at the beginning."""
    last_sent: State = {}
    with changes(verbs) as changed:
        while listeners:
            await changed.wait()
            changed.clear()
            now = state_of(verbs.status())
            for name, value in now.items():
                if last_sent.get(name) != value:
                    for listener in listeners:
                        channel.sendto(message(name, value), listener)
            last_sent = now
            await asyncio.sleep(EVERY_S)


PROTOCOL: Final = Protocol("osc", "OSC", OscOptions, serve)
