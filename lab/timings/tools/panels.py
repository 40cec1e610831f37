"""Open panels as browsers hold them open: a log-in, the first page, and streams that are read as they come."""

from __future__ import annotations

import contextlib
import http.client
import re
import selectors
import socket
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlencode

from controller.kiosk.store.accounts import Role, stage_accounts

NAME, PASSWORD = "bench", "fifty open windows"
PARTS = ("/static/style.css", "/static/panel.js", "/static/icon.svg")


def make_account(stage: Path) -> None:
    """Somebody who may look; before the service begins."""
    stage_accounts(stage).add(NAME, Role.TECHNICIAN, PASSWORD)


@dataclass(frozen=True, slots=True)
class Browser:
    """Somebody who has logged in at a panel on this machine."""

    port: int
    cookie: str

    def get(self, path: str) -> bytes:
        return _asked(self.port, "GET", path, self.cookie)[1]

    def first_page(self) -> tuple[float, int]:
        """Seconds until the page and what it loads are there, and their bytes."""
        began_s = time.perf_counter()
        size = sum(len(self.get(path)) for path in ("/", *PARTS))
        return time.perf_counter() - began_s, size


def log_in(port: int) -> Browser:
    until_s = time.monotonic() + 60.0
    while True:
        with contextlib.suppress(ConnectionRefusedError), socket.create_connection(("127.0.0.1", port), 5):
            break
        assert time.monotonic() < until_s, "the panel does not listen"
        time.sleep(0.05)
    headers, page = _asked(port, "GET", "/login", "")
    found = re.search(rb'name="csrf" value="([^"]+)"', page)
    assert found is not None
    form = urlencode({"csrf": found[1].decode(), "name": NAME, "password": PASSWORD})
    headers, _ = _asked(port, "POST", "/login", _cookies(headers), form)
    return Browser(port, _cookies(headers))


def _cookies(headers: list[tuple[str, str]]) -> str:
    found = [value.partition(";")[0] for name, value in headers if name.lower() == "set-cookie"]
    return "; ".join(one for one in found if not one.endswith('=""'))


def _asked(
    port: int, method: str, path: str, cookie: str, form: str | None = None
) -> tuple[list[tuple[str, str]], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    headers = {"Cookie": cookie, "Origin": f"http://127.0.0.1:{port}"}
    if form is not None:
        headers["Content-Type"] = "application/x-www-form-urlencoded"
    connection.request(method, path, form, headers)
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    return answer.getheaders(), content


class OpenPanels:
    """``count`` streams of live parts, read in a thread; a context manager. ``received``: bytes so far."""

    def __init__(self, browser: Browser, count: int) -> None:
        self._browser, self._count = browser, count
        self._selector = selectors.DefaultSelector()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self.received = 0

    def __enter__(self) -> OpenPanels:
        request = f"GET /live HTTP/1.1\r\nHost: 127.0.0.1\r\nCookie: {self._browser.cookie}\r\n\r\n".encode()
        for _ in range(self._count):
            channel = socket.create_connection(("127.0.0.1", self._browser.port), 30)
            channel.sendall(request)
            self._selector.register(channel, selectors.EVENT_READ)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        for key in list(self._selector.get_map().values()):
            assert isinstance(key.fileobj, socket.socket)
            key.fileobj.close()
        self._selector.close()

    def _read(self) -> None:
        while not self._ended.is_set():
            for key, _ in self._selector.select(0.2):
                assert isinstance(key.fileobj, socket.socket)
                self.received += len(key.fileobj.recv(1 << 16))
