"""Commands made from the table of operations: arguments, options, help and output follow from each declaration."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import typer

from controller.cli import console
from controller.cli.groups import StageFolder, appearance_names, projector_names, typed_parameter, with_signature, work
from controller.core.errors import UsageError
from controller.core.text import printable
from controller.kiosk.operations.fields import Field, Sent
from controller.kiosk.operations.operation import Answer, Effect, Operation
from controller.kiosk.operations.table import OPERATIONS

if TYPE_CHECKING:
    from controller.run.progress import Reporter

_COMPLETE: Final = {"appearance": appearance_names, "projector": projector_names, "": None}
NoWait = Annotated[bool, typer.Option("--no-wait", help="Do not wait for the end of the job.")]
Yes = Annotated[bool, typer.Option("--yes", help="Do not ask. Scripts are never asked.")]


def commands(group: str, operations: Sequence[Operation] = OPERATIONS) -> dict[str, Callable[..., None]]:
    """The commands of one group, such as "kiosk account", by their last word."""
    words = (
        (operation, operation.words.rpartition(" "))
        for operation in operations
        if not operation.names.part_of and operation.holder != "targets"
    )
    return {name: command(operation, name) for operation, (first, _, name) in words if first == group}


def command(operation: Operation, name: str) -> Callable[..., None]:
    """A function as typer takes it; its signature and help are the operation's."""

    def run(stage: Path, no_wait: bool = False, yes: bool = False, **typed: Any) -> None:
        arguments = {field.name: _value(field, typed.get(field.name)) for field in operation.fields}
        if operation.asks and not yes and sys.stdin.isatty():
            typer.confirm(operation.question(arguments), abort=True)
        if operation.effect is Effect.WORKS and not no_wait:
            job(stage, operation.socket_name, arguments)
            return
        console.show_result(*_shown(operation, call(stage, operation.socket_name, **arguments), arguments))

    parameters = [typed_parameter("stage", StageFolder)]
    open_fields = [field for field in operation.fields if not field.command_line.secret]
    parameters += [typed_parameter(field.name, *_typed(field)) for field in open_fields]
    if operation.effect is Effect.WORKS:
        parameters.append(typed_parameter("no_wait", NoWait, False))
    if operation.asks:
        parameters.append(typed_parameter("yes", Yes, False))
    run.__name__, run.__doc__ = name.replace("-", "_"), _help(operation)
    return with_signature(run, parameters)


def call(stage: Path, op: str, **arguments: Any) -> Any:
    """Ask the running kiosk, or do it on the stage's folder if none runs."""
    from controller.kiosk.api.offline_dispatch import call

    return call(stage, op, **arguments)


def job(stage: Path, op: str, arguments: Mapping[str, Any]) -> None:
    """Start a job of the running kiosk and wait for its end."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.kiosk.api.offline_dispatch import ask_and_follow

        return ask_and_follow(stage=stage, op=op, arguments=arguments, reporter=reporter, cancel=cancel)

    work(do)


def _typed(field: Field) -> tuple[Any, ...]:
    """The annotation that typer reads, and the default of an optional value."""
    about = ("" if field.choices else field.about[:1].upper()) + field.about[0 if field.choices else 1 :] + "."
    asked = field.command_line
    if asked.flag is not None:
        return Annotated[bool, typer.Option(asked.flag.option, help=asked.flag.about)], False
    kind: Any = Literal[field.choices] if field.choices else field.kind
    complete = _COMPLETE[asked.completes]
    if field.sent is Sent.TARGET:
        about = "The object's requested look, seen from the camera (PNG)."
    if asked.argument or (field.required and not asked.default):
        made = typer.Argument(help=about, autocompletion=complete, metavar=asked.metavar or None)
        return (Annotated[kind, made],) if field.required else (Annotated[kind | None, made], None)
    option = typer.Option(help=about, autocompletion=complete)
    return (Annotated[kind, option], asked.default) if asked.default else (Annotated[kind | None, option], None)


def _value(field: Field, typed: Any) -> Any:
    """As the socket takes it."""
    asked = field.command_line
    if asked.secret:
        return _secret(field)
    if asked.flag is not None:
        return asked.flag.value if typed else asked.flag.otherwise
    if field.sent is Sent.TARGET and not typed.is_file():
        raise UsageError("target-missing", what=f"The file {typed} does not exist.", remedy="Give a PNG file.")
    return str(typed.absolute()) if isinstance(typed, Path) else typed


def _secret(field: Field) -> str:
    if sys.stdin.isatty():
        return str(typer.prompt(f"New {field.name}", hide_input=True, confirmation_prompt=True))
    return sys.stdin.readline().rstrip("\n")


def _help(operation: Operation) -> str:
    sentences = [f"{operation.about}.", *([operation.more] if operation.more else [])]
    if any(field.command_line.secret for field in operation.fields):
        sentences.append("You are asked for the password; a script gives it on standard input.")
    if operation.effect is Effect.WORKS:
        sentences.append("The command waits until it is done.")
    if operation.answer in (Answer.FILE, Answer.PICTURE):
        sentences.append("Prints the name of the file.")
    if not operation.offline:
        sentences.append("The kiosk must be running.")
    return " ".join(sentences)


Shown = tuple[Mapping[str, Any], str | None]
"""An object for programs and text for people; None: the object's ``key: value`` lines."""


