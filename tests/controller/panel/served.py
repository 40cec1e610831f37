"""A panel that is really served, on a port of its own."""

from __future__ import annotations

import contextlib
import dataclasses
import re
import ssl
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import httpx
from argon2 import PasswordHasher
from starlette.applications import Starlette

from controller.kiosk.interface import Kiosk
from controller.kiosk.operations.house import House
from controller.kiosk.operations.operation import Operation
from controller.kiosk.operations.table import OPERATIONS
from controller.kiosk.store.accounts import Accounts, Role
from controller.panel.app import make_panel
from controller.panel.context import PanelOptions
from controller.panel.server import PanelServer

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


@cache
def authorities() -> ssl.SSLContext:
    """Read once: each client would read its file of them again, for longer than it asks for a page."""
    return httpx.create_ssl_context(trust_env=False)


@dataclass(slots=True)
class Served:
    app: Starlette
    kiosk: Kiosk
    accounts: Accounts
    address: str

    def client(self) -> httpx.Client:
        return httpx.Client(base_url=self.address, timeout=20, trust_env=False, verify=authorities())

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
    operations: Sequence[Operation] = OPERATIONS, house: House | None = None,
) -> Iterator[Served]:  # fmt: skip
    accounts = accounts or accounts_in(folder)
    options = dataclasses.replace(options or PanelOptions(folder=folder, frames_per_s=20), port=port)
    app = make_panel(kiosk, accounts, options, operations, house)
    # A panel for a network is tried out on the loopback, too.
    server = PanelServer(app, dataclasses.replace(options, host="127.0.0.1"))
    address = server.start()
    try:
        yield Served(app, kiosk, accounts, address.rstrip("/"))
    finally:
        server.stop()
