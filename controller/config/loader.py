"""Reading stage.toml: syntax, keys, and what must agree between tables."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from controller.config.models import AlertsTable, CameraTable, ConfigTable, OpenConfigTable, StageTables
from controller.config.problems import Place
from controller.core.errors import UsageError
from controller.core.files import UnfitFile, read_bytes
from controller.core.text import printable
from hal.registry import Driver
from hal.toml_lines import KeyLines, KeyPath

Tables = TypeVar("Tables", bound=ConfigTable)
LARGEST_BYTES: Final = 1 << 20
FILE: Final = "stage.toml"


@dataclass(frozen=True, slots=True)
class Stage:
    """A stage folder and what its stage.toml says."""

    folder: Path
    tables: StageTables

    def path(self, relative: str) -> Path:
        """A path of stage.toml; relative ones start at the stage's folder."""
        return self.folder / relative


def load_stage(path: Path, *, instead: Path | None = None) -> Stage:
    """Read ``path``: a stage folder or its stage.toml. ``instead``: the file that is read in the place of stage.toml.

    Raises UsageError with code "stage-missing", "stage-unreadable", "stage-syntax", "stage-key-unknown",
    "stage-key-missing", "stage-key-type" or "stage-key-value"; all but the first two name the line.
    """
    file = path / FILE if path.is_dir() else path
    content, place = read_toml(instead or file)
    return Stage(file.parent.resolve(), parse_stage(content, place))


def read_toml(file: Path, kind: str = "stage") -> tuple[dict[str, Any], Place]:
    """The content of a TOML file, and the place for errors about it.

    ``kind``: what the file is of, which the errors' codes begin with. Raises UsageError "<kind>-missing",
    "<kind>-unreadable", "<kind>-syntax".
    """
    text = _text(file, kind)
    try:
        return tomllib.loads(text), Place(file.name, KeyLines(text), kind=kind)
    except (ValueError, RecursionError) as error:
        raise _syntax(file, error, kind) from error


def parse_stage(content: Mapping[str, Any], place: Place) -> StageTables:
    """Check the parsed content of a stage.toml that stands at ``place``. Raises as ``load_stage``."""
    tables = parse_tables(StageTables, content, place)
    _check_agreement(tables)
    return tables


def parse_tables(model: type[Tables], content: Mapping[str, Any], place: Place) -> Tables:
    """Check the parsed content of a file whose root table is ``model``.

    Raises UsageError "<kind>-key-unknown", "<kind>-key-missing", "<kind>-key-type", "<kind>-key-value" with the line.
    """
    try:
        tables = model.model_validate(dict(content))
    except ValidationError as invalid:
        raise _first_problem(invalid, place, model) from invalid
    for path, table in _tables(tables, ()):
        table.placed(place.at(*path))
    return tables


def check_driver_settings(table: OpenConfigTable, driver: Driver) -> dict[str, Any]:
    """The settings with which to open ``driver``, checked against what it understands.

    Raises UsageError("stage-key-unknown") or UsageError("stage-key-missing") with the line.
    """
    return table.settings(driver.settings, driver.required)


_EXAMPLES: Final = {
    "stage": "Give the stage's folder, which contains stage.toml; `velatura demo --prepare-only` writes an example.",
    "plan": "Give a file that describes the plan; `velatura plan --example` writes one.",
}


def _text(file: Path, kind: str) -> str:
    try:
        data = read_bytes(file, LARGEST_BYTES)
    except FileNotFoundError as error:
        raise UsageError(f"{kind}-missing", what=f"There is no {file}.", remedy=_EXAMPLES[kind]) from error
    except UnfitFile as error:
        raise _unreadable(file, f"can't be read: {error.strerror}", "Give a text file.", kind) from error
    except OSError as error:
        raise _unreadable(file, f"can't be read: {error.strerror}", "Check the file's permissions.", kind) from error
    try:
        return data.decode("utf-8-sig")  # some editors on Windows put a byte order mark before the text
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise _unreadable(file, f"is not UTF-8 text (line {line})", "Save it as text in UTF-8.", kind) from error


