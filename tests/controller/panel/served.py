"""A panel that is really served: uvicorn in a thread, on a port of its own."""

from __future__ import annotations

import contextlib
import re
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import httpx
import uvicorn
from argon2 import PasswordHasher
from starlette.applications import Starlette

from controller.kiosk.interface import Kiosk
from controller.kiosk.operations.operation import Operation
from controller.kiosk.operations.table import OPERATIONS
from controller.kiosk.store.accounts import Accounts, Role
from controller.panel.app import make_panel
from controller.panel.context import PanelOptions

QUICK_HASH = PasswordHasher(time_cost=1, memory_cost=64, parallelism=1)
"""Argon2id all the same; the real cost has a test of its own."""

PASSWORD = "a long pass phrase"
ROLES = {"viewer": Role.VIEWER, "operator": Role.OPERATOR, "technician": Role.TECHNICIAN}


def accounts_in(folder: Path) -> Accounts:
    """Three accounts, named as their roles are: vera, otto, tina."""
    accounts = Accounts(folder / "accounts.json", hasher=QUICK_HASH)
    for name, role in (("vera", Role.VIEWER), ("otto", Role.OPERATOR), ("tina", Role.TECHNICIAN)):
        if accounts.get(name) is None:
            accounts.add(name, role, PASSWORD)
    return accounts


@dataclass(slots=True)
class Served:
    app: Starlette
    kiosk: Kiosk
    accounts: Accounts
    address: str

    def client(self) -> httpx.Client:
        return httpx.Client(base_url=self.address, timeout=20, trust_env=False)

    @contextlib.contextmanager
    def entered(self, name: str, password: str = PASSWORD) -> Iterator[httpx.Client]:
        """A client that has logged in."""
        with self.client() as client:
            answer = log_in(client, name, password)
            assert answer.status_code == 303, answer.text
            yield client

    def token(self, role: Role) -> dict[str, str]:
        """Headers with a new token of this role."""
        name = f"t{time.monotonic_ns()}"
        return {"authorization": f"Bearer {self.accounts.add_token(name, role)}"}


def log_in(client: httpx.Client, name: str, password: str) -> httpx.Response:
    form = {"csrf": csrf(client.get("/login").text), "name": name, "password": password}
    return client.post("/login", data=form)


def csrf(page: str) -> str:
    found = re.search(r'name="csrf" value="([^"]+)"', page)
    assert found is not None, page[:500]
    return found[1]


@contextlib.contextmanager
def served(
    kiosk: Kiosk, folder: Path, *, port: int = 0, options: PanelOptions | None = None, accounts: Accounts | None = None,
    operations: Sequence[Operation] = OPERATIONS,
) -> Iterator[Served]:  # fmt: skip
    accounts = accounts or accounts_in(folder)
    app = make_panel(kiosk, accounts, options or PanelOptions(folder=folder, frames_per_s=20), operations)
    config = uvicorn.Config(
        app, host="127.0.0.1", port=port, log_level="error", ws="none", server_header=False, timeout_graceful_shutdown=1
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    until = time.monotonic() + 20
    while not server.started:
        assert thread.is_alive(), "the panel did not start"
        assert time.monotonic() < until, "the panel did not start in time"
        time.sleep(0.01)
    found = server.servers[0].sockets[0].getsockname()[1]
    try:
        yield Served(app, kiosk, accounts, f"http://127.0.0.1:{found}")
    finally:
        server.should_exit = True
        thread.join(20)
        assert not thread.is_alive(), "the panel did not stop"
