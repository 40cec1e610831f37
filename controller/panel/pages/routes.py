"""The pages: each reads values from the kiosk and renders a template."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final
from urllib.parse import quote

from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, RedirectResponse, Response, StreamingResponse

from controller.core.errors import UsageError
from controller.kiosk.operations.fields import parse
from controller.kiosk.operations.operation import Answer, Operation
from controller.kiosk.roles import Role
from controller.kiosk.schedule import ALLOWED_DAYS, grouped
from controller.optics.calibrate.verify import error_causes
from controller.panel import answers
from controller.panel.auth.identity import Entry, Visitor
from controller.panel.context import Panel
from controller.panel.pages import calendar
from controller.panel.pages.calendar import lamp_reports
from controller.panel.pages.drawing import EVENTS_SHOWN, Drawing
from controller.panel.pages.settings_fields import groups
from controller.panel.words.language import language, mark

_CAUSES: Final = [(cause.name.lower(), name) for cause, (name, _, _) in error_causes.WORDS.items()]
"""The classes of the style sheet, with the words of the legend."""
GROUPS: Final = (mark("Show"), mark("Calibration"), mark("System"))
NAVIGATION: Final = (
    ("/", mark("Now"), Role.VIEWER, "Show"),
    ("/house", mark("House"), Role.VIEWER, "Show"),
    ("/appearances", mark("Appearances"), Role.VIEWER, "Show"),
    ("/schedule", mark("Schedule"), Role.VIEWER, "Show"),
    ("/results", mark("Results"), Role.VIEWER, "Calibration"),
    ("/aiming", mark("Aiming"), Role.TECHNICIAN, "Calibration"),
    ("/lamps", mark("Lamps"), Role.VIEWER, "System"),
    ("/events", mark("Events"), Role.VIEWER, "System"),
    ("/doctor", mark("Doctor"), Role.OPERATOR, "System"),
    ("/settings", mark("Settings"), Role.TECHNICIAN, "System"),
    ("/care", mark("Backup"), Role.TECHNICIAN, "System"),
    ("/accounts", mark("Accounts"), Role.TECHNICIAN, "System"),
)
BELOW: Final = {"/setup": "/settings", "/password": "/accounts", "/reports": "/results", "/changes": "/doctor",
                "/mesh": "/appearances"}  # fmt: skip
"""Pages that are not in the navigation, and those that they belong to."""
NO_TARGET: Final[dict[str, Any]] = {"target": None, "reach": None, "outline": "[]", "stamp": 0}
HOUSE_EVENTS: Final = 50
FRAMED: Final = {
    "content-security-policy": "sandbox; default-src 'none'; style-src 'unsafe-inline'; img-src data:; font-src data:; "
    "frame-ancestors 'self'",
    "x-frame-options": "SAMEORIGIN",
}
"""Of a report that a page shows in a frame."""
_SEEN: Final = (Answer.PICTURE, Answer.JPEG, Answer.PAGE)

Facts = Callable[[Request], dict[str, Any]]


@dataclass(frozen=True, slots=True)
class Group:
    """A group of pages: ``path`` of its first one, and ``pages`` (path, label); ``chosen``: the page is one of them."""

    label: str
    path: str
    pages: tuple[tuple[str, str], ...]
    chosen: bool


def _navigation(role: Role, here: str, *, house: bool) -> list[Group]:
    """``house``: this kiosk is that of a house; any other may join one, which a technician does."""
    least = {} if house else {"/house": Role.TECHNICIAN}
    allowed = [entry for entry in NAVIGATION if role >= least.get(entry[0], entry[2])]
    at = "/" + here.split("/")[1]
    at = BELOW.get(at, at)
    groups = []
    for label in GROUPS:
        pages = tuple((path, name) for path, name, _, group in allowed if group == label)
        groups.append(Group(label, pages[0][0], pages, any(path == at for path, _ in pages)))
    return groups


@dataclass(frozen=True, slots=True)
class FormPage:
    """The page of a form, drawn from what was typed into it."""

    template: str
    facts: Callable[[Mapping[str, Any]], dict[str, Any]]


class Pages:
    """All pages of one panel. The values of a page are read in a thread."""

    def __init__(self, panel: Panel, drawing: Drawing) -> None:
        self._panel, self._drawing = panel, drawing
        self._least = {operation.name: operation.role for operation in panel.operations}

    def entries(self) -> list[Entry]:
        table: list[tuple[str, Role, str, Facts]] = [
            ("/", Role.VIEWER, "now.html", self._now),
            ("/house", Role.VIEWER, "house.html", self._house),
            ("/appearances", Role.VIEWER, "appearances.html", self._appearances),
            ("/schedule", Role.VIEWER, "schedule.html", self._schedule),
            ("/results", Role.VIEWER, "results.html", self._results),
            ("/results/{run}", Role.VIEWER, "results.html", self._results),
            ("/reports/{run}", Role.VIEWER, "shown_report.html", lambda request: {"run": request.path_params["run"]}),
            ("/events", Role.VIEWER, "events.html", self._events),
            ("/lamps", Role.VIEWER, "lamps.html", self._lamps),
            ("/password", Role.VIEWER, "password.html", lambda _: {}),
            ("/appearances/new", Role.OPERATOR, "target.html", self._new),
            ("/appearances/new/{target}", Role.OPERATOR, "target.html", self._target),
            ("/appearances/scenes/{scene}", Role.OPERATOR, "scene.html", self._scene),
            ("/mesh", Role.OPERATOR, "mesh.html", self._mesh),
            ("/mesh/{mesh}", Role.OPERATOR, "mesh.html", self._mesh),
            ("/doctor", Role.OPERATOR, "doctor.html", self._doctor),
            ("/changes", Role.OPERATOR, "changes.html", lambda _: {"found": self._panel.kiosk.changes()}),
            ("/aiming", Role.TECHNICIAN, "aiming.html", self._aiming),
            ("/house/update", Role.TECHNICIAN, "update.html", self._house_update),
            ("/settings", Role.TECHNICIAN, "settings.html", self._settings),
            ("/care", Role.TECHNICIAN, "care.html", lambda _: {}),
            ("/accounts", Role.TECHNICIAN, "accounts.html", self._accounts),
            ("/setup", Role.TECHNICIAN, "setup.html", lambda _: {"found": None, "tried": {}, "name": "", "chosen": ()}),
        ]
        entries = [Entry("GET", path, "session", role, self._page(name, facts)) for path, role, name, facts in table]
        entries += [
            Entry("GET", "/see" + op.path, "session", op.role, self._picture(op))
            for op in self._panel.operations
            if not op.changes and op.answer in _SEEN
        ]
        late = (
            ("doctor", "late_doctor.html", self._found), ("reach/{target}", "late_reach.html", self._reached),
            ("computed/{target}", "late_computed.html", self._computed),
            ("scenes/{scene}", "late_reach.html", self._rendered),
        )  # fmt: skip
        entries += [
            Entry("GET", f"/late/{path}", "session", Role.OPERATOR, self._late(name, facts))
            for path, name, facts in late
        ]
        entries.append(Entry("GET", "/late/house", "session", Role.VIEWER, self._late_house))
        entries.append(Entry("GET", "/shown/{run}", "session", Role.VIEWER, self._report))
        return [*entries, Entry("GET", "/live", "session", Role.VIEWER, self._live)]

    async def show(self, template: str, visitor: Visitor, facts: dict[str, Any], status: int = 200) -> Response:
        """Render a page with the values that every page needs."""
        return HTMLResponse(await self._panel.in_thread(lambda: self._drawn(template, visitor, facts)), status)

    def _drawn(self, template: str, visitor: Visitor, facts: dict[str, Any]) -> str:
        kiosk, session = self._panel.kiosk, visitor.session
        assert session is not None, "pages with navigation need a session"
        notes, session.notes = session.notes, []
        common = {
            "state": kiosk.snapshot(),
            "visitor": visitor,
            "csrf": session.csrf,
            "notes": notes,
            "navigation": _navigation(visitor.role, str(facts.get("here", "/")), house=self._panel.house.there),
            "may": lambda name: visitor.role >= self._least[name],
            "typed": {},
        }
        return self._drawing.page(template, common | facts)

    def _page(self, template: str, facts: Facts) -> Callable[[Request, Visitor], Awaitable[Response]]:
        async def answer(request: Request, visitor: Visitor) -> Response:
            if template == "now.html" and self._panel.house.there and self._panel.kiosk.snapshot().needs_setup:
                # A house needs no stage of its own.
                return RedirectResponse("/house", 303)
            try:
                values = await self._panel.in_thread(lambda: facts(request))
                return await self.show(template, visitor, {"here": request.url.path} | values)
            except answers.FAILURES as error:
                return await self.show(
                    "problem.html", visitor, {"here": request.url.path, "error": error}, answers.status_of(error)
                )

        return answer

    def _late(self, template: str, facts: Facts) -> Callable[[Request, Visitor], Awaitable[Response]]:
        """A part of a page that takes seconds; the page's script asks for it, so that the page is there at once."""

        async def answer(request: Request, _: Visitor) -> Response:
            try:
                values, status = await self._panel.in_thread(lambda: facts(request)), 200
            except answers.FAILURES as error:
                values, status = {"error": error}, answers.status_of(error)
            name = template if status == 200 else "late_problem.html"
            return HTMLResponse(await self._panel.in_thread(lambda: self._drawing.page(name, values)), status)

        return answer

    def _picture(self, operation: Operation) -> Callable[[Request, Visitor], Awaitable[Response]]:
        async def answer(request: Request, visitor: Visitor) -> Response:
            try:
                # Else the query is ignored: pages add a number to it to reload a picture.
                values = parse(operation.fields, request.path_params, strings=True)
                found = await answers.run(self._panel, operation, values, visitor.name)
                if "small" in request.query_params and operation.answer is Answer.PICTURE:
                    return await self._panel.in_thread(lambda: answers.small_picture(found))
                return answers.response(operation, found, values)
            except answers.FAILURES as error:
                return answers.failure(error)

        return answer

    async def _report(self, request: Request, _: Visitor) -> Response:
        """A report inside its page. It is one file with its own styles and pictures, and must not run anything."""
        try:
            path = await self._panel.in_thread(lambda: self._panel.kiosk.report(request.path_params["run"]))
        except answers.FAILURES as error:
            return answers.failure(error)
        return FileResponse(path, media_type="text/html", headers=FRAMED)

    async def _live(self, request: Request, visitor: Visitor) -> Response:
        def alive() -> bool:
            return self._panel.sessions.get(visitor.secret, touch=False) is not None

        headers = {"x-accel-buffering": "no"}
        return StreamingResponse(
            self._panel.hub.stream(alive, language()), media_type="text/event-stream", headers=headers
        )

    def _settings(self, _: Request) -> dict[str, Any]:
        kiosk, problem = self._panel.kiosk, None
        text = kiosk.settings()
        try:
            if text:
                kiosk.validate_settings(text)
        except answers.FAILURES as error:
            problem = error
        return {"text": text, "problem": problem, "groups": groups(text)}

    def _now(self, _: Request) -> dict[str, Any]:
        """Without the camera's picture, which may wait for the camera: the script asks for it while a job runs."""
        kiosk = self._panel.kiosk
        if kiosk.snapshot().needs_setup:
            return {"appearances": [], "photographed": {}}
        photographed = {one.name: one.history[0] for one in kiosk.comparisons() if "achieved" in one.pictures}
        return {"appearances": list(kiosk.appearances()), "photographed": photographed}

    def _house(self, _: Request) -> dict[str, Any]:
        """None as the house where a technician may let this stage join one."""
        if not self._panel.house.there:
            return {"house": None}
        house = self._panel.house.open()
        now, rows = house.now(), house.events()[-HOUSE_EVENTS:][::-1]
        names = sorted({name for stage in now.stages for name in stage.appearances})
        return {"house": now, "names": names, "rows": rows}

    def _house_update(self, _: Request) -> dict[str, Any]:
        house = self._panel.house.open()
        return {"rollout": house.rollout(), "groups": house.now().groups}

    async def _late_house(self, _: Request, visitor: Visitor) -> Response:
        """The stages again, for an open page."""
        assert visitor.session is not None
        values = {"csrf": visitor.session.csrf, "may": lambda name: visitor.role >= self._least[name]}

        def drawn() -> str:
            return self._drawing.page("late_house.html", {"house": self._panel.house.open().now(), **values})

        try:
            return HTMLResponse(await self._panel.in_thread(drawn))
        except answers.FAILURES as error:
            return answers.failure(error)

    def _aiming(self, _: Request) -> dict[str, Any]:
        kiosk = self._panel.kiosk
        return {"aiming": kiosk.aiming(), "live": kiosk.camera_picture() is not None}

    def _appearances(self, _: Request) -> dict[str, Any]:
        return {"appearances": list(self._panel.kiosk.appearances())}

    def _lamps(self, _: Request) -> dict[str, Any]:
        kiosk = self._panel.kiosk
        return {"reports": lamp_reports(kiosk.snapshot().lamps, kiosk.lamp_history(), kiosk.events())}

    def with_form(self, operation: str) -> FormPage | None:
        """The page whose form sends this operation, if something is typed into it."""
        return {
            "set-schedule": FormPage("schedule.html", lambda typed: self._hours(typed["rows"])),
            "upload-target": FormPage("target.html", lambda typed: self._untargeted()),
            "compute-scene": FormPage("scene.html", lambda typed: self._known_scene(str(typed["scene"]))),
            "compute": FormPage("target.html", lambda typed: self._reach(typed["target"])),
        }.get(operation)

    def _schedule(self, _: Request) -> dict[str, Any]:
        return self._hours(grouped(self._panel.kiosk.schedule().rows))

    def _hours(self, rows: Sequence[Any]) -> dict[str, Any]:
        schedule = self._panel.kiosk.schedule()
        names = [appearance.name for appearance in self._panel.kiosk.appearances()]
        return {"schedule": schedule, "rows": rows, "days": calendar.days(schedule),
                "later": calendar.later(schedule), "names": names,
                "zones": calendar.zones(), "allowed": ALLOWED_DAYS}  # fmt: skip

    def _results(self, request: Request) -> dict[str, Any]:
        runs = list(self._panel.kiosk.runs())
        name = request.path_params.get("run") or (runs[0] if runs else None)
        compared = self._panel.kiosk.comparisons()
        results = self._panel.kiosk.results(name) if name else None
        return {"runs": runs, "compared": compared, "results": results, "causes": _CAUSES}

    def _events(self, request: Request) -> dict[str, Any]:
        level = request.query_params.get("level", "")
        words = request.query_params.get("words", "")[:100]
        rows = [
            row
            for row in self._panel.kiosk.events()
            if level in ("", row.level) and words.lower() in f"{row.text} {row.code}".lower()
        ]
        return {"rows": rows[-EVENTS_SHOWN:][::-1], "level": level, "words": words}

    def _doctor(self, request: Request) -> dict[str, Any]:
        """Without a script the page has to wait for its part."""
        return self._found(request) if "wait" in request.query_params else {"findings": None}

    def _found(self, _: Request) -> dict[str, Any]:
        return {"findings": list(self._panel.kiosk.doctor())}

    def _new(self, _: Request) -> dict[str, Any]:
        """The first preview of a calibration takes seconds to prepare, and a person needs longer to choose a file."""

        def prepare() -> None:
            with contextlib.suppress(*answers.FAILURES):
                self._panel.kiosk.view()

        threading.Thread(target=prepare, name="prepare-preview", daemon=True).start()
        return self._untargeted()

    def _untargeted(self) -> dict[str, Any]:
        return NO_TARGET | {"scenes": self._panel.kiosk.scenes(), "view": self._view_px()}

    def _view_px(self) -> tuple[int, int]:
        """Of the camera; a usual one while it is not known."""
        return self._panel.kiosk.view_px() or (3, 2)

    def _mesh(self, request: Request) -> dict[str, Any]:
        """``side``: see ``operations.arguments.MeshSide``."""
        kiosk, mesh, side = self._panel.kiosk, request.path_params.get("mesh"), request.query_params.get("side", "0")
        names, laid = kiosk.meshes(), kiosk.laid_mesh()
        if mesh is not None and mesh not in names:
            raise UsageError("mesh-unknown", what="There is no such mesh.", remedy="Choose one of the list.")
        stamp = 0 if laid is None else laid.pictures["laid"].stat().st_mtime_ns
        return {"meshes": names, "mesh": mesh, "laid": laid, "stamp": stamp,
                "side": int(side) % 32 if side.isdecimal() else 0}  # fmt: skip

    def _scene(self, request: Request) -> dict[str, Any]:
        """Without a script the page has to wait for what Blender renders."""
        name = request.path_params["scene"]
        return self._rendered(request) if "wait" in request.query_params else self._known_scene(name)

    def _known_scene(self, name: str) -> dict[str, Any]:
        scene = next((one for one in self._panel.kiosk.scenes() if one.name == name), None)
        if scene is None:
            raise UsageError("scene-unknown", what="There is no such scene.", remedy="Choose one of the list.")
        return {"scene": scene, "reach": None}

    def _rendered(self, request: Request) -> dict[str, Any]:
        facts = self._known_scene(request.path_params["scene"])
        found = self._panel.kiosk.scene_reach(facts["scene"].name)
        return facts | {
            "reach": found, "stamp": found.pictures["result"].stat().st_mtime_ns,
            "at": f"/see/scenes/{quote(facts['scene'].name)}/reach",
        }  # fmt: skip

    def prepare_reach(self, target: str) -> None:
        """Begin to calculate what of a target is in reach; the page that shows it waits for the rest only."""

        def prepare() -> None:
            with contextlib.suppress(*answers.FAILURES):
                self._panel.kiosk.reach(self._panel.targets.path(target))

        threading.Thread(target=prepare, name="prepare-reach", daemon=True).start()

    def _target(self, request: Request) -> dict[str, Any]:
        target = request.path_params["target"]
        return self._reached(request) if "wait" in request.query_params else self._reach(target)

    def _reach(self, target: str) -> dict[str, Any]:
        return {"target": target, "reach": None, **self._drawn_on(target)}

    def _drawn_on(self, target: str) -> dict[str, Any]:
        outline, stamp = self._panel.targets.outline(target), self._panel.targets.path(target).stat().st_mtime_ns
        house = self._panel.house.open().now() if self._panel.house.there else None
        return {"outline": outline, "stamp": stamp, "view": self._view_px(), "house": house,
                "proposed": self._panel.targets.proposed(target)}  # fmt: skip

    def _reached(self, request: Request) -> dict[str, Any]:
        target = request.path_params["target"]
        file = self._panel.targets.path(target)
        found = self._panel.kiosk.reach(file)
        return {"target": target, "reach": found, "at": f"/see/targets/{target}/reach", **self._drawn_on(target)}

    def _computed(self, request: Request) -> dict[str, Any]:
        """A whole solve; without one, why, and what of the target is in reach by each pixel alone."""
        target = request.path_params["target"]
        file = self._panel.targets.path(target)
        found, problem = None, ""
        try:
            found = self._panel.kiosk.computed(file)
        except answers.FAILURES as error:
            problem = error.what
        picture = f"/see/targets/{target}/{'computed/picture' if found else 'reach/result'}"
        return {"computed": found, "problem": problem, "picture": picture, "stamp": file.stat().st_mtime_ns}

    def _accounts(self, _: Request) -> dict[str, Any]:
        return self.accounts()

    def accounts(self) -> dict[str, Any]:
        return {"accounts": self._panel.accounts.all(), "tokens": self._panel.accounts.tokens(), "shown": None}
