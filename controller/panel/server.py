"""Serving the panel: loopback and plain by default, TLS by configuration."""

from __future__ import annotations

import contextlib
import ipaddress
import ssl
import threading
import time

import uvicorn
from starlette.applications import Starlette

from controller.errors import UsageError, WorkError
from controller.panel.context import PanelOptions

START_S = 10.0


class PanelServer:
    """The panel in a thread of its own, beside the supervisor. ``start`` and ``stop`` once each."""

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
            # A header of a stranger must not decide whom the limits count.
            proxy_headers=False,
            timeout_keep_alive=20,
            timeout_graceful_shutdown=1,
            limit_concurrency=options.most_open_panels + 100,
            h11_max_incomplete_event_size=32 << 10,
        )
        self._server, self._options, self._app = uvicorn.Server(config), options, app
        self._thread = threading.Thread(target=self._run, name="panel", daemon=True)

    def _run(self) -> None:
        # How uvicorn says that it could not listen; ``start`` says it to people.
        with contextlib.suppress(SystemExit):
            self._server.run()

    def start(self) -> str:
        """Begin to serve; return the address. Raises WorkError("panel-not-started") when the port is taken."""
        self._thread.start()
        until_s = time.monotonic() + START_S
        while not self._server.started:
            if not self._thread.is_alive() or time.monotonic() > until_s:
                raise WorkError(
                    "panel-not-started",
                    what=f"The panel could not listen on {self._options.host}, port {self._options.port}.",
                    remedy="Another program may use the port: choose another one in stage.toml.",
                )
            time.sleep(0.005)
        port = self._server.servers[0].sockets[0].getsockname()[1]
        return f"{'https' if self._options.tls else 'http'}://{self._options.host}:{port}/"

    def stop(self) -> None:
        """End, also for panels that are open: their pages find the next start by themselves."""
        self._app.state.panel.hub.end()
        self._server.should_exit = True
        self._thread.join(START_S)


def check_exposure(options: PanelOptions) -> None:
    """Raises UsageError("panel-open-without-tls"): passwords must not cross a network in the clear."""
    try:
        loopback = ipaddress.ip_address(options.host).is_loopback
    except ValueError:
        loopback = options.host == "localhost"
    if not loopback and not options.tls:
        raise UsageError(
            "panel-open-without-tls",
            what=f"The panel would be reachable at {options.host} without TLS.",
            remedy="Give it a certificate and a key, or let it listen on 127.0.0.1 and use a tunnel.",
        )
