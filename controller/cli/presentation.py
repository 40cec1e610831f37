"""How a command shows an operation's result: as a sentence, a file name, or the text of a formatter."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from controller.core.text import printable
from controller.kiosk.operations.operation import Answer, Effect, Operation

Formatter = Callable[[Any, Mapping[str, Any], bool], Mapping[str, Any] | str]
"""Of the answer and the arguments: an object for machines (True), or text for people."""


def of(operation: Operation, answer: Any, arguments: Mapping[str, Any], *, as_json: bool) -> Mapping[str, Any] | str:
    """What is shown."""
    if (formatter := FORMATTERS.get(operation.name)) is not None:
        return formatter(answer, arguments, as_json)
    if operation.effect is Effect.WORKS:
        said = "Started. `velatura status` shows the progress."
        return {"done": operation.socket_name} if as_json else said
    if operation.answer is Answer.NOTHING:
        return {"done": operation.socket_name} if as_json else printable(operation.sentence(dict(arguments)))
    if operation.answer in (Answer.FILE, Answer.PICTURE, Answer.PAGE):
        return {"file": answer} if as_json else f"Written: {answer}"
    return _value(operation, answer, as_json=as_json)


def _value(operation: Operation, answer: Any, *, as_json: bool) -> Mapping[str, Any] | str:
    if isinstance(answer, Mapping):
        return answer
    if as_json:
        return {operation.name: answer}
    lines = answer if isinstance(answer, list) else [answer]
    return "\n".join(printable(str(line)) for line in lines) or "There are none yet."


def _appearances(rows: Any, _: Mapping[str, Any], as_json: bool) -> Mapping[str, Any] | str:
    lines = [f"{row['name']}{'  (on the projectors)' if row['playing'] else ''}" for row in rows]
    return {"appearances": rows} if as_json else "\n".join(lines) or "There are none yet."


def _lamps(rows: Any, _: Mapping[str, Any], as_json: bool) -> Mapping[str, Any] | str:
    lines = [f"{row['day']} {row['projector']:<12} {row['hours']:9,.1f} h {row['strikes']:6} strikes" for row in rows]
    return {"days": rows} if as_json else "\n".join(lines) or "No lamp has burnt yet."


def _changes(found: Any, _: Mapping[str, Any], as_json: bool) -> Mapping[str, Any] | str:
    if as_json:
        return dict(found)
    if found["good_unix_s"] is None:
        return "There was no good day yet. The first one is after a calibration that graded well, while the kiosk runs."
    day = _day(found["good_unix_s"])
    lines = [f"The last good day was {day} ({found['run']})."]
    for one in found["changes"]:
        lines += [f"{one['sentence']} (seen on {_day(one['since_unix_s'])})", f"  {one['remedy']}"]
    if not found["changes"]:
        lines.append("Nothing has changed since.")
    lines += [f"Not compared, because it can't be read now: {name}" for name in found["unknown"]]
    return "\n".join(map(printable, lines))


def _day(unix_s: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(unix_s))


def _identified(_: Any, arguments: Mapping[str, Any], as_json: bool) -> Mapping[str, Any] | str:
    return {"done": "identify"} if as_json else "The names are shown." if arguments["on"] else "The names are hidden."


def _restored(_: Any, arguments: Mapping[str, Any], as_json: bool) -> Mapping[str, Any] | str:
    file = Path(arguments["backup"])
    return {"restored": str(file)} if as_json else f"{file.name} is restored."


def _diagnosed(path: Any, _: Mapping[str, Any], as_json: bool) -> Mapping[str, Any] | str:
    from hal.runtime.caches import kept, summary

    outside = kept()
    rows = [
        {"path": str(folder.path), "what": folder.what, "bytes": folder.size_bytes, "in_use": folder.in_use}
        for folder in outside
    ]
    text = "\n".join([f"Written: {path}", *(f"Stored outside the stage: {line}" for line in summary(outside))])
    return {"file": path, "outside_the_stage": rows} if as_json else text


def _token(made: Any, _: Mapping[str, Any], as_json: bool) -> Mapping[str, Any] | str:
    return dict(made) if as_json else str(made["token"])


FORMATTERS: Final[Mapping[str, Formatter]] = {
    "appearances": _appearances,
    "lamp-history": _lamps,
    "changes": _changes,
    "identify": _identified,
    "restore": _restored,
    "diagnostics": _diagnosed,
    "add-token": _token,
}
"""By the operation's name; one that is not here is shown by its kind of answer."""
