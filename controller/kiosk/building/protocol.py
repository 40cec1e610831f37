"""What a protocol declares, and what ``building.toml`` says of it. A new protocol is a module with a ``PROTOCOL``."""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import ipaddress
import logging
import threading
import tomllib
from collections.abc import Callable, Coroutine, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from controller.core.errors import UsageError, VelaturaError
from controller.core.extras import extra_missing
from controller.core.files import read_text
from controller.kiosk.building.verbs import Rate, Verbs
from controller.kiosk.interface import Kiosk
from controller.kiosk.panel_address import is_loopback
from controller.kiosk.roles import Role

FILE: Final = "building.toml"
MODULES: Final = {name: f"controller.kiosk.building.{name}" for name in ("osc", "pjlink", "sacn", "artnet", "cues")}
"""Imported only if building.toml names them: they may need an extra."""


class Options(BaseModel):
    """What every protocol has: what it may do, and ``per_second``: verbs from one source."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    role: Literal["viewer", "operator"] = "operator"
    per_second: float = Field(default=10.0, gt=0, le=100)

    @property
    def where(self) -> str:
        """For people: where it listens, or what it reads."""
        raise NotImplementedError


class NetworkOptions(Options):
    """Where a protocol listens, and who may use it. Without ``allow`` only this machine may."""

    host: str = "127.0.0.1"
    port: int = Field(ge=1, le=65535)
    allow: tuple[str, ...] = ()

    @field_validator("allow")
    @classmethod
    def _networks(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for network in value:
            ipaddress.ip_network(network)
        return value

    @model_validator(mode="after")
    def _closed(self) -> Self:
        if not is_loopback(self.host) and not self.allow:
            raise ValueError('a host beyond this machine needs "allow", the networks that may use it')
        return self

    @property
    def where(self) -> str:
        return f"{self.host}, port {self.port}"

    @property
    def address(self) -> tuple[str, int]:
        return self.host, self.port

    def allows(self, host: str) -> bool:
        """Whether a peer at this address may use it."""
        try:
            address = ipaddress.ip_address(host)
        except ValueError:
            return False
        # Linux shows IPv4 peers of an IPv6 socket so.
        address = getattr(address, "ipv4_mapped", None) or address
        return address.is_loopback or any(address in ipaddress.ip_network(network) for network in self.allow)


@dataclass(frozen=True, slots=True)
class Protocol:
    """One protocol: its name in building.toml, the name for people, its options, and what serves it until cancelled.

    ``serve`` raises OSError or VelaturaError if it can't; it is then tried again.
    """

    name: str
    title: str
    options: type[Options]
    serve: Callable[[Any, Verbs], Coroutine[Any, Any, None]]


@dataclass(frozen=True, slots=True)
class Configured:
    """A protocol with the options of building.toml."""

    protocol: Protocol
    options: Options

    def verbs(self, kiosk: Kiosk) -> Verbs:
        rate = Rate(burst=max(2, round(2 * self.options.per_second)), per_s=self.options.per_second)
        return Verbs(kiosk, self.protocol.title, role=Role.named(self.options.role), rate=rate)


def read(stage: Path) -> tuple[Configured, ...]:
    """The protocols that the stage's ``building.toml`` names; none without the file.

    Raises UsageError("building-wrong") naming table and key, and ("extra-missing").
    """
    file = stage / FILE
    if not file.exists():
        return ()
    try:
        tables = tomllib.loads(read_text(file))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise _wrong(f"it is not TOML: {error}") from error
    return tuple(_configured(name, table, stage) for name, table in tables.items())


def _configured(name: str, table: Any, stage: Path) -> Configured:
    if name not in MODULES:
        raise _wrong(f"[{name[:40]}] is not a protocol; use {', '.join(MODULES)}")
    try:
        protocol: Protocol = importlib.import_module(MODULES[name]).PROTOCOL
    except ModuleNotFoundError as error:
        raise extra_missing(error.name or "") or error from error
    try:
        options = protocol.options.model_validate(table)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise _wrong(f"[{name}] {key}: {first['msg']}".replace(" :", ":")) from error
    files = {key: stage / value for key, value in options if isinstance(value, Path)}
    return Configured(protocol, options.model_copy(update=files))


def _wrong(detail: str) -> UsageError:
    return UsageError(
        "building-wrong", what=f"{FILE} is not valid: {detail}.", remedy="Correct it; see the how-to on show control."
    )


AGAIN_S: Final = (1.0, 5.0, 30.0)
"""Pauses between attempts to listen."""
_LOG: Final = logging.getLogger("velatura.building")


@contextlib.contextmanager
def serving(kiosk: Kiosk, protocols: Sequence[Configured]) -> Iterator[None]:
    """Serve the protocols until the context ends."""
    if not protocols:
        yield
        return
    loop, started = asyncio.new_event_loop(), threading.Event()
    tasks: list[asyncio.Task[None]] = []

    async def run() -> None:
        tasks.extend(asyncio.ensure_future(_kept(one, one.verbs(kiosk), kiosk)) for one in protocols)
        started.set()
        await asyncio.gather(*tasks, return_exceptions=True)

    def work() -> None:
        with contextlib.closing(loop):
            loop.run_until_complete(run())

    thread = threading.Thread(target=work, name="building", daemon=True)
    thread.start()
    started.wait()
    try:
        yield
    finally:
        for task in tasks:
            loop.call_soon_threadsafe(task.cancel)
        thread.join(10.0)


async def _kept(one: Configured, verbs: Verbs, kiosk: Kiosk) -> None:
    """Serve one protocol; if it fails, log that once and try again without end."""
    failed = 0
    while True:
        try:
            await one.protocol.serve(one.options, verbs)
        except Exception as error:  # noqa: BLE001 - one protocol must not end the others
            if not isinstance(error, OSError | VelaturaError):
                _LOG.exception("%s failed.", one.protocol.title)
            if not failed:
                why = f"{error.what} {error.remedy}" if isinstance(error, VelaturaError) else str(error)
                what = f"{one.protocol.title} does not work ({one.options.where}). {why}"
                kiosk.record("building-failed", what, "error")
        pause_s = AGAIN_S[min(failed, len(AGAIN_S) - 1)]
        failed += 1
        await asyncio.sleep(pause_s)


@contextlib.contextmanager
def changes(verbs: Verbs) -> Iterator[asyncio.Event]:
    """An event of the running loop that is set after every change of the kiosk's state, and at the beginning."""
    loop, changed = asyncio.get_running_loop(), asyncio.Event()

    def notify() -> None:
        # A kiosk may change while the loop ends.
        with contextlib.suppress(RuntimeError):
            loop.call_soon_threadsafe(changed.set)

    changed.set()
    leave = verbs.subscribe(notify)
    try:
        yield changed
    finally:
        leave()
