"""The fields of a request, as the functions of operations declare them; pydantic checks and describes them."""

from __future__ import annotations

import enum
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, Final, Literal, get_args, get_origin

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, ValidationError, create_model
from pydantic.fields import FieldInfo
from pydantic.json_schema import GenerateJsonSchema

from controller.core.errors import UsageError

NEW_NAME: Final = r"^[A-Za-z0-9\u00C0-\u024F][A-Za-z0-9\u00C0-\u024F_-]{0,63}$"
NAME: Final = r"^[A-Za-z0-9\u00C0-\u024F][A-Za-z0-9\u00C0-\u024F ._-]{0,63}$"
"""Names that are used in URLs and file names."""
LONGEST_PATH: Final = 4096

_NO_TEXT: Final = re.compile("[\\x00\\ud800-\\udfff]")
"""JSON can contain half a UTF-16 character, but no file and no answer can."""
_NUMBER: Final = re.compile(r"-?[0-9]{1,15}(\.[0-9]{1,15})?", re.ASCII)

Values = dict[str, Any]
"""Checked values by the names of the fields."""


def _printable(text: str) -> str:
    if _NO_TEXT.search(text):
        raise ValueError("not a text")
    # Browsers send the text of a form with CRLF line ends.
    return text.replace("\r\n", "\n")


def _whole(number: Any) -> Any:
    """2.0 as 2: in JSON they are the same number."""
    return int(number) if isinstance(number, float) and number.is_integer() else number


TEXT: Final = AfterValidator(_printable)
"""For a ``str``: without characters that no file can contain."""
INTEGER: Final = BeforeValidator(_whole)
"""For an ``int``."""
NUMBER: Final = AfterValidator(_whole)
"""For a ``float``: whole numbers are shown without a point."""


class Sent(enum.Enum):
    """What the HTTP API sends for an argument that is a path everywhere else."""

    FILE = "the file, as the whole body of the request"
    TARGET = "the key of an uploaded target"


TARGET_KEY: Final = r"^[0-9a-f]{24}$"


@dataclass(frozen=True, slots=True)
class Flag:
    """An option for a field with two values: with ``option`` it is ``value``, without it ``otherwise``."""

    option: str
    about: str
    value: Any
    otherwise: Any


@dataclass(frozen=True, slots=True)
class CommandLine:
    """How the command line asks for a field. By default a required field is an argument, and any other an option.

    ``argument``: an argument, although it is not required; ``flag``: an option without a value; ``default`` of a
    required field, which is an option then; ``completes``: the names that the shell completes; ``secret``: the input is
    hidden; ``metavar``: the argument's name in the help
    """

    argument: bool = False
    flag: Flag | None = None
    default: str = ""
    completes: Literal["", "appearance", "projector"] = ""
    secret: bool = False
    metavar: str = ""


@dataclass(frozen=True, eq=False)
class Field:
    """One argument of an operation. ``hint`` is the type in the function's signature, without None."""

    name: str
    hint: Any
    required: bool

    @property
    def kind(self) -> type:
        """str, int, float, bool, list or Path."""
        kind = get_args(self.hint)[0] if hasattr(self.hint, "__metadata__") else self.hint
        return str if get_origin(kind) is Literal else get_origin(kind) or kind

    @property
    def about(self) -> str:
        """What may be given, as the document and the help say it."""
        return next((about for info in self._noted(FieldInfo) if (about := info.description)), "")

    @property
    def choices(self) -> tuple[str, ...]:
        """The allowed texts; empty for any."""
        kind = get_args(self.hint)[0] if hasattr(self.hint, "__metadata__") else self.hint
        return get_args(kind) if get_origin(kind) is Literal else ()

    @property
    def sent(self) -> Sent | None:
        return next(iter(self._noted(Sent)), None)

    @property
    def command_line(self) -> CommandLine:
        return next(iter(self._noted(CommandLine)), CommandLine())

    @property
    def schema(self) -> dict[str, Any]:
        """JSON Schema of the value."""
        return dict(object_schema((self,))["properties"][self.name])

    def _noted(self, kind: type[Any]) -> list[Any]:
        return [note for note in getattr(self.hint, "__metadata__", ()) if isinstance(note, kind)]


