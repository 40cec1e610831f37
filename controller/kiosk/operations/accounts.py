"""Accounts and tokens as operations; ``AccountActions`` implements them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from controller.kiosk.operations.fields import Field
from controller.kiosk.operations.operation import Answer, Effect, Operation
from controller.kiosk.roles import ACCOUNT_NAME, LONGEST_PASSWORD, Role

if TYPE_CHECKING:
    from controller.kiosk.store.accounts import Accounts

_NAME: Final = Field(
    "name", "1 to 32 lower-case letters, digits, dots, dashes, underscores; the first is a letter",
    pattern=ACCOUNT_NAME, longest=32,
)  # fmt: skip
_ROLE: Final = Field("role", "viewer, operator or technician", choices=("viewer", "operator", "technician"),
                     usual="viewer")  # fmt: skip
_PASSWORD: Final = Field("password", "10 characters or more", longest=LONGEST_PASSWORD, secret=True)


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


class AccountActions:
    """The operations on accounts and tokens. ``held`` opens the accounts at the first use; ``ended`` ends the sessions
    of an account; ``costly`` limits how many passwords are hashed at the same time.
    """

    def __init__(
        self, held: Callable[[], Accounts], ended: Callable[[str], object],
        costly: contextlib.AbstractContextManager[Any] | None = None,
    ) -> None:  # fmt: skip
        self._held, self._ended = held, ended
        self._costly = costly or contextlib.nullcontext()

    def accounts(self) -> Sequence[AccountRow]:
        return [AccountRow(row.name, row.role.name.lower(), row.one_time) for row in self._held().all()]

    def tokens(self) -> Sequence[TokenRow]:
        return [TokenRow(row.name, row.role.name.lower(), row.made_unix_s) for row in self._held().tokens()]

    def add_account(self, name: str, role: str, password: str) -> None:
        with self._costly:
            self._held().add(name, Role.named(role), password)

    def set_role(self, name: str, role: str) -> None:
        self._held().set_role(name, Role.named(role))
        self._ended(name)

    def set_password(self, name: str, password: str) -> None:
        with self._costly:
            self._held().set_password(name, password)
        self._ended(name)

    def remove_account(self, name: str) -> None:
        self._held().remove(name)
        self._ended(name)

    def add_token(self, name: str, role: str) -> NewToken:
        return NewToken(self._held().add_token(name, Role.named(role)))

    def remove_token(self, name: str) -> None:
        self._held().remove_token(name)


def _declared(name: str, about: str, effect: Effect, **more: Any) -> Operation:
    return Operation(name, about, Role.TECHNICIAN, effect, holder="accounts", offline=True, **more)


ACCOUNT_OPERATIONS: Final = (
    _declared("accounts", "List the accounts", Effect.LOOKS, within="kiosk account list"),
    _declared("tokens", "List the API tokens, without their secrets", Effect.LOOKS, within="kiosk account list"),
    _declared("add-account", "Add an account", Effect.CHANGES, fields=(_NAME, _ROLE, _PASSWORD),
              answer=Answer.NOTHING, http=("POST", "/accounts"), command="account add", said="{name} may log in."),
    _declared("set-role", "Change an account's role, and end its sessions", Effect.CHANGES, fields=(_NAME, _ROLE),
              answer=Answer.NOTHING, http=("PUT", "/accounts/{name}/role"), command="account role",
              said="{name} has the role {role} now."),
    _declared("set-password", "Set a new password for an account, and end its sessions", Effect.CHANGES,
              fields=(_NAME, _PASSWORD), answer=Answer.NOTHING, http=("PUT", "/accounts/{name}/password"),
              command="account password", said="The new password is in use."),
    _declared("remove-account", "Remove an account, and end its sessions", Effect.CHANGES, fields=(_NAME,),
              answer=Answer.NOTHING, http=("DELETE", "/accounts/{name}"), command="account remove",
              said="{name} is removed.", asks="Remove the account {name}?"),
    _declared("add-token", "Add an API token; it is shown only once", Effect.CHANGES, fields=(_NAME, _ROLE),
              http=("POST", "/tokens"), command="account add-token"),
    _declared("remove-token", "Remove an API token", Effect.CHANGES, fields=(_NAME,), answer=Answer.NOTHING,
              http=("DELETE", "/tokens/{name}"), command="account remove-token", said="The token {name} is removed.",
              asks="Remove the token {name}? Its programs are refused."),
)  # fmt: skip
