"""Operations by their socket names, for callers on this machine: files are given as paths."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import Any, Final

from controller.kiosk.operations.fields import Values, parse
from controller.kiosk.operations.operation import Operation
from controller.kiosk.operations.table import AT_SOCKET

CALLER: Final = ContextVar("CALLER", default="unknown")
"""The name of the user of this computer whose request is answered."""


def local_values(operation: Operation, sent: Mapping[str, Any]) -> Values:
    """The checked values; None counts as omitted. Raises as ``fields.parse``."""
    values = parse(
        operation.fields, {name: each for name, each in sent.items() if each is not None}, strings=False, paths=True
    )
    paths = {field.name for field in operation.fields if field.sent is not None}
    return {name: Path(value) if name in paths else value for name, value in values.items()}


def socket_table(
    holders: Mapping[str, Any], operations: Sequence[Operation] = AT_SOCKET
) -> dict[str, Callable[..., Any]]:
    """The socket's operations by name, as far as ``holders`` has what they work on."""
    return {
        operation.socket_name: _bound(operation, holders[operation.holder], holders.get("kiosk"))
        for operation in operations
        if operation.holder in holders
    }


def _bound(operation: Operation, holder: Any, kiosk: Any) -> Callable[..., Any]:
    names = [field.name for field in operation.fields]

    def call(*arguments: Any, **sent: Any) -> Any:
        values = local_values(operation, dict(zip(names, arguments, strict=False)) | sent)
        if kiosk is None:
            return operation.function(holder, **values)
        with operation.logged(kiosk.record, f"User {CALLER.get()}", values):
            return operation.function(holder, **values)

    return call


def offline_operation(op: str) -> Operation | None:
    """The operation of this name, if it works without a running kiosk."""
    return next((operation for operation in AT_SOCKET if operation.offline and operation.socket_name == op), None)
