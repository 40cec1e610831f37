"""No one enters: every route of the table, with every role."""

from __future__ import annotations

from pathlib import Path

import httpx
import pytest

from controller.kiosk.store.accounts import Role
from controller.panel.auth.identity import Entry
from controller.panel.context import PanelOptions
from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.controller.panel.served import Served, csrf, served

PUBLIC = {"/login", "/language", "/static/looks.js", "/static/style.css", "/static/panel.js", "/static/icon.svg",
          "/static/velatura-sans-400.woff", "/static/velatura-sans-700.woff"}  # fmt: skip
NAMES = {Role.VIEWER: "vera", Role.OPERATOR: "otto", Role.TECHNICIAN: "tina"}


def entries(panel: Served) -> list[Entry]:
    table: list[Entry] = panel.app.state.entries
    return table


def address(entry: Entry) -> str:
    path = entry.path
    for name in ("name", "run", "target", "picture"):
        path = path.replace("{" + name + "}", "nothing")
    return path


def send(client: httpx.Client, entry: Entry, headers: dict[str, str] | None = None) -> int:
    """The status, without waiting for the end of what never ends."""
    with client.stream(entry.method, address(entry), headers=headers) as answer:
        return answer.status_code


def test_only_the_log_in_and_its_looks_are_public(panel: Served) -> None:
    assert {entry.path for entry in entries(panel) if entry.way == "public"} == PUBLIC
    assert all(entry.role is not None for entry in entries(panel) if entry.way != "public")


def test_every_address_that_the_application_answers_stands_in_the_table(panel: Served) -> None:
    listed = {entry.path for entry in entries(panel)}
    assert {getattr(route, "path", "") for route in panel.app.routes} == listed


def test_nobody_without_a_session_or_token_gets_past_any_route(panel: Served) -> None:
    with panel.client() as client:
        for entry in entries(panel):
            if entry.way != "public":
                panel.app.state.panel.by_token.succeeded("127.0.0.1")
                assert send(client, entry) in (303, 401), entry
                assert send(client, entry, {"authorization": "Bearer velatura_wrong"}) in (303, 401), entry


def test_a_session_is_no_token_and_a_token_is_no_session(panel: Served) -> None:
    panel.app.state.panel.by_token.succeeded("127.0.0.1")
    token = panel.token(Role.TECHNICIAN)
    with panel.entered("tina") as tina, panel.client() as machine:
        for entry in entries(panel):
            if entry.way == "token":
                assert send(tina, entry) == 401, entry
            elif entry.way == "session":
                assert send(machine, entry, token) in (303, 401), entry


@pytest.mark.parametrize("role", list(Role))
def test_each_role_is_stopped_exactly_at_the_routes_above_it(panel: Served, role: Role) -> None:
    panel.app.state.panel.by_token.succeeded("127.0.0.1")
    token = panel.token(role)
    for entry in entries(panel):
        if entry.way == "public" or entry.role is None or entry.path == "/logout":
            continue
        with panel.client() as client:
            client.cookies = clients_cookies(panel, role)
            status = send(client, entry, token if entry.way == "token" else None)
            forbidden = status in (401, 403)
            # A form that may be sent is still refused without its token against forged requests.
            needs_csrf = entry.way == "session" and entry.method == "POST"
            assert forbidden == (role < entry.role or needs_csrf), (entry, status)


COOKIES: dict[tuple[str, Role], httpx.Cookies] = {}


def clients_cookies(panel: Served, role: Role) -> httpx.Cookies:
    key = (panel.address, role)
    if key not in COOKIES:
        with panel.entered(NAMES[role]) as client:
            COOKIES[key] = httpx.Cookies(client.cookies)
    return COOKIES[key]


