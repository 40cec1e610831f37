"""Accounts and tokens for the command line: those of the running panel, or the file where none runs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from controller.panel.accounts import Accounts, Role

FOLDER: Final = "kiosk/panel"
"""The panel's private files, in the stage's folder."""


def stage_accounts(stage: Path) -> Accounts:
    """As they lie on disk; for whoever knows that nobody else holds them. Raises UsageError("accounts-damaged")."""
    (stage / FOLDER).mkdir(mode=0o700, parents=True, exist_ok=True)
    return Accounts(stage / FOLDER / "accounts.json")


def account_operations(held: Callable[[], Accounts], ended: Callable[[str], object]) -> dict[str, Callable[..., Any]]:
    """By the names of the socket's ops. ``ended`` is told whose sessions have to end."""

    def accounts() -> Any:
        return [{"name": one.name, "role": one.role.name.lower(), "one_time": one.one_time} for one in held().all()]

    def tokens() -> Any:
        return [{"name": one.name, "role": one.role.name.lower(), "made_unix_s": one.made_unix_s}
                for one in held().tokens()]  # fmt: skip

    def add_account(name: str, role: str, password: str) -> None:
        held().add(name, Role.named(role), password)

    def set_role(name: str, role: str) -> None:
        held().set_role(name, Role.named(role))
        ended(name)

    def set_password(name: str, password: str) -> None:
        held().set_password(name, password)
        ended(name)

    def remove_account(name: str) -> None:
        held().remove(name)
        ended(name)

    def add_token(name: str, role: str) -> Any:
        return {"token": held().add_token(name, Role.named(role))}

    def remove_token(name: str) -> None:
        held().remove_token(name)

    table = (accounts, tokens, add_account, set_role, set_password, remove_account, add_token, remove_token)
    return {function.__name__.replace("_", "-"): function for function in table}
