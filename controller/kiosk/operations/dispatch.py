"""Operations by the names of the socket, for callers on this machine: files are given by their paths."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from controller.kiosk.operations.fields import Field, parse
from controller.kiosk.operations.operation import Operation, Values
from controller.kiosk.operations.table import JOB, OPERATIONS

LONGEST_PATH: Final = 4096
AT_SOCKET: Final = (*OPERATIONS, JOB)


def on_this_machine(field: Field) -> Field:
    """As the socket takes it: a file or a target by its path."""
    if field.kind not in ("file", "target"):
        return field
    return replace(field, kind="text", pattern="", longest=LONGEST_PATH)


def local_values(operation: Operation, sent: Mapping[str, Any]) -> Values:
    """The checked values; None is as good as left out. Raises as ``fields.parse``."""
    given = {name: value for name, value in sent.items() if value is not None}
    values = parse([on_this_machine(field) for field in operation.fields], given, strings=False)
    paths = {field.name for field in operation.fields if field.kind in ("file", "target")}
    return {name: Path(value) if name in paths else value for name, value in values.items()}


def socket_table(
    holders: Mapping[str, Any], operations: Sequence[Operation] = AT_SOCKET
) -> dict[str, Callable[..., Any]]:
    """What each name of the socket does, for the operations whose holder is there."""
    return {one.socket_name: _asked(one, holders[one.holder]) for one in operations if one.holder in holders}


def _asked(operation: Operation, holder: Any) -> Callable[..., Any]:
    names = [field.name for field in operation.fields]

    def ask(*given: Any, **sent: Any) -> Any:
        return operation.of(holder, local_values(operation, dict(zip(names, given, strict=False)) | sent))

    return ask


def offline_operation(op: str) -> Operation | None:
    """The operation of this name, if it can be done where no kiosk runs."""
    return next((one for one in AT_SOCKET if one.offline and one.socket_name == op), None)
