"""The three roles, and the rules for names and passwords of accounts."""

from __future__ import annotations

import enum
from typing import Final

from controller.core.errors import UsageError

ACCOUNT_NAME: Final = r"^[a-z][a-z0-9._-]{0,31}$"
LONGEST_PASSWORD: Final = 200
"""Longer passwords only take longer to hash."""


class Role(enum.IntEnum):
    """What an account may do; each role includes the lower ones."""

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
