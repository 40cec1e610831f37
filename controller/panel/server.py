"""Serves the panel: plain HTTP on loopback by default, TLS if configured."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
import ssl
import threading
import time

import uvicorn
from starlette.applications import Starlette

from controller.core.errors import UsageError, WorkError
from controller.kiosk.panel_address import bracketed, is_loopback
from controller.panel.context import PanelOptions

START_S = 10.0
ACCEPTING_S = 0.05
"""In so long, what is being accepted has become a connection that can be closed."""


class _Server(uvicorn.Server):
    """Leaves no connection behind. Uvicorn does: one that was being accepted when it began to stop stays open, no one
    reads it, and a browser that sends its next request there waits for good.
    """

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        for server in self.servers:
            server.close()
        await asyncio.sleep(ACCEPTING_S)
        await super().shutdown(sockets)
        for connection in tuple(self.server_state.connections):
            connection.transport.abort()
        # The loop closes them in its next turn.
        await asyncio.sleep(0)


class PanelServer:
    """Serves the panel in its own thread. Call ``start`` and ``stop`` once each."""

    def __init__(self, app: Starlette, options: PanelOptions) -> None:
        """Raises UsageError("panel-open-without-tls") for an address beyond this machine without TLS."""
        check_exposure(options)
        config = uvicorn.Config(
            app,
            host=options.host,
            port=options.port,
            ssl_certfile=options.tls_certificate,
            ssl_keyfile=options.tls_key,
            ssl_version=ssl.PROTOCOL_TLS_SERVER,
            log_config=None,
            access_log=False,
            ws="none",
            server_header=False,
            # A client's header must not decide which address the login limits count.
            proxy_headers=False,
            timeout_keep_alive=20,
            timeout_graceful_shutdown=1,
            limit_concurrency=options.most_open_panels + 100,
            h11_max_incomplete_event_size=32 << 10,
        )
        self._server, self._options, self._app = _Server(config), options, app
        self._thread = threading.Thread(target=self._run, name="panel", daemon=True)

    def _run(self) -> None:
        # Uvicorn's signal that it could not listen; ``start`` reports it.
        with contextlib.suppress(SystemExit):
            self._server.run()

    def start(self) -> str:
        """Start serving; returns the address.

        Raises WorkError("panel-port-taken") if another program listens there, and ("panel-not-started").
        """
        check_port(self._options.host, self._options.port)
        self._thread.start()
        until_s = time.monotonic() + START_S
        while not self._server.started:
            if not self._thread.is_alive() or time.monotonic() > until_s:
                raise _not_started(self._options.host, self._options.port)
            time.sleep(0.005)
        port = self._server.servers[0].sockets[0].getsockname()[1]
        return f"{'https' if self._options.tls else 'http'}://{bracketed(self._options.host)}:{port}/"

    def stop(self) -> None:
        """Stop, and disconnect open panels; their pages reconnect after the next start."""
        self._app.state.panel.hub.end()
        self._server.should_exit = True
        self._thread.join(START_S)


def check_exposure(options: PanelOptions) -> None:
    """Raises UsageError("panel-open-without-tls"): passwords must not cross a network unencrypted."""
    if not is_loopback(options.host) and not options.tls:
        raise UsageError(
            "panel-open-without-tls",
            what=f"The panel would be reachable at {options.host} without TLS.",
            remedy="Set --certificate and --key, or use the address 127.0.0.1 and a tunnel.",
        )


def check_port(host: str, port: int) -> None:
    """Raises WorkError("panel-port-taken" or "panel-not-started"); uvicorn only logs why."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.socket(family) as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind((host, port))
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise WorkError(
                "panel-port-taken",
                what=f"Port {port} of {host} is used by another program.",
                remedy=f"Stop that program, or choose another port: --panel {bracketed(host)}:{port % 65535 + 1}.",
            ) from error
        raise _not_started(host, port, error.strerror) from error


def _not_started(host: str, port: int, why: str | None = None) -> WorkError:
    detail = f": {why}" if why else ""
    return WorkError(
        "panel-not-started",
        what=f"The panel could not listen on {host}, port {port}{detail}.",
        remedy="Use an address of this machine and a port of 1024 or higher: --panel HOST:PORT.",
    )
