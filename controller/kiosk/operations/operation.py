"""What an operation is: everything that the HTTP API, the socket, the command line and MQTT need to offer it."""

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
    WORKS = "begins a job, which it answers"


class Answer(enum.Enum):
    """What comes back, with its media type in the API."""

    VALUE = "application/json"
    TEXT = "text"
    """Words; the API puts them into an object."""
    NOTHING = ""
    PICTURE = "image/png"
    """The path of a PNG or JPEG."""
    JPEG = "image/jpeg"
    """Bytes, or None where there is no picture now."""
    PAGE = "text/html"
    """The path of one HTML file."""
    FILE = "application/octet-stream"
    """The path of a file to be saved."""

    @property
    def media(self) -> str:
        return Answer.VALUE.value if self in (Answer.TEXT, Answer.NOTHING) else self.value


def values_as_they_are(values: Values) -> Mapping[str, Any]:
    return values


def whole_answer(answer: Any, values: Values) -> Any:
    return answer


@dataclass(frozen=True, slots=True)
class Operation:
    """One thing that can be asked. A declaration and a method of its holder are all that one needs.

    ``holder``: who has the method: the kiosk, its accounts, or the panel's uploaded targets (HTTP only); ``call``: the
    method, named as the operation where left out; ``take`` makes the method's arguments of the values, and ``part``
    takes of its answer what was asked for. ``offline``: ``api.folder.FolderKiosk`` can do it where no kiosk runs.
    ``http``: method and path below /api/v1, ``at_socket``: its name there, ``command``: its words on the command line,
    ``verb``: its name for building control; each follows from ``name`` where left out. ``within``: a command written by
    hand does it, among other things. ``said``: one sentence for people when it was done; values may stand in it.
    ``more``: sentences that the help says after ``about``
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
    offline: bool = False
    http: tuple[str, str] = ("", "")
    at_socket: str = ""
    command: str = ""
    within: str = ""
    verb: str = ""
    said: str = "Done."
    more: str = ""

    @property
    def method(self) -> str:
        """GET for what only looks and costs little."""
        return self.http[0] or ("GET" if self.effect is Effect.LOOKS else "POST")

    @property
    def path(self) -> str:
        return self.http[1] or f"/{self.name}"

    @property
    def socket_name(self) -> str:
        return self.at_socket or self.name

    @property
    def words(self) -> str:
        """The command, as it is typed after ``velatura``."""
        return self.within or self.command or self.name

    @property
    def building_verb(self) -> str:
        """Its name for building control; empty for what is not for it, which is all but what operators may show."""
        allowed = self.effect is Effect.SHOWS and self.role <= Role.OPERATOR and self.holder == "kiosk"
        return (self.verb or self.name) if allowed else ""

    @property
    def upload(self) -> Field | None:
        """The field that is the whole body of the request."""
        return next((field for field in self.fields if field.kind == "file"), None)

    @property
    def changes(self) -> bool:
        """Whether it is no mere GET."""
        return self.method != "GET"

    def where(self, field: Field) -> Where:
        """Where the field stands in a request."""
        if f"{{{field.name}}}" in self.path:
            return "path"
        if self.upload is not None and field.kind != "file":
            return "query"
        return "body" if self.changes else "query"

    def of(self, holder: Any, values: Values) -> Any:
        """Do it. Raises what the holder's method raises."""
        method = getattr(holder, self.call or self.name.replace("-", "_"))
        return self.part(method(**self.take(values)), values)

    def sentence(self, values: Values) -> str:
        """``said``, with the values in it."""
        return self.said.format_map(values)
