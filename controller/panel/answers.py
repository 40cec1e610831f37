"""Converts requests to checked values, and results of operations to responses; shared by forms, pictures and API."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from pydantic import TypeAdapter
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response

from controller.core.errors import UsageError, VelaturaError, WorkError
from controller.kiosk.operations.dispatch import CALLER
from controller.kiosk.operations.fields import Sent, Values, parse
from controller.kiosk.operations.operation import Answer, Operation
from controller.panel.context import Panel
from hal.errors import DeviceError

FAILURES: Final = (VelaturaError, DeviceError)
"""The errors of a kiosk; both have code, what and remedy."""

Failure = VelaturaError | DeviceError

NOT_KEPT: Final = "upload-not-kept"
INCOMING: Final = "incoming"
"""The panel's folder for uploads until they are used."""


def status_of(error: Failure) -> int:
    """404: does not exist; 422: wrong request; 409: not possible now; 429: too often; 502: a device failed; 507: an
    upload could not be saved.
    """
    special = {NOT_KEPT: 507, "too-many-verbs": 429}
    if error.code in special:
        return special[error.code]
    if error.code.endswith("-unknown") and not error.code.startswith(("field-", "stage-key-")):
        return 404
    if isinstance(error, UsageError):
        return 422
    return 502 if isinstance(error, DeviceError) else 409


def failure(error: Failure) -> Response:
    return JSONResponse({"code": error.code, "what": error.what, "remedy": error.remedy}, status_of(error))


async def run(panel: Panel, operation: Operation, values: Values, who: str) -> Any:
    """Run an operation in a thread; keys of uploaded targets become their files. Raises what it raises.

    The event log has who did it, and what was refused, unless it only looks.
    """
    targets = [field.name for field in operation.fields if field.sent is Sent.TARGET]

    def do() -> Any:
        CALLER.set(who)
        with operation.logged(panel.kiosk.record, who, values):
            files = {name: panel.targets.path(values[name]) for name in targets}
            return operation.function(panel.holders[operation.holder], **values | files)

    return await panel.in_thread(do)


def response(operation: Operation, answer: Any, values: Values) -> Response:
    """Raises UsageError("picture-unknown") if none exists."""
    kind = operation.answer
    if kind is Answer.NOTHING:
        return JSONResponse({"done": True})
    if kind is Answer.TEXT:
        return JSONResponse({"text": answer})
    if kind is Answer.VALUE:
        return JSONResponse(plain(operation, answer))
    if kind is Answer.JPEG:
        if answer is None:
            raise UsageError(
                "picture-unknown",
                what="The camera shows no picture now.",
                remedy="See the camera in the list of devices on the first page.",
            )
        return Response(answer, media_type=kind.media)
    if kind is Answer.PICTURE:
        return _picture(answer)
    download = answer.name if kind is Answer.FILE else "-".join([operation.name, *map(str, values.values())]) + ".html"
    headers = {"content-disposition": f"attachment; filename*=utf-8''{quote(download)}"}
    return FileResponse(answer, media_type=kind.media, headers=headers)


SMALL_PX: Final = 480
"""The longer side of a picture in a row of several; each leads to its whole one."""


def small_picture(path: Path | None) -> Response:
    """As ``response`` of a picture, as a JPEG of ``SMALL_PX``."""
    _picture(path)
    assert path is not None
    return Response(_smaller(path, path.stat().st_mtime_ns), media_type="image/jpeg")


@lru_cache(maxsize=64)
def _smaller(path: Path, changed_ns: int) -> bytes:
    import cv2

    picture = cv2.imread(str(path))
    if picture is None:
        raise UsageError("picture-unknown", what="This picture can't be read.", remedy="Load the page again.")
    scale = SMALL_PX / max(picture.shape[:2])
    if scale < 1:
        picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 82])[1])


def _picture(path: Path | None) -> Response:
    types = {".png": "image/png", ".jpg": "image/jpeg"}
    if path is None or path.suffix not in types or not path.is_file():
        raise UsageError("picture-unknown", what="This picture does not exist.", remedy="Load the page again.")
    return FileResponse(path, media_type=types[path.suffix])


def plain(operation: Operation, answer: Any) -> Any:
    """An answer as JSON, without files of this machine."""
    return adapter(operation).dump_python(answer, mode="json", warnings=False)


@cache
def adapter(operation: Operation) -> TypeAdapter[Any]:
    """What describes and serialises an operation's answers."""
    return TypeAdapter(operation.returns)


def scalar_values(operation: Operation, request: Request) -> Values:
    """The values in the path and the query. Raises UsageError."""
    path = [field for field in operation.fields if operation.where(field) == "path"]
    query = [field for field in operation.fields if operation.where(field) == "query"]
    sent = request.query_params
    if len(sent.multi_items()) != len(sent):
        raise UsageError("field-wrong", what="A field was sent more than once.", remedy="Send each field once.")
    return parse(path, request.path_params, strings=True) | parse(query, sent, strings=True)


async def json_values(operation: Operation, request: Request) -> Values:
    """The values of a JSON body. Raises UsageError("body-wrong") and as ``parse``."""
    fields = [field for field in operation.fields if operation.where(field) == "body"]
    body = await request.body()
    if not body and not any(field.required for field in fields):
        return {}
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
        raise UsageError("body-wrong", what="The body is not JSON.", remedy="Send it as application/json.")
    try:
        sent = json.loads(body)
        body.decode().encode()
    except (ValueError, RecursionError):
        sent = None
    if not isinstance(sent, Mapping):
        raise UsageError("body-wrong", what="The body is not a JSON object.", remedy="Send one object of fields.")
    return parse(fields, sent, strings=False)


async def body_file(request: Request, folder: Path) -> Path:
    """The request's body as a private temporary file, which the caller deletes. Raises the error of ``not_saved``."""
    path = None
    try:
        path = temporary(folder)
        with path.open("wb") as file:
            async for chunk in request.stream():
                file.write(chunk)
    except BaseException as error:
        if path is not None:
            path.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise not_saved(error) from error
        raise
    return path


def not_saved(error: OSError) -> WorkError:
    """The error for an upload that could not be saved."""
    return WorkError(NOT_KEPT, what=f"The file could not be saved: {error.strerror}.",
                     remedy="Free some space on the disk, and send it again.")  # fmt: skip


def temporary(folder: Path) -> Path:
    """A new private file in ``folder``."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=folder, prefix="incoming-")
    os.close(handle)
    return Path(name)