def test_an_address_that_is_not_in_the_table_shows_nothing(panel: Served) -> None:
    token = panel.token(Role.TECHNICIAN)
    with panel.entered("tina") as client:
        for path in (
            "/admin",
            "/api/v1/secrets",
            "/static/../accounts.json",
            "/static/%2e%2e/app.py",
            "/see/targets",
            "/live/x",
        ):
            assert client.get(path, headers=token).status_code == 404, path
        assert client.delete("/api/v1/state", headers=token).status_code == 405


def test_a_person_who_took_a_wrong_address_sees_a_page_and_a_program_one_line(panel: Served) -> None:
    with panel.entered("tina") as client:
        for method, path, status in (("GET", "/nothing/here", 404), ("PUT", "/login", 405), ("POST", "/do/play", 403)):
            page = client.request(method, path, headers={"accept": "text/html"})
            assert (page.status_code, page.headers["content-type"]) == (status, "text/html; charset=utf-8")
            assert 'href="/"' in page.text
            assert "/static/style.css" in page.text
            line = client.request(method, path, headers={"accept": "application/json"})
            assert (line.status_code, "<" in line.text) == (status, False)


def test_a_form_of_another_session_or_of_another_site_is_refused(panel: Served) -> None:
    with panel.entered("tina") as tina, panel.entered("otto") as otto:
        own, other = csrf(tina.get("/").text), csrf(otto.get("/").text)
        for entry in entries(panel):
            if entry.way == "session" and entry.method == "POST":
                for sent in ({}, {"csrf": ""}, {"csrf": other}, {"csrf": own[:-1]}, {"csrf": own + "x"}):
                    assert tina.post(entry.path, data=sent).status_code == 403, entry
                for headers in (
                    {"origin": "http://evil.example"},
                    {"sec-fetch-site": "cross-site"},
                    {"origin": "null"},
                ):
                    assert tina.post(entry.path, data={"csrf": own}, headers=headers).status_code == 403, entry
        assert tina.post("/do/identify", data={"csrf": own, "on": "true"}).status_code == 303


def test_another_name_that_leads_to_this_machine_is_not_answered(panel: Served) -> None:
    with panel.client() as client:
        for host in ("evil.example", "evil.example:8377", "", "127.0.0.1.evil.example", "[::2]:80"):
            assert client.get("/login", headers={"host": host}).status_code == 421, host


def test_a_panel_for_the_network_answers_to_every_address_and_to_no_other_name(tmp_path: Path) -> None:
    options = PanelOptions(folder=tmp_path / "private", host="0.0.0.0")
    with served(MemoryKiosk(tmp_path), tmp_path / "private", options=options) as panel, panel.client() as client:
        for host, answer in (
            ("192.0.2.7:8377", 200),
            ("[2001:db8::7]:8377", 200),
            ("evil.example:8377", 421),
            ("192.0.2.7.evil.example", 421),
        ):
            assert client.get("/login", headers={"host": host}).status_code == answer, host


def test_every_answer_carries_the_headers_that_keep_scripts_out(panel: Served) -> None:
    with panel.entered("tina") as client:
        for path in ("/", "/login", "/static/panel.js", "/nothing", "/see/camera", "/api/v1/state"):
            headers = client.get(path).headers
            policy = headers["content-security-policy"]
            assert "default-src 'none'" in policy
            assert "unsafe" not in policy
            assert "http" not in policy
            assert headers["x-content-type-options"] == "nosniff"
            assert headers["x-frame-options"] == "DENY"
            assert "server" not in headers


def test_the_first_page_is_small_and_names_no_other_machine(panel: Served) -> None:
    with panel.entered("tina") as client:
        texts = [client.get(path).text for path in ("/", "/static/style.css", "/static/panel.js", "/static/icon.svg")]
        assert sum(len(text.encode()) for text in texts) <= 100_000
        fonts = [client.get(f"/static/velatura-sans-{weight}.woff") for weight in (400, 700)]
        assert {font.headers["content-type"] for font in fonts} == {"font/woff"}
        assert sum(len(font.content) for font in fonts) <= 60_000
        for word in ("http", "<script>", "style="):
            assert word not in texts[0]
        assert "//" not in texts[1]
