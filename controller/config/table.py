"""What the tables of a configuration file have in common: strictness, their place in the file, checked settings."""

from __future__ import annotations

import types
from collections.abc import Iterator, Mapping
from enum import Enum
from typing import Annotated, Any, Literal, Self, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, TypeAdapter, ValidationError

from controller.config.problems import Place, check_keys
from hal.toml_lines import KeyPath

Name = Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[^\x00-\x1f\x7f/\\]+$")]
Seconds = Annotated[float, Field(ge=0, le=86_400)]
Positive = Annotated[float, Field(gt=0)]
Size = Annotated[int, Field(ge=1, le=16_384)]
Offset = Annotated[int, Field(ge=0, le=16_384)]


def is_name(text: str) -> bool:
    """Whether a text is one that stage.toml may have for a name."""
    try:
        TypeAdapter(Name).validate_python(text)
    except ValidationError:
        return False
    return True


class Holds(Enum):
    """What a text of a configuration file is to a backup. A field that names a file has one of these in its type."""

    FILE = "a file that the stage reads"
    KEY_FILE = "a file with a secret, which is in no backup"
    SETTING = "a setting of a driver or of a kind of appearance, which may name a file"


StageFile = Annotated[str, Field(min_length=1), Holds.FILE]
KeyFile = Annotated[str, Field(min_length=1), Holds.KEY_FILE]


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


def texts(value: Any, path: KeyPath = (), holds: Holds | None = None) -> Iterator[tuple[KeyPath, str, Holds | None]]:
    """Every text in a table or a list and in those in it, with the way to it, and what it holds if that is known."""
    if isinstance(value, BaseModel):
        for key, field in type(value).model_fields.items():
            marks = (*field.metadata, *_marks(field.annotation))
            mark = next((one for one in marks if isinstance(one, Holds)), None)
            yield from texts(getattr(value, key), (*path, key), mark)
        yield from texts(value.model_extra or {}, path, Holds.SETTING)
    elif isinstance(value, Mapping):
        for key, inner in value.items():
            yield from texts(inner, (*path, str(key)), holds)
    elif isinstance(value, list | tuple):
        for number, inner in enumerate(value):
            yield from texts(inner, (*path, number), holds)
    elif isinstance(value, str):
        yield path, value, holds


def _marks(kind: Any) -> Iterator[Any]:
    yield from getattr(kind, "__metadata__", ())
    for inner in get_args(kind):
        yield from _marks(inner)


def _plain(value: Any) -> Any:
    """As TOML has it: lists, not tuples."""
    return [_plain(item) for item in value] if isinstance(value, tuple) else value


_NAMES: Mapping[Any, str] = {float: "a number", int: "a whole number", str: "text in quotes", bool: "true or false"}


def checked_arguments(place: Place, values: Mapping[str, Any], wanted: Mapping[str, Any]) -> dict[str, Any]:
    """``values`` of the table at ``place`` as the types in ``wanted`` have them; lists become tuples.

    Raises UsageError("stage-key-type") with the line. Numbers must be finite.
    """
    return {key: _checked(place, key, value, wanted[key]) for key, value in values.items()}


def allowed(kind: Any) -> str:
    """A type in words: ``a list of 3, each a number``."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Literal:
        return "one of " + ", ".join(f'"{word}"' for word in inner)
    if origin is tuple and inner[-1] is ...:
        return f"a list, each {allowed(inner[0])}"
    if origin is tuple:
        return f"a list of {len(inner)}, each {allowed(inner[0])}"
    if origin in (Union, types.UnionType):
        return " or ".join(allowed(part) for part in inner if part is not type(None))
    return _NAMES.get(kind, "left out")


def _checked(place: Place, key: str, value: Any, kind: Any) -> Any:
    try:
        adapter = TypeAdapter(kind, config=ConfigDict(strict=True, allow_inf_nan=False))
        return adapter.validate_python(_tuples(value))
    except ValidationError as error:
        raise place.wrong_type(key, value, "is not allowed", allowed(kind)) from error


def _tuples(value: Any) -> Any:
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value
