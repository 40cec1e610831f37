"""The panel as a Starlette application with one table of routes."""

from __future__ import annotations

import contextlib
import mimetypes
import shutil
from collections.abc import AsyncIterator, Callable, Sequence
from importlib import resources
from typing import Final

import anyio
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from controller.kiosk.interface import Kiosk
from controller.kiosk.operations.house import House
from controller.kiosk.operations.operation import Operation
from controller.kiosk.operations.table import OPERATIONS
from controller.kiosk.panel_address import EVERYWHERE
from controller.kiosk.store.accounts import Accounts
from controller.panel import answers, api
from controller.panel.answers import FAILURES
from controller.panel.auth.http_guard import BodyTooLarge, Guard
from controller.panel.auth.identity import Endpoint, Entry, Visitor, guarded
from controller.panel.auth.routes import Entrance
from controller.panel.auth.sessions import Sessions
from controller.panel.context import Panel, PanelOptions
from controller.panel.live import Hub
from controller.panel.mqtt.bridge import BuildingControl
from controller.panel.pages.drawing import Drawing
from controller.panel.pages.forms import Forms, Setup
from controller.panel.pages.routes import Pages
from controller.panel.uploads import Targets
from controller.panel.words.language import COOKIE, LOOK_COOKIE, chosen, gettext, speaking

FONTS: Final = ("velatura-sans-400.woff", "velatura-sans-700.woff")
STATIC: Final = ("style.css", "panel.js", "looks.js", "icon.svg", *FONTS)


def make_panel(
    kiosk: Kiosk, accounts: Accounts, options: PanelOptions, operations: Sequence[Operation] = OPERATIONS,
    house: House | None = None,
) -> Starlette:  # fmt: skip
    """The panel of ``kiosk``, ready to be served.

    The caller calls ``accounts.first_start()`` and shows the one-time password. The table of routes is at
    ``.state.entries``, the panel's parts at ``.state.panel``.
    """
    options.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    # Remains of uploads when the service was killed; a backup may have gigabytes.
    shutil.rmtree(options.folder / answers.INCOMING, ignore_errors=True)
    drawing = Drawing()

    def draw(name: str) -> dict[str, str]:
        # A stage that is not set up may have no schedule.
        with contextlib.suppress(*FAILURES):
            drawing.use_zone(kiosk.schedule().time_zone)
        with speaking(name):
            return drawing.parts(kiosk.snapshot(), list(kiosk.events()))

    panel = Panel(
        kiosk=kiosk,
        accounts=accounts,
        options=options,
        sessions=Sessions(options.folder / "sessions.json"),
        targets=Targets(options.folder / "targets", options.uploads, fitted=kiosk.fitted, view_px=kiosk.view_px),
        hub=Hub(draw, frames_per_s=options.frames_per_s, most=options.most_open_panels),
        operations=operations,
        house=house or House(),
    )
    with contextlib.suppress(*FAILURES):
        drawing.use_zone(kiosk.schedule().time_zone)
    pages = Pages(panel, drawing)
    table = [
        *pages.entries(),
        *Forms(panel, pages).entries(),
        *Entrance(panel, drawing, pages).entries(),
        *Setup(panel, pages).entries(),
        *api.entries(panel),
        *(Entry("GET", f"/static/{name}", "public", None, _static(name)) for name in STATIC),
    ]
    wrong = Wrong(drawing)
    guard = Middleware(
        Guard, hosts=options.hosts, body_limits=api.body_limits(panel), tls=options.tls,
        any_address=options.host in EVERYWHERE,
    )  # fmt: skip
    app = Starlette(
        routes=_routes(panel, table),
        middleware=[guard, Middleware(Speaking)],
        exception_handlers={BodyTooLarge: wrong.too_large, HTTPException: wrong.http, Exception: wrong.unforeseen},
        lifespan=_lifespan(panel),
    )
    app.state.entries, app.state.panel = table, panel
    return app


def _routes(panel: Panel, table: list[Entry]) -> list[Route]:
    """One route per path, so that a wrong method is answered with the allowed ones."""
    by_path: dict[str, dict[str, Entry]] = {}
    for entry in table:
        if by_path.setdefault(entry.path, {}).setdefault(entry.method, entry) is not entry:
            raise ValueError(f"{entry.method} {entry.path} is twice in the table of routes")
    return [_route(panel, path, entries) for path, entries in by_path.items()]


