"""``velatura account``: people who may log in at the panel, and tokens for programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from controller.cli import console
from controller.cli.derived import commands
from controller.cli.running import Json, StageFolder

SUMMARY = "People who may log in at the stage's panel, and tokens for programs."


def list_(stage: StageFolder, as_json: Json = False) -> None:
    """List all accounts and tokens."""
    accounts, tokens = _call(stage, "accounts"), _call(stage, "tokens")
    lines = [
        f"{account['name']:<32} {account['role']}{', one-time password' if account['one_time'] else ''}"
        for account in accounts
    ]
    lines += [f"{token['name']:<32} {token['role']}, token" for token in tokens]
    found = {"accounts": accounts, "tokens": tokens}
    console.show_result(found if as_json else "\n".join(lines) or "There are none yet.", as_json=as_json)


def _call(stage: Path, op: str) -> Any:
    from controller.kiosk.api.offline_dispatch import call

    return call(stage, op)


list_.__name__ = "list"
COMMANDS = (list_, *commands("account"))
