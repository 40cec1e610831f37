"""Accounts and tokens as operations."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from controller.kiosk.operations.fields import TEXT, CommandLine
from controller.kiosk.operations.operation import Effect, Names, operation
from controller.kiosk.roles import ACCOUNT_NAME, LONGEST_PASSWORD, Role

if TYPE_CHECKING:
    from controller.kiosk.store.accounts import Accounts as StoredAccounts

AccountName = Annotated[str, Field(pattern=ACCOUNT_NAME, max_length=32, description=(
    "1 to 32 lower-case letters, digits, dots, dashes, underscores; the first is a letter")), TEXT]  # fmt: skip
RoleName = Annotated[Literal["viewer", "operator", "technician"], Field(description="viewer, operator or technician"),
                     CommandLine(default="viewer")]  # fmt: skip
Password = Annotated[str, Field(max_length=LONGEST_PASSWORD, description="10 characters or more"), TEXT,
                     CommandLine(secret=True)]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Accounts:
    """What the operations on accounts need. ``open`` gives the accounts, and opens them at the first use;
    ``end_sessions`` ends the sessions of an account; ``hashing`` limits how many passwords are hashed at once.
    """

    open: Callable[[], StoredAccounts]
    end_sessions: Callable[[str], object] = lambda name: None
    hashing: contextlib.AbstractContextManager[Any] = field(default_factory=contextlib.nullcontext)


@dataclass(frozen=True, slots=True)
class AccountRow:
    """An account. ``role``: viewer, operator or technician; ``one_time``: its password has to be changed first."""

    name: str
    role: str
    one_time: bool


@dataclass(frozen=True, slots=True)
class TokenRow:
    """An API token without its secret. ``role`` as for an account."""

    name: str
    role: str
    made_unix_s: float


@dataclass(frozen=True, slots=True)
class NewToken:
    """The secret of a new API token. It is not stored, so it can't be read later."""

    token: str


@operation("GET /accounts", Role.TECHNICIAN, Effect.LOOKS, names=Names(part_of="kiosk account list"), offline=True)
def accounts(accounts: Accounts) -> Sequence[AccountRow]:
    """List the accounts."""
    return [AccountRow(row.name, row.role.name.lower(), row.one_time) for row in accounts.open().all()]


@operation("GET /tokens", Role.TECHNICIAN, Effect.LOOKS, names=Names(part_of="kiosk account list"), offline=True)
def tokens(accounts: Accounts) -> Sequence[TokenRow]:
    """List the API tokens, without their secrets."""
    return [TokenRow(row.name, row.role.name.lower(), row.made_unix_s) for row in accounts.open().tokens()]


@operation("POST /accounts", Role.TECHNICIAN, Effect.CHANGES, done="{name} may log in.",
           names=Names(command="account add"), offline=True)  # fmt: skip
def add_account(accounts: Accounts, name: AccountName, role: RoleName, password: Password) -> None:
    """Add an account."""
    with accounts.hashing:
        accounts.open().add(name, Role.named(role), password)


@operation("PUT /accounts/{name}/role", Role.TECHNICIAN, Effect.CHANGES, done="{name} has the role {role} now.",
           names=Names(command="account role"), offline=True)  # fmt: skip
def set_role(accounts: Accounts, name: AccountName, role: RoleName) -> None:
    """Change an account's role, and end its sessions."""
    accounts.open().set_role(name, Role.named(role))
    accounts.end_sessions(name)


@operation("PUT /accounts/{name}/password", Role.TECHNICIAN, Effect.CHANGES, done="The new password is in use.",
           names=Names(command="account password"), offline=True)  # fmt: skip
def set_password(accounts: Accounts, name: AccountName, password: Password) -> None:
    """Set a new password for an account, and end its sessions."""
    with accounts.hashing:
        accounts.open().set_password(name, password)
    accounts.end_sessions(name)


@operation("DELETE /accounts/{name}", Role.TECHNICIAN, Effect.CHANGES, done="{name} is removed.",
           asks="Remove the account {name}?", names=Names(command="account remove"), offline=True)  # fmt: skip
def remove_account(accounts: Accounts, name: AccountName) -> None:
    """Remove an account, and end its sessions."""
    accounts.open().remove(name)
    accounts.end_sessions(name)


@operation("POST /tokens", Role.TECHNICIAN, Effect.CHANGES, names=Names(command="account add-token"), offline=True)
def add_token(accounts: Accounts, name: AccountName, role: RoleName) -> NewToken:
    """Add an API token; it is shown only once."""
    return NewToken(accounts.open().add_token(name, Role.named(role)))


@operation("DELETE /tokens/{name}", Role.TECHNICIAN, Effect.CHANGES, done="The token {name} is removed.",
           asks="Remove the token {name}? Its programs are refused.", names=Names(command="account remove-token"),
           offline=True)  # fmt: skip
def remove_token(accounts: Accounts, name: AccountName) -> None:
    """Remove an API token."""
    accounts.open().remove_token(name)


ACCOUNT_OPERATIONS = (
    accounts, tokens, add_account, set_role, set_password, remove_account, add_token, remove_token
)  # fmt: skip
