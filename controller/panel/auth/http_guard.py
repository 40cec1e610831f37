"""Checks before every route: host name and size of the body; and the security headers of every response."""

from __future__ import annotations

import ipaddress
from typing import Final

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

SMALL_BODY: Final = 2 << 20
"""Bytes of a form or JSON body; uploads have their own limits."""

POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; font-src 'self'; connect-src 'self'; "
    "frame-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
HEADERS: Final = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    # "no-referrer" would also remove the Origin header, which changes are checked by.
    "referrer-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), microphone=(), geolocation=(), payment=(), usb=()",
}


class BodyTooLarge(Exception):
    """The body is larger than this route accepts."""


class Guard:
    """Wraps the panel. ``hosts`` without port; ``any_address``: IP addresses, too; ``body_limits`` bytes by path, for
    the paths that take uploads.
    """

    def __init__(
        self, app: ASGIApp, *, hosts: tuple[str, ...], body_limits: dict[str, int], tls: bool, any_address: bool = False
    ) -> None:
        self._app, self._hosts, self._limits = app, frozenset(host.lower() for host in hosts), body_limits
        self._any_address = any_address
        self._headers = {**HEADERS, "strict-transport-security": "max-age=31536000"} if tls else HEADERS

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in self._headers.items():
                    headers.setdefault(name, value)
                headers.setdefault("cache-control", "no-store")
            await send(message)

        refusal = self._refusal(scope)
        if refusal is not None:
            await refusal(scope, receive, send_with_headers)
            return
        await self._app(scope, _limited(receive, self._limit(scope)), send_with_headers)

    def _limit(self, scope: Scope) -> int:
        return self._limits.get(scope["path"], SMALL_BODY)

    def _refusal(self, scope: Scope) -> PlainTextResponse | None:
        headers = Headers(scope=scope)
        host = headers.get("host", "").lower()
        name = host if host.endswith("]") else host.rpartition(":")[0] or host
        if name not in self._hosts and not (self._any_address and _is_address(name)):
            # A page of another name that resolves to this machine must not reach it (DNS rebinding).
            return PlainTextResponse("This host name is not allowed. Start the kiosk with --name to allow it.", 421)
        length = headers.get("content-length", "0")
        if not length.isascii() or not length.isdigit() or int(length[:18]) > self._limit(scope):
            return PlainTextResponse("Too large.", 413, headers={"connection": "close"})
        return None


def _is_address(name: str) -> bool:
    """Whether a name needs no resolving, so that no one else can make it resolve to this machine."""
    try:
        ipaddress.ip_address(name.strip("[]"))
    except ValueError:
        return False
    return True


def _limited(receive: Receive, most: int) -> Receive:
    """``receive``, but raising BodyTooLarge after more than ``most`` bytes, whatever Content-Length says."""
    received = 0

    async def counted() -> Message:
        nonlocal received
        message = await receive()
        received += len(message.get("body", b""))
        if received > most:
            raise BodyTooLarge
        return message

    return counted
