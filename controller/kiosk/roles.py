"""Who may do what: the three roles, and what names and passwords of accounts look like."""

from __future__ import annotations

import enum
from typing import Final

from controller.core.errors import UsageError

ACCOUNT_NAME: Final = r"^[a-z][a-z0-9._-]{0,31}$"
LONGEST_PASSWORD: Final = 200
"""Longer ones only cost time to hash."""


class Role(enum.IntEnum):
    """What an account may do; each role may do all that the ones before it may."""

    VIEWER = 1
    OPERATOR = 2
    TECHNICIAN = 3

    @classmethod
    def named(cls, name: str) -> Role:
        """Raises UsageError("role-unknown")."""
        try:
            return cls[name.upper()]
        except KeyError:
            raise UsageError(
                "role-unknown", what=f"There is no role '{name}'.", remedy="Choose viewer, operator or technician."
            ) from None
