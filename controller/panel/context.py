"""What every part of the panel works with: the kiosk, who may log in, what was uploaded, how it is set up."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import anyio

from controller.kiosk.interface import Kiosk
from controller.kiosk.operations.accounts import AccountActions
from controller.kiosk.operations.operation import Operation
from controller.kiosk.operations.table import OPERATIONS
from controller.kiosk.store.accounts import Accounts
from controller.panel.auth.sessions import LoginLimit, Sessions
from controller.panel.live import Hub
from controller.panel.mqtt.options import BrokerOptions
from controller.panel.uploads import Targets, UploadLimits

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class PanelOptions:
    """How the panel is set up.

    ``folder`` private files of the panel (accounts, sessions, uploads). ``hosts`` the names under which browsers may
    reach it, without port: a page of another name that resolves to us is refused. Loopback by default; with
    ``tls_certificate`` and ``tls_key`` (PEM files) it speaks TLS only, and cookies never leave it.
    """

    folder: Path
    host: str = "127.0.0.1"
    port: int = 8377
    hosts: tuple[str, ...] = ("localhost", "127.0.0.1", "[::1]")
    tls_certificate: Path | None = None
    tls_key: Path | None = None
    uploads: UploadLimits = field(default_factory=UploadLimits)
    broker: BrokerOptions | None = None
    most_restore_bytes: int = 8 << 30
    most_open_panels: int = 200
    frames_per_s: float = 4.0

    @property
    def tls(self) -> bool:
        return self.tls_certificate is not None


@dataclass(slots=True)
class Panel:
    """One panel with everything it holds."""

    kiosk: Kiosk
    accounts: Accounts
    options: PanelOptions
    sessions: Sessions
    targets: Targets
    hub: Hub
    operations: Sequence[Operation] = OPERATIONS
    by_address: LoginLimit = field(default_factory=LoginLimit)
    # Wide, so that nobody can lock a technician out by typing wrong passwords elsewhere.
    by_account: LoginLimit = field(default_factory=lambda: LoginLimit(burst=50))
    by_token: LoginLimit = field(default_factory=lambda: LoginLimit(burst=20, refill_s=5.0))
    # Argon2 takes 64 MiB each: two at a time are enough for people.
    hashing: anyio.CapacityLimiter = field(default_factory=lambda: anyio.CapacityLimiter(2))
    costly: threading.BoundedSemaphore = field(default_factory=lambda: threading.BoundedSemaphore(2))
    working: anyio.CapacityLimiter = field(default_factory=lambda: anyio.CapacityLimiter(16))
    form_key: bytes = field(default_factory=lambda: secrets.token_bytes(32))

    @property
    def holders(self) -> dict[str, Any]:
        """Who does the operations."""
        accounts = AccountActions(lambda: self.accounts, self.sessions.end_all, self.costly)
        return {"kiosk": self.kiosk, "accounts": accounts, "targets": self.targets}

    async def ask(self, question: Callable[[], T]) -> T:
        """The kiosk's answer, got in a thread: it is not asynchronous."""
        return await anyio.to_thread.run_sync(question, limiter=self.working)