def _unreadable(file: Path, problem: str, remedy: str, kind: str) -> UsageError:
    return UsageError(f"{kind}-unreadable", what=f"{file} {problem}.", remedy=remedy)


def _syntax(file: Path, error: Exception, kind: str) -> UsageError:
    message = printable(str(error)) or "it is nested too deeply"
    where = re.search(r" \(at (?:line (\d+), column (\d+)|end of document)\)$", message)
    line = f", line {where[1]}" if where and where[1] else ", at its end" if where else ""
    problem = message[: where.start()] if where else message
    return UsageError(
        f"{kind}-syntax",
        what=f"{file.name}{line} is not valid TOML: {problem}.",
        remedy='Correct the line; text needs quotes (name = "left"), and tables need brackets ([camera], '
        "[[projectors]]).",
    )


def _first_problem(invalid: ValidationError, place: Place, root: type[BaseModel]) -> UsageError:
    """The problem that stands first in the file; but a misspelt key before the missing one that it stands for."""
    found = invalid.errors(include_url=False)
    # A list whose only item is wrong counts as empty too.
    inside = {tuple(one["loc"][:depth]) for one in found for depth in range(1, len(one["loc"]))}
    problems = [one for one in found if one["type"] != "too_short" or tuple(one["loc"]) not in inside]
    first = min(problems, key=lambda one: (one["type"] != "extra_forbidden", place.lines.line(tuple(one["loc"]))))
    return _problem(first, place, root)


_PROBLEMS: Final = {
    "int_type": "is not a whole number",
    "float_type": "is not a number",
    "finite_number": "is not a finite number",
    "bool_type": "is neither true nor false",
    "string_type": "is not text in quotes",
    "string_pattern_mismatch": "does not have the allowed form",
    "string_too_short": "is too short",
    "string_too_long": "is too long",
    "tuple_type": "is not a list",
    "too_short": "has too few items",
    "too_long": "has too many items",
    "model_type": "is not a table",
    "literal_error": "is not allowed",
    "greater_than": "is not above {gt}",
    "greater_than_equal": "is below {ge}",
    "less_than_equal": "is above {le}",
}


def _problem(detail: ErrorDetails, place: Place, root: type[BaseModel]) -> UsageError:
    path: KeyPath = tuple(detail["loc"])
    model, depth = _model_at(path, root)
    # A position in a list of values (trusted_keys, from_px) is reported by the name of the list.
    table, key = place.at(*path[:depth]), str(path[depth]) if depth < len(path) else str(path[-1])
    field = model.model_fields.get(key)
    allowed = (field.description if field is not None else None) or "left out"
    if detail["type"] == "missing" and depth + 1 < len(path):
        return table.wrong_value(key, detail["input"], _PROBLEMS["too_short"], allowed)
    if detail["type"] == "missing":
        return table.missing(
            key, allowed, written=[other for other in detail["input"] if other not in model.model_fields]
        )
    if detail["type"] == "extra_forbidden":
        return table.unknown(key, model.model_fields)
    problem = _PROBLEMS.get(detail["type"], f"is wrong ({detail['msg']})").format(**detail.get("ctx", {}))
    kind = table.wrong_type if detail["type"].endswith("_type") else table.wrong_value
    return kind(key, detail["input"], problem, allowed)


def _model_at(path: KeyPath, root: type[BaseModel]) -> tuple[type[BaseModel], int]:
    """The innermost model on the way to ``path``, and how many parts lead to it."""
    model = root
    depth = 0
    for position, part in enumerate(path):
        if isinstance(part, int):
            continue
        inner = _inner_model(model, part)
        if inner is None:
            break
        following = position + 1
        if following < len(path) and isinstance(path[following], int):
            following += 1
        if following >= len(path):
            break
        model, depth = inner, following
    return model, depth


def _inner_model(model: type[BaseModel], key: str) -> type[BaseModel] | None:
    field = model.model_fields.get(key)
    if field is None:
        return None
    arguments = (field.annotation, *getattr(field.annotation, "__args__", ()))
    return next((kind for kind in arguments if isinstance(kind, type) and issubclass(kind, BaseModel)), None)


