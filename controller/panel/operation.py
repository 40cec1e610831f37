"""What an operation is, and what one may answer; ``controller.panel.operations`` holds them all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Any

from controller.panel.accounts import Role
from controller.panel.context import Panel, Values
from controller.panel.fields import Field


@dataclass(frozen=True, slots=True)
class FileAnswer:
    """A file that the kiosk or the panel made; ``download`` its name where it is to be saved."""

    path: Path
    media_type: str
    download: str = ""


@dataclass(frozen=True, slots=True)
class BytesAnswer:
    content: bytes
    media_type: str


@dataclass(frozen=True, slots=True)
class Operation:
    """One thing that can be asked.

    ``path`` below /api/v1; ``upload`` names the field that is the request's whole body; ``media`` what a file answer
    is; ``then`` the page that a form goes on to, and ``said`` the sentence that it shows; empty ``then``: no form
    asks this
    """

    name: str
    method: str
    path: str
    role: Role
    about: str
    run: Callable[[Panel, Values], Any]
    fields: tuple[Field, ...] = ()
    media: str = "application/json"
    then: str = ""
    said: str = "Done."

    @property
    def upload(self) -> Field | None:
        return next((field for field in self.fields if field.kind == "file"), None)

    @property
    def changes(self) -> bool:
        return self.method != "GET"


def plain(value: Any) -> Any:
    """Values as JSON has them; paths are left out, since they are nobody's business."""
    if is_dataclass(value) and not isinstance(value, type):
        return {key: plain(inner) for key, inner in asdict(value).items() if not isinstance(inner, Path)}
    if isinstance(value, dict):
        return {str(key): plain(inner) for key, inner in value.items() if not isinstance(inner, Path)}
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    return value


def done(run: Callable[[Panel, Values], object]) -> Callable[[Panel, Values], Any]:
    """For commands that answer nothing."""

    def answered(panel: Panel, values: Values) -> Any:
        run(panel, values)
        return {"done": True}

    return answered
