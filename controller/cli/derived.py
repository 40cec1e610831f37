"""Commands made from the table of operations: arguments, options and help follow from each declaration."""

from __future__ import annotations

import inspect
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from controller.cli import console, presentation
from controller.cli.running import Json, StageFolder, appearance_names, projector_names, work
from controller.core.errors import UsageError
from controller.kiosk.operations.fields import Field
from controller.kiosk.operations.operation import Answer, Effect, Operation
from controller.kiosk.operations.table import OPERATIONS

if TYPE_CHECKING:
    from controller.run.progress import Reporter

_TYPES: Final[Mapping[str, Any]] = {"integer": int, "number": float, "boolean": bool, "file": Path, "target": Path}
_COMPLETE: Final = {"appearance": appearance_names, "projector": projector_names, "": None}
NoWait = Annotated[bool, typer.Option("--no-wait", help="Do not wait for the end of the job.")]

Yes = Annotated[bool, typer.Option("--yes", help="Do not ask. Scripts are never asked.")]


def commands(group: str = "", operations: Sequence[Operation] = OPERATIONS) -> tuple[Callable[..., None], ...]:
    """The commands of one group, "" for those of one word."""
    words = (
        (operation, operation.words.rpartition(" "))
        for operation in operations
        if not operation.within and operation.holder != "targets"
    )
    return tuple(command(one, name) for one, (first, _, name) in words if first == group)


def command(operation: Operation, name: str) -> Callable[..., None]:
    """A function as typer takes it; its signature and help are the operation's."""

    def run(stage: Path, as_json: bool, no_wait: bool = False, yes: bool = False, **given: Any) -> None:
        arguments = {field.name: _value(field, given.get(field.name)) for field in operation.fields}
        if operation.asks and not yes and sys.stdin.isatty():
            typer.confirm(operation.question(arguments), abort=True)
        if operation.effect is Effect.WORKS and not no_wait:
            job(stage, operation.socket_name, arguments, as_json=as_json)
            return
        from controller.kiosk.api.offline_dispatch import call

        answer = call(stage, operation.socket_name, **arguments)
        shown = presentation.of(operation, answer, arguments, as_json=as_json)
        console.show_result(shown, as_json=as_json)

    parameters = [_parameter("stage", StageFolder)]
    parameters += [_parameter(field.name, *_typed(field)) for field in operation.fields if not field.secret]
    if operation.effect is Effect.WORKS:
        parameters.append(_parameter("no_wait", NoWait, False))
    if operation.asks:
        parameters.append(_parameter("yes", Yes, False))
    parameters.append(_parameter("as_json", Json, False))
    vars(run)["__signature__"] = inspect.Signature(parameters)
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    run.__name__, run.__doc__ = name.replace("-", "_"), _help(operation)
    return run


def job(stage: Path, op: str, arguments: Mapping[str, Any], *, as_json: bool) -> None:
    """Start a job of the running kiosk and wait for its end."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.kiosk.jobs.follow_job import ask_and_follow

        return ask_and_follow(stage=stage, op=op, arguments=arguments, reporter=reporter, cancel=cancel)

    work(do, as_json=as_json)


def _parameter(name: str, annotation: Any, default: Any = inspect.Parameter.empty) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, annotation=annotation, default=default)


def _typed(field: Field) -> tuple[Any, ...]:
    """The annotation that typer reads, and the default of an optional value."""
    about = ("" if field.choices else field.about[:1].upper()) + field.about[0 if field.choices else 1 :] + "."
    if field.flag is not None:
        return Annotated[bool, typer.Option(field.flag.option, help=field.flag.about)], False
    kind, complete = _TYPES.get(field.kind, str), _COMPLETE[field.names]
    if field.kind == "target":
        about = "The object's requested look, seen from the camera (PNG)."
    if field.argument or (field.required and not field.usual):
        made = typer.Argument(help=about, autocompletion=complete, metavar=field.metavar or None)
        return (Annotated[kind, made],) if field.required else (Annotated[kind | None, made], None)
    option = typer.Option(help=about, autocompletion=complete)
    return (Annotated[kind, option], field.usual) if field.usual else (Annotated[kind | None, option], None)


def _value(field: Field, given: Any) -> Any:
    """As the socket takes it."""
    if field.secret:
        return _secret(field)
    if field.flag is not None:
        return field.flag.value if given else field.flag.otherwise
    if field.kind == "target" and not given.is_file():
        raise UsageError("target-missing", what=f"The file {given} does not exist.", remedy="Give a PNG file.")
    return str(given.absolute()) if isinstance(given, Path) else given


def _secret(field: Field) -> str:
    if sys.stdin.isatty():
        return str(typer.prompt(f"New {field.name}", hide_input=True, confirmation_prompt=True))
    return sys.stdin.readline().rstrip("\n")


def _help(operation: Operation) -> str:
    sentences = [f"{operation.about}.", *([operation.more] if operation.more else [])]
    if any(field.secret for field in operation.fields):
        sentences.append("You are asked for the password; a script gives it on standard input.")
    if operation.effect is Effect.WORKS:
        sentences.append("The command waits until it is done.")
    if operation.answer in (Answer.FILE, Answer.PICTURE):
        sentences.append("Prints the name of the file.")
    if not operation.offline:
        sentences.append("The kiosk must be running.")
    return " ".join(sentences)
