"""The identity of a request (session cookie on pages, token in the API), and the refusal if a route needs more."""

from __future__ import annotations

import base64
import hashlib
import hmac
import secrets
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Final, Literal
from urllib.parse import urlsplit

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response

from controller.kiosk.panel_address import is_loopback
from controller.kiosk.store.accounts import Role
from controller.panel.auth.sessions import Session
from controller.panel.context import Panel
from controller.panel.words.language import mark

Way = Literal["public", "session", "token"]


@dataclass(frozen=True, slots=True)
class Visitor:
    """The identified user or token. ``session`` and its cookie ``secret`` are set on pages."""

    name: str
    role: Role
    session: Session | None = None
    secret: str = ""
    must_change_password: bool = False


Endpoint = Callable[[Request, Visitor], Awaitable[Response]]
ANONYMOUS: Final = Visitor("", Role.VIEWER)
OPEN_TO_ONE_TIME: Final = frozenset({"/password", "/logout"})
"""The only paths that a one-time password gives access to."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One row of the table of routes. ``role`` is None only for public ones."""

    method: str
    path: str
    way: Way
    role: Role | None
    endpoint: Endpoint


def cookie_name(panel: Panel) -> str:
    """The prefix makes browsers insist on TLS, this host and the whole path."""
    return "__Host-velatura" if panel.options.tls else "velatura"


def visitor(panel: Panel, request: Request, way: Way) -> Visitor | None:
    """The identity of the request, or None."""
    if way == "token":
        scheme, _, shown = request.headers.get("authorization", "").partition(" ")
        token = panel.accounts.by_token(shown.strip()) if scheme.lower() == "bearer" and shown.isascii() else None
        return None if token is None else Visitor(token.name, token.role)
    secret = request.cookies.get(cookie_name(panel), "")
    session = panel.sessions.get(secret) if secret else None
    account = panel.accounts.get(session.account) if session else None
    if account is None:
        return None
    return Visitor(account.name, account.role, session, secret, account.one_time)


async def guarded(panel: Panel, entry: Entry, request: Request) -> Response:  # noqa: PLR0911 - one for each refusal
    """Call a route of the table if the visitor is allowed to use it."""
    if entry.way == "public":
        return await entry.endpoint(request, ANONYMOUS)
    address = request.client.host if request.client else ""
    who = visitor(panel, request, entry.way)
    if who is None:
        if entry.way == "session":
            if _navigates(request):
                return RedirectResponse("/login", 303)
            raise _denied(401)
        if "authorization" in request.headers:
            # Only wrong ones wait: others behind the same address (a proxy, a router) have good ones.
            if (wait_s := panel.by_token.wait_s(address)) > 0:
                return _too_many(wait_s)
            panel.by_token.failed(address)
            panel.refused.add(f"A wrong token from {address} was refused")
        return _api_error(401, "not-known", "The request has no valid token.", "Send 'Authorization: Bearer ...'.")
    # Deny by default: an entry without a role is a mistake in the table, and must not grant access.
    if entry.role is None or who.role < entry.role:
        if entry.way == "session":
            raise _denied(403)
        return _api_error(
            403, "not-allowed", "The role of this token does not allow this.", "Use a token with a higher role."
        )
    if who.must_change_password and request.url.path not in OPEN_TO_ONE_TIME:
        if _navigates(request):
            return RedirectResponse("/password", 303)
        raise _denied(403)
    return await entry.endpoint(request, who)


def _navigates(request: Request) -> bool:
    return request.method == "GET" and "text/html" in request.headers.get("accept", "*/*").replace("*/*", "text/html")


def _denied(status: int) -> HTTPException:
    not_allowed = mark("Your role does not allow this. A technician can change your role.")
    text = mark("Log in first.") if status == 401 else not_allowed
    return HTTPException(status, text)


def _api_error(status: int, code: str, what: str, remedy: str) -> Response:
    headers = {"www-authenticate": "Bearer"} if status == 401 else None
    return JSONResponse({"code": code, "what": what, "remedy": remedy}, status, headers)


def _too_many(wait_s: float) -> Response:
    answer = _api_error(429, "too-many-tries", "Too many wrong tokens came from this address.", "Wait, then try again.")
    answer.headers["retry-after"] = str(int(wait_s) + 1)
    return answer


def same_origin(panel: Panel, request: Request) -> bool:
    """Whether the browser says that the request comes from our own page. Old browsers say nothing; the CSRF token
    protects them.

    A reverse proxy may have replaced the header Host: then the browser's own judgement counts (Sec-Fetch-Site), the
    name that a proxy on this computer passes on (X-Forwarded-Host), or a name that was given for the panel.
    """
    headers = request.headers
    origin, judged = headers.get("origin"), headers.get("sec-fetch-site")
    if judged is not None and judged not in ("same-origin", "none"):
        return False
    if origin is None or judged == "same-origin":
        return True
    source, names = urlsplit(origin).netloc.lower(), {headers.get("host", "").lower()}
    if request.client is not None and is_loopback(request.client.host):
        names.add(headers.get("x-forwarded-host", "").partition(",")[0].strip().lower())
    return bool(source) and (source in names or source in panel.options.names)


def form_pair(panel: Panel) -> tuple[str, str]:
    """Cookie and CSRF token of the log-in form, which has no session yet."""
    cookie = secrets.token_urlsafe(24)
    return cookie, form_token(panel, cookie)


def form_token(panel: Panel, cookie: str) -> str:
    digest = hmac.digest(panel.form_key, cookie.encode("utf-8", "replace"), hashlib.sha256)
    return base64.urlsafe_b64encode(digest).decode()
