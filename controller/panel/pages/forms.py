"""The forms of the pages, protected by the CSRF token: those of the operations, and those of a stage's set-up."""

from __future__ import annotations

import itertools
import json
import re
import unicodedata
from collections.abc import Awaitable, Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path, PurePath
from typing import Any, Final

import anyio
from starlette.datastructures import FormData, UploadFile
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response

from controller.core.errors import UsageError
from controller.kiosk.operations.arguments import HoursRow
from controller.kiosk.operations.fields import Values, missing, parse
from controller.kiosk.operations.house import Invitation
from controller.kiosk.operations.operation import Answer, Operation
from controller.kiosk.operations.table import schedule_of
from controller.kiosk.store.accounts import Role
from controller.kiosk.values import FoundDevice, NewTarget, TriedDevice
from controller.panel import answers
from controller.panel.auth.identity import Entry, Visitor, same_origin
from controller.panel.context import Panel
from controller.panel.pages.drawing import flags
from controller.panel.pages.routes import Pages
from controller.panel.pages.settings_fields import groups, with_fields
from controller.panel.words.days import canonical
from controller.panel.words.language import gettext, mark

MOST_FIELDS = 2000
_COLUMNS: Final = tuple(HoursRow.model_fields)
LEADS_TO: Final = {
    **dict.fromkeys(
        ("recalibrate", "cancel", "start", "stop", "identify", "compute", "compute-scene", "compare", "seen"), "/"
    ),
    **dict.fromkeys(("next", "black", "pause", "brightness"), "/"),
    **dict.fromkeys(("play", "rotate", "remove-appearance"), "/appearances"),
    **dict.fromkeys(("backup", "restore", "diagnostics", "test-alerts", "test-backup"), "/care"),
    "upload-target": "/appearances/new/{target}",
    "fit-target": "/appearances/new/{target}",
    "outline-target": "/appearances/new/{target}",
    "lay-mesh": "/mesh",
    "set-schedule": "/schedule",
    **dict.fromkeys(("house-open", "house-close", "house-play", "house-compute"), "/house"),
    **dict.fromkeys(("house-add", "house-remove", "house-join", "house-leave"), "/house"),
    **dict.fromkeys(("house-update", "house-update-stop"), "/house/update"),
    "test-shots": "/aiming",
    "save-settings": "/settings",
}
"""The operations that have a form, and the page to show afterwards."""
WHEN_LIT: Final = mark("{name} is chosen. It is shown when the lamps are lit.")
ALL_WHEN_LIT: Final = mark("All appearances are shown in turn when the lamps are lit.")
Handler = Callable[[Request, Visitor, "Sent"], Awaitable[Response]]


@dataclass(slots=True)
class Sent:
    """The content of a form: text by name, all texts by name, and at most one file with its name."""

    texts: dict[str, str] = field(default_factory=dict)
    many: dict[str, list[str]] = field(default_factory=dict)
    file: Path | None = None
    filename: str = ""


def name_of(filename: str) -> str:
    """A name for an appearance, from that of its file; empty if there is none."""
    stem = unicodedata.normalize("NFC", PurePath(filename.replace("\\", "/")).stem)
    return re.sub(r"[^A-Za-z0-9\u00C0-\u024F]+", "-", stem).strip("-")[:64]