def _tables(table: ConfigTable, path: KeyPath) -> Iterator[tuple[KeyPath, ConfigTable]]:
    yield path, table
    for key in type(table).model_fields:
        value = getattr(table, key)
        if isinstance(value, ConfigTable):
            yield from _tables(value, (*path, key))
        elif isinstance(value, tuple):
            for position, item in enumerate(value):
                if isinstance(item, ConfigTable):
                    yield from _tables(item, (*path, key, position))


def _check_agreement(tables: StageTables) -> None:
    """Names that must differ, and outputs that must exist."""
    _all_different(tables.projectors, "name")
    _all_different(tables.projectors, "output")
    _all_different(tables.display.outputs, "name")
    _all_different(tables.appearances, "name")
    _all_different(tables.relays, "name")
    _check_cameras(tables)
    _check_mains(tables)
    _check_alerts(tables.alerts)
    hosts = sorted({output.host for output in tables.display.outputs if output.host})
    for table in tables.movable:
        if table.host and table.host not in hosts:
            allowed = f"one of {', '.join(hosts)}" if hosts else "omitted: every output is on this computer"
            raise table.place.wrong_value("host", table.host, "has no output of the display", allowed)
    outputs = [output.name for output in tables.display.outputs]
    if not outputs:
        return  # real windows: only the display itself knows its outputs
    listed = ", ".join(outputs)
    if len(tables.projectors) > len(outputs):
        surplus = tables.projectors[len(outputs)]
        problem = f"has no output left: there are {len(tables.projectors)} projectors and {len(outputs)} outputs"
        raise surplus.place.wrong_value("output", surplus.output, problem, f"one of {listed}, each for one projector")
    for projector in tables.projectors:
        if projector.output not in outputs:
            problem = "is not an output of the display"
            raise projector.place.wrong_value("output", projector.output, problem, f"one of {listed}")


def _check_cameras(tables: StageTables) -> None:
    """One table for the only camera, or several with different names."""
    if tables.camera is not None and tables.cameras:
        problem = "can't stand beside [[cameras]]"
        allowed = "for a stage with one camera. Write [[cameras]] and a name above its keys instead"
        raise tables.place.wrong_value("camera", tables.camera.driver, problem, allowed)
    if tables.camera is None and not tables.cameras:
        raise tables.place.missing("camera", str(StageTables.model_fields["camera"].description), written=[])
    for table in tables.cameras:
        if not table.name:
            raise table.place.missing("name", str(CameraTable.model_fields["name"].description), written=[])
    _all_different(tables.cameras, "name")


def _check_alerts(alerts: AlertsTable) -> None:
    """Mail needs a sender and a server, and no password crosses a network without encryption."""
    if alerts.mail_to:
        for key in ("mail_from", "mail_host"):
            if getattr(alerts, key) is None:
                raise alerts.place.missing(key, str(AlertsTable.model_fields[key].description), written=[])
    if alerts.mail_user is not None and alerts.mail_security == "none":
        problem = "would send the password without encryption"
        raise alerts.place.wrong_value("mail_security", "none", problem, '"starttls" or "tls", or no mail_user')


def _check_mains(tables: StageTables) -> None:
    """Relays feed existing projectors, each through one relay at most."""
    names = [projector.name for projector in tables.projectors]
    fed: set[str] = set()
    for board in tables.relays:
        _all_different(board.mains, "channel")
        for mains in board.mains:
            for name in mains.feeds:
                if name not in names or name in fed:
                    problem = "is fed by another relay" if name in fed else "is not a projector of this stage"
                    raise mains.place.wrong_value("feeds", name, problem, f"one of {', '.join(names)}, each once")
                fed.add(name)


def _all_different(tables: tuple[ConfigTable, ...], key: str) -> None:
    lines: dict[str, int] = {}
    for table in tables:
        value = getattr(table, key)
        if value in lines:
            allowed = (type(table).model_fields[key].description or "") + ", not used twice"
            raise table.place.wrong_value(key, value, f"is already used in line {lines[value]}", allowed)
        lines[value] = table.place.line(key)
