"""What the tables of a configuration file have in common: strictness, and where they stand in their file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field, PrivateAttr

from controller.config.problems import Place, check_keys

Name = Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[^\x00-\x1f\x7f/\\]+$")]
Seconds = Annotated[float, Field(ge=0, le=86_400)]
Positive = Annotated[float, Field(gt=0)]
Size = Annotated[int, Field(ge=1, le=16_384)]


class ConfigTable(BaseModel):
    """A table of stage.toml; knows where it stands in the file."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)
    _place: Place | None = PrivateAttr(default=None)

    @property
    def place(self) -> Place:
        """Where errors about this table's keys point to."""
        if self._place is None:
            raise ValueError("this table was not read from a file")
        return self._place

    def placed(self, place: Place) -> Self:
        self._place = place
        return self


class OpenConfigTable(ConfigTable):
    """A table with further keys that only somebody else understands: a driver, or a kind of appearance."""

    model_config = ConfigDict(strict=True, frozen=True, extra="allow", allow_inf_nan=False)

    def settings(self, allowed: Mapping[str, str], required: tuple[str, ...] = ()) -> dict[str, Any]:
        """The keys written in this table that the other side understands, Velatura's own among them, checked.

        ``allowed`` maps each key to what it may be. Raises UsageError("stage-key-unknown", "stage-key-missing").
        """
        written = {key: _plain(value) for key, value in self.model_dump(exclude_unset=True).items()}
        own = {key: field.description or "" for key, field in type(self).model_fields.items()}
        check_keys(self.place, written, {**own, **allowed}, required)
        return {key: value for key, value in written.items() if key in allowed}


def _plain(value: Any) -> Any:
    """As TOML has it: lists, not tuples."""
    return [_plain(item) for item in value] if isinstance(value, tuple) else value