class Forms:
    """The forms of one panel."""

    def __init__(self, panel: Panel, pages: Pages) -> None:
        self._panel, self._pages = panel, pages

    def entries(self) -> list[Entry]:
        found = []
        for op in self._panel.operations:
            handlers: dict[str, Handler] = {}
            if op.name in LEADS_TO:
                handlers[f"/do/{op.name}"] = self._operation(op)
            if op.name == "check-settings":
                handlers[f"/do/{op.name}"] = self._check
            if op.name == "save-settings":
                handlers["/settings/fields"] = self._fields(op)
            found += [
                Entry("POST", path, "session", op.role, checked(self._panel, handler))
                for path, handler in handlers.items()
            ]
        return found

    def _fields(self, save: Operation) -> Handler:
        """The fields of the settings that museums change; all else in stage.toml stays."""

        async def answer(request: Request, visitor: Visitor, sent: Sent) -> Response:
            text = await self._panel.in_thread(self._panel.kiosk.settings)
            try:
                text = with_fields(text, sent.texts)
                await self._panel.in_thread(lambda: self._panel.kiosk.validate_settings(text))
            except answers.FAILURES as error:
                return await self._settings(visitor, Sent({"text": text} | sent.texts), error)
            return await self._operation(save)(request, visitor, Sent({"text": text}, {"text": [text]}))

        return answer

    def _operation(self, operation: Operation) -> Handler:
        async def answer(_: Request, visitor: Visitor, sent: Sent) -> Response:
            assert visitor.session is not None
            values: Values = {}
            sure, back = sent.texts.pop("sure", ""), sent.texts.pop("back", "")
            try:
                values = _values(operation, sent)
                question = await self._question(operation, values)
                if question and sure == "no":
                    return await self._again(operation, visitor, sent, None)
                if question and sure != "yes":
                    return await self._ask(operation, visitor, sent, question)
                result = await answers.run(self._panel, operation, values, visitor.name)
            except answers.FAILURES as error:
                return await self._again(operation, visitor, sent, error)
            if operation.name == "upload-target":
                self._panel.targets.propose(result.target, name_of(sent.filename))
            if operation.name in ("upload-target", "fit-target", "outline-target"):
                # It is calculated while the browser loads the page on which it is shown.
                self._pages.prepare_reach(result.target if isinstance(result, NewTarget) else values["target"])
            if operation.answer is Answer.FILE:
                return answers.response(operation, result, values)
            made = asdict(result) if isinstance(result, Invitation) else {}
            visitor.session.notes.append(("good", gettext(self._done(operation)).format_map(values | made)))
            return RedirectResponse("/" if back == "/" else _then(operation, result, values), 303)

        return answer

    def _done(self, operation: Operation) -> str:
        if operation.name in ("play", "rotate") and "plays" not in flags(self._panel.kiosk.snapshot()):
            return WHEN_LIT if operation.name == "play" else ALL_WHEN_LIT
        return operation.done

    async def _question(self, operation: Operation, values: Values) -> str:
        """What a person has to agree to first, or nothing."""
        if operation.name == "save-settings":
            effect = await self._panel.in_thread(lambda: self._panel.kiosk.effect_of_settings(values["text"]))
            return " ".join((gettext("Save these settings now?"), effect)) if effect else ""
        if operation.name == "set-schedule":
            schedule = schedule_of(**values)
            effect = await self._panel.in_thread(lambda: self._panel.kiosk.effect_of_schedule(schedule))
            return " ".join((gettext("Save these hours now?"), effect)) if effect else ""
        return gettext(operation.asks).format_map(values)

    async def _again(
        self, operation: Operation, visitor: Visitor, sent: Sent, error: answers.Failure | None
    ) -> Response:
        """The form as it was sent, with what is wrong; forms in which nothing is typed lead back to their page."""
        if operation.name == "save-settings":
            return await self._settings(visitor, sent, error)
        assert visitor.session is not None
        if error is not None:
            visitor.session.notes.append(("error", f"{error.what} {error.remedy}"))
        back = _back(operation, sent)
        if (page := self._pages.with_form(operation.name)) is None or back == "/":
            return RedirectResponse(back, 303)
        typed = {**sent.texts, "rows": _typed_rows(sent)}
        try:
            facts = await self._panel.in_thread(lambda: page.facts(typed))
        except answers.FAILURES as gone:
            shown = {"error": gone, "here": back}
            return await self._pages.show("problem.html", visitor, shown, answers.status_of(gone))
        status = 200 if error is None else answers.status_of(error)
        return await self._pages.show(page.template, visitor, {**facts, "typed": typed, "here": back}, status)

    async def _ask(self, operation: Operation, visitor: Visitor, sent: Sent, question: str) -> Response:
        facts: dict[str, Any] = {
            "question": question, "action": f"/do/{operation.name}", "back": LEADS_TO[operation.name]
        }  # fmt: skip
        if operation.upload is not None:
            # A file can't be sent on; its own page has the question beside it.
            assert visitor.session is not None
            visitor.session.notes.append(
                ("error", gettext("Nothing was done. Tick the box to confirm, and choose the file again."))
            )
            return RedirectResponse(LEADS_TO[operation.name], 303)
        kept = [(name, value) for name, values in sent.many.items() if name != "sure" for value in values]
        returns = operation.name in ("set-schedule", "save-settings")
        facts |= {"kept": kept, "here": facts["back"], "returns": returns}
        return await self._pages.show("sure.html", visitor, facts)

    async def _check(self, _: Request, visitor: Visitor, sent: Sent) -> Response:
        text = sent.texts.get("text", "").replace("\r\n", "\n")
        try:
            await self._panel.in_thread(lambda: self._panel.kiosk.validate_settings(text))
        except answers.FAILURES as error:
            return await self._settings(visitor, sent, error)
        assert visitor.session is not None
        effect = await self._panel.in_thread(lambda: self._panel.kiosk.effect_of_settings(text))
        if effect:
            visitor.session.notes.append(("warn", " ".join((gettext("When you save them:"), effect))))
        return await self._settings(visitor, sent, None)

    async def _settings(self, visitor: Visitor, sent: Sent, error: answers.Failure | None) -> Response:
        """The settings page with the text that was sent."""
        text = sent.texts.get("text", "")
        facts = {"text": text, "groups": groups(text), "typed": sent.texts, "problem": error, "here": "/settings"}
        return await self._pages.show("settings.html", visitor, facts, 200 if error is None else 422)


