"""Values that hold where stage.toml says nothing, and where there is no stage.toml.

On their own because the solver needs them without pydantic.
"""

from __future__ import annotations

from typing import Final

SMOOTHNESS: Final = 0.0003
"""Strength of smoothness, relative to the mean diagonal of the data's majoriser: that with the least error on
calibrated stages (docs/decisions/0008)."""
