"""A light post without light or post, written from the manual and not from ``protocol``."""

from __future__ import annotations

import socketserver
import threading
from typing import Self


class EmulatedLightPost:
    """Serves on a free port of this machine; also a context. ``lux`` is what it sees; ``garbage``: it is broken."""

    def __init__(self, lux: float = 0.4) -> None:
        self.lux = lux
        self.garbage = False
        post = self

        class Handler(socketserver.StreamRequestHandler):
            def handle(self) -> None:
                question = self.rfile.readline(64).strip()
                answers = {b"LUX?": f"LUX={post.lux:.2f}", b"ID?": "ID=LP-1;0042"}
                answer = "LUX=-?-" if post.garbage else answers.get(question, "ERR")
                self.wfile.write(answer.encode() + b"\r\n")

        self._server = socketserver.ThreadingTCPServer(("127.0.0.1", 0), Handler)
        self.address = f"127.0.0.1:{self._server.server_address[1]}"

    def __enter__(self) -> Self:
        threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()