def checked(panel: Panel, handler: Handler) -> Callable[[Request, Visitor], Awaitable[Response]]:
    """``handler``, called only for forms that our own pages sent."""

    async def answer(request: Request, visitor: Visitor) -> Response:
        assert visitor.session is not None
        if not same_origin(panel, request):
            raise refused()
        form = await request.form(max_files=1, max_fields=MOST_FIELDS, max_part_size=2 << 20)
        sent = Sent()
        try:
            token = form.get("csrf")
            if not isinstance(token, str) or not visitor.session.matches(token):
                raise refused()
            try:
                await _read(form, sent, panel.options.folder / answers.INCOMING)
            except OSError as error:
                failure = answers.not_saved(error)
                raise HTTPException(answers.status_of(failure), f"{failure.what} {failure.remedy}") from error
            return await handler(request, visitor, sent)
        finally:
            if sent.file is not None:
                sent.file.unlink(missing_ok=True)
            await form.close()

    return answer


def refused() -> HTTPException:
    return HTTPException(403, gettext("This form is out of date or comes from another site. Load the page again."))


async def _read(form: FormData, sent: Sent, folder: Path) -> None:
    for name, value in form.multi_items():
        if isinstance(value, UploadFile):
            sent.filename = value.filename or ""
            sent.file = await anyio.to_thread.run_sync(answers.temporary, folder)
            async with await anyio.open_file(sent.file, "wb") as file:
                while block := await value.read(1 << 20):
                    await file.write(block)
        elif name != "csrf":
            sent.texts[name] = value
            sent.many.setdefault(name, []).append(value)


def _values(operation: Operation, sent: Sent) -> Values:
    if operation.name == "set-schedule":
        return _schedule_values(operation, sent)
    file = operation.upload
    values = parse([field for field in operation.fields if field is not file], sent.texts, strings=True)
    if file is None:
        return values
    if sent.file is None:
        raise missing(file.name, file.about)
    return values | {file.name: sent.file}


def _schedule_values(operation: Operation, sent: Sent) -> Values:
    """The rows of the form's table; rows without a day are ignored.

    Raises UsageError("form-cut") if the columns have different lengths, because hours would move to another row.
    """
    columns = [sent.many.get(name, []) for name in _COLUMNS]
    if len({len(column) for column in columns}) > 1:
        raise UsageError("form-cut", what="The table of hours is incomplete.", remedy="Load the page again.")
    rows = [
        {name: canonical(text) if name == "day" else text.strip() for name, text in zip(_COLUMNS, row, strict=True)}
        for row in zip(*columns, strict=True)
        if row[0].strip()
    ]
    others: dict[str, Any] = {name: sent.texts.get(name, "") for name in ("time_zone", "drift_check")}
    return parse(operation.fields, others | {"rows": rows}, strings=True)