def _route(panel: Panel, path: str, entries: dict[str, Entry]) -> Route:
    async def answer(request: Request) -> Response:
        method = "GET" if request.method == "HEAD" else request.method
        response = await guarded(panel, entries[method], request)
        if request.method == "HEAD" and isinstance(response, StreamingResponse):
            # Its content is not read. An endless one would keep the connection from the next request.
            return Response(status_code=response.status_code, headers=dict(response.headers))
        return response

    return Route(path, answer, methods=list(entries))


def _lifespan(panel: Panel) -> Callable[[Starlette], contextlib.AbstractAsyncContextManager[None]]:
    @contextlib.asynccontextmanager
    async def living(_: Starlette) -> AsyncIterator[None]:
        unsubscribe = panel.kiosk.subscribe(panel.hub.changed)
        try:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(panel.hub.run)
                if panel.options.broker is not None:
                    tasks.start_soon(
                        BuildingControl(panel.kiosk, panel.options.broker, operations=panel.operations).run
                    )
                yield
                tasks.cancel_scope.cancel()
        finally:
            unsubscribe()

    return living


def _static(name: str) -> Endpoint:
    content = resources.files("controller.panel").joinpath("static", name).read_bytes()
    media_type = mimetypes.guess_type(name)[0]
    # The name of a font changes with it; all else must fit the pages of this version.
    kept = "max-age=604800" if name in FONTS else "no-cache"

    async def answer(_: Request, __: Visitor) -> Response:
        return Response(content, media_type=media_type, headers={"cache-control": kept})

    return answer


class Speaking:
    """Every request in the language that its visitor has chosen, or that the browser asks for."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request = Request(scope)
        name = chosen(request.cookies.get(COOKIE, ""), request.headers.get("accept-language", ""))
        with speaking(name, request.cookies.get(LOOK_COOKIE, "")):
            await self._app(scope, receive, send)


def _first_sentence(text: str) -> tuple[str, str, str]:
    """The first sentence, its end, and the others."""
    ends = [(text.find(end), end) for end in (". ", "。") if end in text[:-1]]
    if not ends:
        return text, "", ""
    at, end = min(ends)
    return text[:at], end, text[at + len(end) :]


class Wrong:
    """Answers for what no route answers: a page for browsers, one line for other clients."""

    def __init__(self, drawing: Drawing) -> None:
        self._drawing = drawing

    async def too_large(self, request: Request, _: Exception) -> Response:
        what, remedy = gettext("This is too large."), gettext("Send a smaller file: a picture of at most 64 MB.")
        return self._answer(request, 413, "Too large.", what, remedy, {"connection": "close"})

    async def http(self, request: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)
        what, remedy = {
            404: (gettext("This page does not exist."), gettext("Check the address, or begin at the first page.")),
            405: (gettext("This page can't be opened like that."), gettext("Begin at the first page.")),
        }.get(
            error.status_code,
            (gettext("This is not possible."), gettext("Go back, load the page again, and repeat it.")),
        )
        if error.detail.endswith((".", "。")):
            # Words of ours: what happened, and what to do.
            what, end, remedy = _first_sentence(gettext(error.detail))
            what += end.strip()
        return self._answer(request, error.status_code, error.detail, what, remedy, dict(error.headers or {}))

    async def unforeseen(self, request: Request, _: Exception) -> Response:
        """An error of ours. It is logged by the server, too."""
        what = gettext("Something went wrong in the panel.")
        remedy = gettext("The stage plays on. Repeat it; if it happens again, send the diagnostics file (page Backup).")
        return self._answer(request, 500, "Internal error.", what, remedy, {})

    def _answer(
        self, request: Request, status: int, line: str, what: str, remedy: str, headers: dict[str, str]
    ) -> Response:
        if "text/html" not in request.headers.get("accept", ""):
            return PlainTextResponse(line, status, headers=headers)
        page = self._drawing.page("wrong.html", {"status": status, "what": what, "remedy": remedy})
        return HTMLResponse(page, status, headers=headers)