def _shown(operation: Operation, answer: Any, arguments: Mapping[str, Any]) -> Shown:
    """An operation's result, as its text, a sentence, the name of a file, or its values."""
    done = {"done": operation.socket_name}
    if (text_of := TEXTS.get(operation.name)) is not None:
        return text_of(answer)
    if operation.effect is Effect.WORKS:
        return done, "Started. `velatura kiosk status` shows the progress."
    if operation.answer is Answer.NOTHING:
        undone = any(
            (flag := field.command_line.flag) and arguments[field.name] == flag.value for field in operation.fields
        )
        return done, "Done." if undone else printable(operation.sentence(dict(arguments)))
    if operation.answer in (Answer.FILE, Answer.PICTURE, Answer.PAGE):
        return {"file": answer}, f"Written: {answer}"
    if isinstance(answer, Mapping):
        return answer, None
    lines = answer if isinstance(answer, list) else [answer]
    return {operation.name: answer}, "\n".join(printable(str(line)) for line in lines) or "There are none yet."


def _appearances(rows: Any) -> Shown:
    lines = [f"{row['name']}{'  (on the projectors)' if row['playing'] else ''}" for row in rows]
    return {"appearances": rows}, "\n".join(lines) or "There are none yet."


def _lamps(rows: Any) -> Shown:
    lines = [f"{row['day']} {row['projector']:<12} {row['hours']:9,.1f} h {row['strikes']:6} strikes" for row in rows]
    return {"days": rows}, "\n".join(lines) or "No lamp has burnt yet."


def _changes(inventory: Any) -> Shown:
    if inventory["good_unix_s"] is None:
        text = "There was no good day yet. The first one is after a calibration that graded well, while the kiosk runs."
        return inventory, text
    lines = [f"The last good day was {_day(inventory['good_unix_s'])} ({inventory['run']})."]
    for change in inventory["changes"]:
        lines += [f"{change['sentence']} (seen on {_day(change['since_unix_s'])})", f"  {change['remedy']}"]
    if not inventory["changes"]:
        lines.append("Nothing has changed since.")
    lines += [f"Not compared, because it can't be read now: {name}" for name in inventory["unknown"]]
    return inventory, "\n".join(map(printable, lines))


def _day(unix_s: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(unix_s))


def _diagnosed(path: Any) -> Shown:
    from hal.runtime.caches import kept, summary

    outside = kept()
    rows = [
        {"path": str(folder.path), "what": folder.what, "bytes": folder.size_bytes, "in_use": folder.in_use}
        for folder in outside
    ]
    text = "\n".join([f"Written: {path}", *(f"Stored outside the stage: {line}" for line in summary(outside))])
    return {"file": path, "outside_the_stage": rows}, text


def _token(made: Any) -> Shown:
    return made, str(made["token"])


def _house(now: Any) -> Shown:
    lines = [
        f"{one['name']:<24} {one['state']['state'] if one['linked'] and one['state'] else 'no connection':<14} "
        f"{one['state']['playing'] if one['state'] else ''}"
        for one in now["stages"]
    ]
    return now, "\n".join(map(printable, lines)) or "There are none yet."


TEXTS: Final[Mapping[str, Callable[[Any], Shown]]] = {
    "appearances": _appearances,
    "lamp-history": _lamps,
    "changes": _changes,
    "diagnostics": _diagnosed,
    "add-token": _token,
    "house-state": _house,
}
"""How an answer is shown, by the operation's name; one that is not here is shown by its kind of answer."""