def _typed_rows(sent: Sent) -> list[dict[str, str]]:
    """The rows of a table as they were typed, also where a column was cut off."""
    columns = [sent.many.get(name, []) for name in _COLUMNS]
    rows = itertools.zip_longest(*columns, fillvalue="")
    kept = [typed for row in rows if any((typed := dict(zip(_COLUMNS, row, strict=True))).values())]
    # Those that are ignored last: an error names a row by its number among the others.
    return sorted(kept, key=lambda typed: not typed["day"].strip())


def _then(operation: Operation, result: Any, values: Values) -> str:
    target = result.target if isinstance(result, NewTarget) else values.get("target", "")
    return LEADS_TO[operation.name].replace("{target}", str(target))


def _back(operation: Operation, sent: Sent) -> str:
    """The page of a form that failed; its address contains no unchecked input."""
    if operation.name == "upload-target":
        return "/appearances/new"
    if operation.name == "compute-scene":
        return "/appearances/new"
    target = sent.texts.get("target", "")
    of_target = ("compute", "house-compute", "fit-target", "outline-target")
    if operation.name in of_target and target.isascii() and target.isalnum():
        return f"/appearances/new/{target}"
    return "/appearances/new" if operation.name in ("fit-target", "outline-target") else LEADS_TO[operation.name]


class Setup:
    def __init__(self, panel: Panel, pages: Pages) -> None:
        self._panel, self._pages = panel, pages

    def entries(self) -> list[Entry]:
        forms = (("/setup/find", self._find), ("/setup/write", self._write))
        return [
            Entry("POST", path, "session", Role.TECHNICIAN, checked(self._panel, handler)) for path, handler in forms
        ]

    async def _find(self, _: Request, visitor: Visitor, sent: Sent) -> Response:
        """Search devices, and try the selected ones."""
        assert visitor.session is not None
        chosen, name = sent.many.get("key", []), sent.texts.get("name", "")
        kept: dict[str, Any] = {"found": None, "tried": {}, "name": name, "chosen": chosen, "here": "/setup"}
        try:
            devices = await self._panel.in_thread(lambda: list(self._panel.kiosk.find_devices()))
            tried = await self._panel.in_thread(lambda: self._tried(devices, chosen))
        except answers.FAILURES as error:
            visitor.session.notes.append(("error", f"{error.what} {error.remedy}"))
            return await self._pages.show("setup.html", visitor, kept, answers.status_of(error))
        return await self._pages.show("setup.html", visitor, kept | {"found": devices, "tried": tried})

    def _tried(self, devices: list[FoundDevice], chosen: list[str]) -> dict[str, TriedDevice]:
        tried: dict[str, TriedDevice] = {}
        for device in devices:
            if device.key in chosen:
                try:
                    tried[device.key] = self._panel.kiosk.try_device(device.key)
                except answers.FAILURES as error:
                    tried[device.key] = TriedDevice(False, f"{error.what} {error.remedy}")
        return tried

    async def _write(self, _: Request, visitor: Visitor, sent: Sent) -> Response:
        """Write the tables of the selected devices; the settings page shows what is wrong with them."""
        assert visitor.session is not None
        chosen = sent.many.get("key", [])
        text = ""
        try:
            devices = await self._panel.in_thread(lambda: list(self._panel.kiosk.find_devices()))
            text = stage_text(sent.texts.get("name", ""), [device for device in devices if device.key in chosen])
            await self._panel.in_thread(lambda: self._panel.kiosk.save_settings(text))
        except answers.FAILURES as error:
            facts: dict[str, Any] = {"text": text, "groups": [], "problem": error, "here": "/settings"}
            return await self._pages.show("settings.html", visitor, facts, 422)
        visitor.session.notes.append(("good", gettext("The stage is set up. Aim the projectors next.")))
        return RedirectResponse("/aiming", 303)


def stage_text(name: str, devices: list[FoundDevice]) -> str:
    """A stage.toml of these devices. A JSON string is also a TOML string."""
    tables = "\n".join(device.table.strip() + "\n" for device in devices)
    return f"[stage]\nname = {json.dumps(name.strip(), ensure_ascii=False)}\n\n{tables}"
