"""The declaration of an operation: all that HTTP, socket, command line and MQTT need to offer it."""

from __future__ import annotations

import enum
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from controller.kiosk.operations.fields import Field
from controller.kiosk.roles import Role

Values = dict[str, Any]
"""Checked values by the names of the fields."""
Where = Literal["body", "path", "query"]
Holder = Literal["kiosk", "accounts", "targets"]


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
    """Bytes, or None if there is no picture now."""
    PAGE = "text/html"
    """The path of one HTML file."""
    FILE = "application/octet-stream"
    """The path of a file to download."""

    @property
    def media(self) -> str:
        return Answer.VALUE.value if self in (Answer.TEXT, Answer.NOTHING) else self.value


def values_as_they_are(values: Values) -> Mapping[str, Any]:
    return values


def whole_answer(answer: Any, values: Values) -> Any:
    return answer


@dataclass(frozen=True, slots=True)
class Operation:
    """One operation. It needs only this declaration and a method of its holder.

    ``holder``: the object with the method: the kiosk, its accounts, or the panel's uploaded targets (HTTP only);
    ``call``: the method's name; ``take`` makes its arguments from the values, ``part`` selects from its result;
    ``gives``: the type of what ``part`` returns, where the method returns another.
    ``offline``: ``api.folder.FolderKiosk`` has it, for use without a running kiosk. ``http``: method and path below
    /api/v1; ``at_socket``, ``command``, ``verb``: its name at the socket, on the command line and for building control.
    All names default to ``name``; the command follows "kiosk". ``within``: the command that includes it, or does more.
    ``said``: the sentence shown when it is done, with the values as format fields; ``more``: what the help says after
    ``about``;
    ``asks``: the question that a person has to answer with yes before, with the values as format fields
    """

    name: str
    about: str
    role: Role
    effect: Effect
    fields: tuple[Field, ...] = ()
    answer: Answer = Answer.VALUE
    holder: Holder = "kiosk"
    call: str = ""
    take: Callable[[Values], Mapping[str, Any]] = values_as_they_are
    part: Callable[[Any, Values], Any] = whole_answer
    gives: Any = None
    offline: bool = False
    http: tuple[str, str] = ("", "")
    at_socket: str = ""
    command: str = ""
    within: str = ""
    verb: str = ""
    said: str = "Done."
    more: str = ""
    asks: str = ""

    @property
    def method(self) -> str:
        """By default GET if it changes nothing."""
        return self.http[0] or ("GET" if self.effect is Effect.LOOKS else "POST")

    @property
    def path(self) -> str:
        return self.http[1] or f"/{self.name}"

    @property
    def socket_name(self) -> str:
        return self.at_socket or self.name

    @property
    def words(self) -> str:
        """The command after ``velatura``: a verb of ``velatura kiosk``, if it is not ``within`` another."""
        return self.within or f"kiosk {self.command or self.name}"

    @property
    def building_verb(self) -> str:
        """Its name for building control, which may only change what the stage shows; else empty."""
        allowed = self.effect is Effect.SHOWS and self.role <= Role.OPERATOR and self.holder == "kiosk"
        return (self.verb or self.name) if allowed else ""

    @property
    def upload(self) -> Field | None:
        """The field that is the whole body of the request."""
        return next((field for field in self.fields if field.kind == "file"), None)

    @property
    def changes(self) -> bool:
        """Whether its method is not GET."""
        return self.method != "GET"

    def where(self, field: Field) -> Where:
        """The place of the field in a request."""
        if f"{{{field.name}}}" in self.path:
            return "path"
        if self.upload is not None and field.kind != "file":
            return "query"
        return "body" if self.changes else "query"

    def of(self, holder: Any, values: Values) -> Any:
        """Call the holder's method. Raises what it raises."""
        method = getattr(holder, self.call or self.name.replace("-", "_"))
        return self.part(method(**self.take(values)), values)

    def question(self, values: Values) -> str:
        """``asks``, with the values in it; empty if it does not ask."""
        return self.asks.format_map(values)

    def done_by(self, who: str, values: Values) -> str:
        """A line for the event log; it has names, and no other values."""
        named = ", ".join(str(values[key]) for key in ("name", "projector", "role", "kind") if values.get(key))
        return f"{who}: {self.about} ({named})." if named else f"{who}: {self.about}."

    def sentence(self, values: Values) -> str:
        """``said``, with the values in it."""
        return self.said.format_map(values)
