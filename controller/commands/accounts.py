"""``velatura account``: who may log in at the panel, and the tokens of machines."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from controller import console
from controller.commands.running import Json, StageFolder

SUMMARY = "Who may log in at the stage's panel, and the tokens of machines."
Name = Annotated[str, typer.Argument(help="The account's or token's name.")]
Role = Annotated[str, typer.Option(help="viewer, operator or technician.")]


def list_(stage: StageFolder, as_json: Json = False) -> None:
    """All accounts and tokens."""
    accounts, tokens = _call(stage, "accounts"), _call(stage, "tokens")
    lines = [f"{one['name']:<32} {one['role']}{', one-time password' if one['one_time'] else ''}" for one in accounts]
    lines += [f"{one['name']:<32} {one['role']}, token" for one in tokens]
    found = {"accounts": accounts, "tokens": tokens}
    console.show_result(found if as_json else "\n".join(lines) or "There are none yet.", as_json=as_json)


def add(stage: StageFolder, name: Name, role: Role = "viewer", as_json: Json = False) -> None:
    """Make an account; its password is asked for, or read from standard input."""
    _done(stage, "add-account", f"{name} may log in.", as_json=as_json, name=name, role=role, password=_password())


def password(stage: StageFolder, name: Name, as_json: Json = False) -> None:
    """Give an account a new password; it is asked for, or read from standard input."""
    _done(stage, "set-password", "The new password is in use.", as_json=as_json, name=name, password=_password())


def role(stage: StageFolder, name: Name, role: Role = "viewer", as_json: Json = False) -> None:
    """Change what an account may do."""
    _done(stage, "set-role", f"{name} is {role} now.", as_json=as_json, name=name, role=role)


def remove(stage: StageFolder, name: Name, as_json: Json = False) -> None:
    """Remove an account."""
    _done(stage, "remove-account", f"{name} is removed.", as_json=as_json, name=name)


def add_token(stage: StageFolder, name: Name, role: Role = "viewer", as_json: Json = False) -> None:
    """Make a token for a machine, and print it; it is shown only now."""
    made = _call(stage, "add-token", name=name, role=role)
    console.show_result(made if as_json else made["token"], as_json=as_json)


def remove_token(stage: StageFolder, name: Name, as_json: Json = False) -> None:
    """Remove a token."""
    _done(stage, "remove-token", f"The token {name} is removed.", as_json=as_json, name=name)


def _password() -> str:
    if sys.stdin.isatty():
        return str(typer.prompt("New password", hide_input=True, confirmation_prompt=True))
    return sys.stdin.readline().rstrip("\n")


def _call(stage: Path, op: str, **arguments: Any) -> Any:
    from controller.serve.direct import call

    return call(stage, op, **arguments)


def _done(stage: Path, op: str, sentence: str, *, as_json: bool, **arguments: Any) -> None:
    _call(stage, op, **arguments)
    console.show_result({"done": op} if as_json else sentence, as_json=as_json)


list_.__name__ = "list"
COMMANDS = (list_, add, password, role, remove, add_token, remove_token)
