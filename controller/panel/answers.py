"""From a request to checked values, and from an operation's answer to a response: shared by forms, pictures and API."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response

from controller.errors import UsageError, VelaturaError, WorkError
from controller.panel.context import Panel, Values
from controller.panel.fields import Field, parse
from controller.panel.operation import BytesAnswer, FileAnswer, Operation
from hal.errors import DeviceError

FAILURES: Final = (VelaturaError, DeviceError)
"""What a kiosk's refusal may be: both trees say what happened and what to do."""

Failure = VelaturaError | DeviceError

NOT_KEPT: Final = "upload-not-kept"
INCOMING: Final = "incoming"
"""Folder of the panel: uploads, while they come and until they are taken."""


def status_of(error: Failure) -> int:
    """404 for what is not there, 422 for what is wrong, 409 for what can't be now, 502 for a device that failed.

    507 for an upload that the disk did not take.
    """
    if error.code == NOT_KEPT:
        return 507
    if error.code.endswith("-unknown") and not error.code.startswith(("field-", "stage-key-")):
        return 404
    if isinstance(error, UsageError):
        return 422
    return 502 if isinstance(error, DeviceError) else 409


def failure(error: Failure) -> Response:
    return JSONResponse({"code": error.code, "what": error.what, "remedy": error.remedy}, status_of(error))


async def run(panel: Panel, operation: Operation, values: Values) -> Any:
    """Run an operation in a thread. Raises what it raises."""
    return await panel.ask(lambda: operation.run(panel, values))


def response(answer: object) -> Response:
    if isinstance(answer, BytesAnswer):
        return Response(answer.content, media_type=answer.media_type)
    if isinstance(answer, FileAnswer):
        headers = {"content-disposition": f"attachment; filename*=utf-8''{quote(answer.download)}"}
        return FileResponse(answer.path, media_type=answer.media_type, headers=headers if answer.download else None)
    return JSONResponse(answer)


def scalar_values(operation: Operation, request: Request) -> Values:
    """The values in the path and after the question mark. Raises UsageError."""
    path = [field for field in operation.fields if field.where == "path"]
    query = [field for field in operation.fields if field.where == "query"]
    sent = request.query_params
    if len(sent.multi_items()) != len(sent):
        raise UsageError("field-wrong", what="A field was sent twice.", remedy="Send each field once.")
    return parse(path, request.path_params, strings=True) | parse(query, sent, strings=True)


async def json_values(operation: Operation, request: Request) -> Values:
    """The values of a JSON body. Raises UsageError("body-wrong") and as ``parse``."""
    fields = [field for field in operation.fields if field.where == "body"]
    body = await request.body()
    if not fields and not body:
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
    """The request's whole body as a private temporary file, which the caller removes. Raises as ``not_kept`` says."""
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
            raise not_kept(error) from error
        raise
    return path


def not_kept(error: OSError) -> WorkError:
    """What the disk did not take of an upload."""
    return WorkError(NOT_KEPT, what=f"The file could not be kept: {error.strerror}.",
                     remedy="Free some space on the disk, and send it again.")  # fmt: skip


def temporary(folder: Path) -> Path:
    """A new private file in ``folder``."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=folder, prefix="incoming-")
    os.close(handle)
    return Path(name)


def fields_from_path(operation: Operation) -> tuple[Field, ...]:
    """All but an upload, as fields of a form: a form sends names of the path in its body."""
    return tuple(field for field in operation.fields if field.kind != "file")
