"""Accounts and tokens as operations of the API; the panel's own page of them is in ``controller.panel.entrance``."""

from __future__ import annotations

from typing import Any, Final

from controller.panel.accounts import LONGEST_PASSWORD, NAME, Role
from controller.panel.context import Panel, Values
from controller.panel.fields import Field
from controller.panel.operation import Operation, done

TECHNICIAN: Final = Role.TECHNICIAN
_ABOUT: Final = "1 to 32 small letters, digits, dots, dashes; begins with a letter"
_NAME: Final = Field("name", _ABOUT, pattern=NAME, longest=32)
_NAME_IN_PATH: Final = Field("name", _ABOUT, pattern=NAME, longest=32, where="path")
_ROLE: Final = Field("role", "viewer, operator or technician", choices=("viewer", "operator", "technician"))
_PASSWORD: Final = Field("password", "10 characters or more", longest=LONGEST_PASSWORD)


def _accounts(panel: Panel, _: Values) -> Any:
    return [{"name": one.name, "role": one.role.name.lower(), "one_time": one.one_time} for one in panel.accounts.all()]


def _add(panel: Panel, values: Values) -> None:
    with panel.costly:
        panel.accounts.add(values["name"], Role.named(values["role"]), values["password"])


def _set_role(panel: Panel, values: Values) -> None:
    panel.accounts.set_role(values["name"], Role.named(values["role"]))
    panel.sessions.end_all(values["name"])


def _set_password(panel: Panel, values: Values) -> None:
    with panel.costly:
        panel.accounts.set_password(values["name"], values["password"])
    panel.sessions.end_all(values["name"])


def _remove(panel: Panel, values: Values) -> None:
    panel.accounts.remove(values["name"])
    panel.sessions.end_all(values["name"])


def _tokens(panel: Panel, _: Values) -> Any:
    return [
        {"name": one.name, "role": one.role.name.lower(), "made_unix_s": one.made_unix_s}
        for one in panel.accounts.tokens()
    ]


def _add_token(panel: Panel, values: Values) -> Any:
    return {"token": panel.accounts.add_token(values["name"], Role.named(values["role"]))}


ACCOUNT_QUESTIONS: Final = (
    Operation("accounts", "GET", "/accounts", TECHNICIAN, "Who may log in", _accounts),
    Operation("tokens", "GET", "/tokens", TECHNICIAN, "The machines' tokens, without what they show", _tokens),
)
ACCOUNT_COMMANDS: Final = (
    Operation("add-account", "POST", "/accounts", TECHNICIAN, "Make an account", done(_add),
              (_NAME, _ROLE, _PASSWORD)),
    Operation("set-role", "PUT", "/accounts/{name}/role", TECHNICIAN, "Change an account's role, and end its sessions",
              done(_set_role), (_NAME_IN_PATH, _ROLE)),
    Operation("set-password", "PUT", "/accounts/{name}/password", TECHNICIAN,
              "Give an account a new password, and end its sessions", done(_set_password), (_NAME_IN_PATH, _PASSWORD)),
    Operation("remove-account", "DELETE", "/accounts/{name}", TECHNICIAN, "Remove an account, and end its sessions",
              done(_remove), (_NAME_IN_PATH,)),
    Operation("add-token", "POST", "/tokens", TECHNICIAN, "Make a token; the answer shows it once", _add_token,
              (_NAME, _ROLE)),
    Operation("remove-token", "DELETE", "/tokens/{name}", TECHNICIAN, "Remove a token",
              done(lambda p, v: p.accounts.remove_token(v["name"])), (_NAME_IN_PATH,)),
)  # fmt: skip
