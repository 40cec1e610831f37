"""What the parts of the panel share: kiosk, accounts, uploads and options."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import anyio

from controller.kiosk.interface import Kiosk
from controller.kiosk.operations.accounts import Accounts as AccountsInUse
from controller.kiosk.operations.house import House
from controller.kiosk.operations.operation import Operation
from controller.kiosk.operations.table import OPERATIONS
from controller.kiosk.store.accounts import Accounts
from controller.panel.auth.sessions import LoginLimit, Refusals, Sessions
from controller.panel.live import Hub
from controller.panel.mqtt.options import BrokerOptions
from controller.panel.uploads import Targets, UploadLimits

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class PanelOptions:
    """The settings of the panel.

    ``folder``: private files of the panel (accounts, sessions, uploads). ``hosts``: the allowed host names, without
    port; ``names``: those of them that a person gave, which a reverse proxy may serve. Loopback by default; with
    ``tls_certificate`` and ``tls_key`` (PEM files) it uses only TLS, also for cookies.
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
    names: tuple[str, ...] = ()

    @property
    def tls(self) -> bool:
        return self.tls_certificate is not None


@dataclass(slots=True)
class Panel:
    """The parts of one panel."""

    kiosk: Kiosk
    accounts: Accounts
    options: PanelOptions
    sessions: Sessions
    targets: Targets
    hub: Hub
    operations: Sequence[Operation] = OPERATIONS
    house: House = field(default_factory=House)
    by_address: LoginLimit = field(default_factory=LoginLimit)
    # High, so that wrong passwords from elsewhere can't lock a technician out.
    by_account: LoginLimit = field(default_factory=lambda: LoginLimit(burst=50))
    by_token: LoginLimit = field(default_factory=lambda: LoginLimit(burst=20, refill_s=5.0))
    # Each Argon2 hash needs 64 MiB, so only two run at a time.
    hashing: anyio.CapacityLimiter = field(default_factory=lambda: anyio.CapacityLimiter(2))
    costly: threading.BoundedSemaphore = field(default_factory=lambda: threading.BoundedSemaphore(2))
    working: anyio.CapacityLimiter = field(default_factory=lambda: anyio.CapacityLimiter(16))
    refused: Refusals = field(init=False)
    form_key: bytes = field(default_factory=lambda: secrets.token_bytes(32))

    def __post_init__(self) -> None:
        self.refused = Refusals(self.kiosk.record)

    @property
    def holders(self) -> dict[str, Any]:
        """What operations work on, by the name of their first parameter."""
        accounts = AccountsInUse(lambda: self.accounts, self.sessions.end_all, self.costly)
        return {"kiosk": self.kiosk, "accounts": accounts, "targets": self.targets, "house": self.house}

    async def in_thread(self, question: Callable[[], T]) -> T:
        """Call ``question`` in a thread, because the kiosk is not asynchronous."""
        return await anyio.to_thread.run_sync(question, limiter=self.working)
