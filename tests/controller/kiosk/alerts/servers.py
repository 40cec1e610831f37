"""A mail server and a web server in this process, which keep what they get."""

from __future__ import annotations

import json
import ssl
import threading
from email import message_from_bytes, policy
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any, Self

from aiosmtpd.controller import Controller
from aiosmtpd.smtp import AuthResult, Envelope, LoginPassword

from tests.ports import free_port


class MailServer:
    """``mails``: what came; ``logins``: who logged in. ``tls`` for STARTTLS, which it then insists on with a log-in."""

    def __init__(self, tls: ssl.SSLContext | None = None, *, refuses: bool = False) -> None:
        self.mails: list[Any] = []
        self.logins: list[tuple[str, str]] = []
        self.refuses = refuses
        self.port = free_port()
        self._controller = Controller(
            self, hostname="127.0.0.1", port=self.port, tls_context=tls, require_starttls=tls is not None,
            auth_required=tls is not None, authenticator=self._authenticated if tls is not None else None,
        )  # fmt: skip

    @property
    def bodies(self) -> list[str]:
        return [mail.get_content() for mail in self.mails]

    async def handle_DATA(self, _: Any, __: Any, envelope: Envelope) -> str:
        if self.refuses:
            return "451 try later"
        assert isinstance(envelope.content, bytes)
        self.mails.append(message_from_bytes(envelope.content, policy=policy.default))
        return "250 OK"

    def _authenticated(self, _: Any, __: Any, ___: Any, ____: Any, data: Any) -> AuthResult:
        assert isinstance(data, LoginPassword)
        self.logins.append((data.login.decode(), data.password.decode()))
        return AuthResult(success=self.logins[-1][1] == "swordfish")

    def __enter__(self) -> Self:
        self._controller.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._controller.stop()


class WebServer:
    """``posts``: the bodies that came; it answers with ``code``."""

    def __init__(self, code: int = 204) -> None:
        self.posts: list[dict[str, Any]] = []
        self.code = code
        told = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["content-length"]))
                if told.code < 300:  # before the answer: its reader may look at once
                    told.posts.append(json.loads(body))
                self.send_response(told.code)
                self.send_header("location", "/elsewhere")
                self.end_headers()

            def log_message(self, *_: Any) -> None:
                return

        self._server = HTTPServer(("127.0.0.1", 0), Handler)
        self.address = f"http://127.0.0.1:{self._server.server_port}/hook"
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)

    @property
    def events(self) -> list[dict[str, Any]]:
        return [event for post in self.posts for event in post["events"]]

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()