class PlainSchema(GenerateJsonSchema):
    """A schema without titles, which only repeat names, and without defaults, which the descriptions say."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False

    def default_schema(self, schema: Any) -> Any:
        return self.generate_inner(schema["schema"])

    def model_schema(self, schema: Any) -> Any:
        return {key: value for key, value in super().model_schema(schema).items() if key != "title"}

    def dataclass_schema(self, schema: Any) -> Any:
        return {key: value for key, value in super().dataclass_schema(schema).items() if key != "title"}


def object_schema(fields: Sequence[Field]) -> dict[str, Any]:
    """The JSON Schema of an object with these fields and no others; ``$defs`` has the objects in it."""
    model = _model(tuple(fields), paths=False)
    schema = model.model_json_schema(schema_generator=PlainSchema, ref_template="#/components/schemas/{model}")
    return {"required": [], **schema}


@cache
def _model(fields: tuple[Field, ...], *, paths: bool) -> type[BaseModel]:
    hints: dict[str, Any] = {}
    for field in fields:
        hint = field.hint
        if field.sent is not None:
            info = FieldInfo(description=field.about, max_length=LONGEST_PATH)
            if not paths:
                info = FieldInfo(description=field.about, pattern=TARGET_KEY)
            hint = Annotated[str, info, TEXT]
        hints[field.name] = (hint, ... if field.required else None)
    return create_model("Values", __config__=ConfigDict(extra="forbid", strict=True), **hints)


def missing(name: str, about: str) -> UsageError:
    """The error for a required field that was not sent."""
    return UsageError("field-missing", what=f"'{name}' is missing.", remedy=f"Give {about}.")


def parse(fields: Sequence[Field], sent: Mapping[str, Any], *, strings: bool, paths: bool = False) -> Values:
    """The checked values of ``sent``; missing fields are omitted.

    ``strings`` True if all values are text (forms, URLs): numbers are then read from text, an empty text counts as
    omitted, and a missing boolean is False. ``paths``: files and targets are given as paths, not as keys of uploads.
    Raises UsageError("field-unknown", "field-missing", "field-wrong").
    """
    values = _from_text(fields, sent) if strings else sent
    try:
        checked = _model(tuple(fields), paths=paths).model_validate(dict(values))
    except ValidationError as error:
        raise _refusal(fields, error) from None
    return {field.name: getattr(checked, field.name) for field in fields if field.name in checked.model_fields_set}


def _from_text(fields: Sequence[Field], sent: Mapping[str, Any]) -> dict[str, Any]:
    values = dict(sent)
    for field in fields:
        text = values.get(field.name)
        if field.kind is bool and text in (None, "", "on", "true", "false"):
            values[field.name] = text in ("on", "true")
        elif text == "" and not (field.required and field.kind is str and "pattern" not in field.schema):
            del values[field.name]
        elif field.kind in (int, float) and isinstance(text, str) and _NUMBER.fullmatch(text):
            values[field.name] = float(text) if "." in text else int(text)
    return values


def _refusal(fields: Sequence[Field], error: ValidationError) -> UsageError:
    """What pydantic found first, in the words of the API; an unknown field before all others, and without its name."""
    problems = error.errors(include_url=False, include_context=False, include_input=False)
    problem = next((each for each in problems if each["type"] == "extra_forbidden"), problems[0])
    place = [part for part in problem["loc"] if isinstance(part, str)]
    allowed = {field.name: field.about for field in fields}
    if len(place) > 1:  # a field of a row
        rows = object_schema(fields)["$defs"].values()
        allowed = {name: about["description"] for row in rows for name, about in row["properties"].items()}
    if problem["type"] == "extra_forbidden":
        remedy = f"Allowed here: {', '.join(allowed)}." if allowed else "No fields are allowed here."
        return UsageError("field-unknown", what="The request has an unknown field.", remedy=remedy)
    name = place[-1]
    if problem["type"] == "missing":
        return missing(name, allowed[name])
    number = next((part + 1 for part in problem["loc"] if isinstance(part, int)), None)
    row = "" if number is None else f" in row {number}"
    return UsageError(
        "field-wrong", what=f"The value of '{name}'{row} is not valid.", remedy=f"Allowed: {allowed[name]}."
    )
