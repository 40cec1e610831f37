"""Operations by their socket names, for callers on this machine: files are given as paths."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from controller.kiosk.operations.fields import Field, parse
from controller.kiosk.operations.operation import Effect, Operation, Values
from controller.kiosk.operations.table import JOB, OPERATIONS

LONGEST_PATH: Final = 4096
CALLER: Final = ContextVar("CALLER", default="unknown")
"""The name of the user of this computer whose request is answered."""
AT_SOCKET: Final = (*OPERATIONS, JOB)


def on_this_machine(field: Field) -> Field:
    """The field at the socket: a file or a target is given as a path."""
    if field.kind not in ("file", "target"):
        return field
    return replace(field, kind="text", pattern="", longest=LONGEST_PATH)


def local_values(operation: Operation, sent: Mapping[str, Any]) -> Values:
    """The checked values; None counts as omitted. Raises as ``fields.parse``."""
    given = {name: value for name, value in sent.items() if value is not None}
    values = parse([on_this_machine(field) for field in operation.fields], given, strings=False)
    paths = {field.name for field in operation.fields if field.kind in ("file", "target")}
    return {name: Path(value) if name in paths else value for name, value in values.items()}


def socket_table(
    holders: Mapping[str, Any], operations: Sequence[Operation] = AT_SOCKET
) -> dict[str, Callable[..., Any]]:
    """The socket's operations by name, as far as ``holders`` has their holder."""
    return {
        operation.socket_name: _bound(operation, holders[operation.holder], holders.get("kiosk"))
        for operation in operations
        if operation.holder in holders
    }


def _bound(operation: Operation, holder: Any, kiosk: Any) -> Callable[..., Any]:
    names = [field.name for field in operation.fields]

    def call(*given: Any, **sent: Any) -> Any:
        values = local_values(operation, dict(zip(names, given, strict=False)) | sent)
        if operation.effect is not Effect.LOOKS and kiosk is not None:
            kiosk.record("done-by", operation.done_by(f"User {CALLER.get()}", values))
        return operation.of(holder, values)

    return call


def offline_operation(op: str) -> Operation | None:
    """The operation of this name, if it works without a running kiosk."""
    return next((operation for operation in AT_SOCKET if operation.offline and operation.socket_name == op), None)
