"""An operation: a function on the kiosk, and what HTTP, socket, command line and building control need to offer it."""

from __future__ import annotations

import contextlib
import enum
import inspect
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Final, Literal, get_type_hints

from controller.kiosk.operations.fields import Field, Sent, Values
from controller.kiosk.roles import Role
from controller.kiosk.state import EventLevel
from hal.errors import CodedError

Where = Literal["body", "path", "query"]
Record = Callable[[str, str, EventLevel], object]
"""Adds a line to the event log: code, text, level."""


class Effect(enum.Enum):
    """What an operation changes."""

    LOOKS = "changes nothing"
    SHOWS = "changes what the stage shows now, and nothing that is kept"
    CHANGES = "changes what is kept"
    WORKS = "starts a job and returns it"


class Answer(enum.Enum):
    """The kind of result, with its media type in the API."""

    VALUE = "application/json"
    TEXT = "text"
    """Text; the API returns it in an object."""
    NOTHING = ""
    PICTURE = "image/png"
    """The path of a PNG or JPEG."""
    JPEG = "image/jpeg"
    """Bytes, or None if none exists now."""
    PAGE = "text/html"
    """The path of one HTML file."""
    FILE = "application/octet-stream"
    """The path of a file to download."""

    @property
    def media(self) -> str:
        return Answer.VALUE.value if self in (Answer.TEXT, Answer.NOTHING) else self.value


Picture = Annotated[Path | None, Answer.PICTURE]
Jpeg = Annotated[bytes | None, Answer.JPEG]
Page = Annotated[Path, Answer.PAGE]
Download = Annotated[Path, Answer.FILE]


@dataclass(frozen=True, slots=True)
class Names:
    """The names of an operation, where they differ from its function's: ``name``, and at the ``socket``, as a
    ``command`` after "kiosk", and as a ``verb`` of building control. ``part_of``: the command that includes it.
    """

    name: str = ""
    socket: str = ""
    command: str = ""
    part_of: str = ""
    verb: str = ""


@dataclass(frozen=True, eq=False)
class Operation:
    """One operation; ``operation`` makes it of a function.

    The function's first parameter is what it works on (``holder``): ``kiosk``, ``accounts``, or ``targets``, the
    panel's uploads (HTTP only). The others are the fields of a request. What it returns says the kind of answer, and
    its docstring what it does. ``http``: method and path below /api/v1, such as "POST /play". ``offline``:
    ``api.folder.FolderKiosk`` has it, for use without a running kiosk. ``done``: the sentence that is shown when it is
    done, and ``asks``: the question that a person has to answer with yes before; both with the values as format fields.
    """

    function: Callable[..., Any]
    http: str
    role: Role
    effect: Effect
    done: str
    asks: str
    names: Names
    offline: bool

    @property
    def name(self) -> str:
        return self.names.name or self.function.__name__.replace("_", "-")

    @cached_property
    def _sentences(self) -> tuple[str, str]:
        about, _, more = " ".join((self.function.__doc__ or "").split()).partition(". ")
        return about.removesuffix("."), more

    @property
    def about(self) -> str:
        """The first sentence of its description, without a full stop."""
        return self._sentences[0]

    @property
    def more(self) -> str:
        """The rest of its description, which the help adds."""
        return self._sentences[1]

    @cached_property
    def _hints(self) -> dict[str, Any]:
        return get_type_hints(self.function, include_extras=True)

    @cached_property
    def holder(self) -> str:
        return next(iter(inspect.signature(self.function).parameters))

    @cached_property
    def fields(self) -> tuple[Field, ...]:
        _, *parameters = inspect.signature(self.function).parameters.values()
        return tuple(
            Field(one.name, _without_none(self._hints[one.name]), one.default is inspect.Parameter.empty)
            for one in parameters
        )

    @property
    def returns(self) -> Any:
        """The type of its result."""
        return self._hints["return"]

    @property
    def answer(self) -> Answer:
        plain = {NoneType: Answer.NOTHING, str: Answer.TEXT}
        notes = getattr(self.returns, "__metadata__", ())
        return next((note for note in notes if isinstance(note, Answer)), plain.get(self.returns, Answer.VALUE))

    @property
    def method(self) -> str:
        return self.http.partition(" ")[0]

    @property
    def path(self) -> str:
        return self.http.partition(" ")[2]

    @property
    def socket_name(self) -> str:
        return self.names.socket or self.name

    @property
    def words(self) -> str:
        """The command after ``velatura``: a verb of ``velatura kiosk``, if it is not part of another."""
        return self.names.part_of or f"kiosk {self.names.command or self.name}"

    @property
    def building_verb(self) -> str:
        """Its name for building control, which may only change what the stage shows; else empty."""
        allowed = self.effect is Effect.SHOWS and self.role <= Role.OPERATOR and self.holder == "kiosk"
        return (self.names.verb or self.name) if allowed else ""

    @cached_property
    def upload(self) -> Field | None:
        """The field that is the whole body of the request."""
        return next((field for field in self.fields if field.sent is Sent.FILE), None)

    @property
    def changes(self) -> bool:
        """Whether its method is not GET."""
        return self.method != "GET"

    def where(self, field: Field) -> Where:
        """The place of the field in a request."""
        if f"{{{field.name}}}" in self.path:
            return "path"
        if self.upload is not None and field is not self.upload:
            return "query"
        return "body" if self.changes else "query"

    def question(self, values: Values) -> str:
        """``asks``, with the values in it; empty if it does not ask."""
        return self.asks.format_map(values)

    def sentence(self, values: Values) -> str:
        """``done``, with the values in it."""
        return self.done.format_map(values)

    @contextlib.contextmanager
    def logged(self, record: Record, who: str, values: Values) -> Iterator[None]:
        """Log that ``who`` did it, once it is done, or that it was refused; nothing if it only looks. The line has
        names, and no other values.
        """
        named = ", ".join(str(values[key]) for key in ("name", "projector", "role", "kind") if values.get(key))
        line = f"{who}: {self.about} ({named})." if named else f"{who}: {self.about}."
        changes = self.effect is not Effect.LOOKS
        try:
            yield
        except Exception as error:
            if changes:
                reason = (
                    error.what if isinstance(error, CodedError) else f"An unexpected error ({type(error).__name__})."
                )
                record("refused", f"{line} Refused: {reason}", "warning")
            raise
        if changes:
            record("done-by", line, "info")


_PLAIN: Final = Names()


def operation(
    http: str, role: Role, effect: Effect, *, done: str = "Done.", asks: str = "", names: Names = _PLAIN,
    offline: bool = False,
) -> Callable[[Callable[..., Any]], Operation]:  # fmt: skip
    """Make an operation of the function below; see ``Operation``."""

    def declared(function: Callable[..., Any]) -> Operation:
        return Operation(function, http, role, effect, done, asks, names, offline)

    return declared


def _without_none(hint: Any) -> Any:
    """``X`` of ``X | None``."""
    kinds = [kind for kind in getattr(hint, "__args__", ()) if kind is not NoneType]
    optional = not hasattr(hint, "__metadata__") and NoneType in getattr(hint, "__args__", ())
    return kinds[0] if optional else hint
