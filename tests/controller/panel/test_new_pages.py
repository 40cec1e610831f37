"""Aiming without a picture, light in the room, the lamps' page and the report: what the pages say."""

from __future__ import annotations

import html
from pathlib import Path

import pytest

from controller.panel.accounts import Role
from controller.panel.kiosk import Aiming
from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.controller.panel.served import Served, csrf, served


class BlindKiosk(MemoryKiosk):
    """A new stage: no live view, and nothing was measured yet."""

    def camera_picture(self) -> bytes | None:
        return None

    def aiming(self) -> Aiming:
        return Aiming()


def text_of(running: Served, path: str, name: str = "tina") -> str:
    with running.entered(name) as client:
        answer = client.get(path)
        assert answer.status_code == 200
        return html.unescape(answer.text)


def test_without_a_picture_the_aiming_page_has_words_and_no_broken_image(tmp_path: Path) -> None:
    with served(BlindKiosk(tmp_path / "pictures"), tmp_path / "private") as running:
        page = text_of(running, "/aiming")
    assert "<img" not in page
    assert "no live picture now" in page
    assert "Nothing has been measured yet" in page
    assert "<meter" not in page


def test_test_shots_are_begun_from_the_aiming_page(fresh: Served) -> None:
    with fresh.entered("tina") as client:
        page = client.get("/aiming").text
        answer = client.post(
            "/do/test-shots", data={"csrf": csrf(page)}, headers={"origin": fresh.address}, follow_redirects=True
        )
        assert "The test shots have begun." in answer.text
        assert answer.url.path == "/aiming"


def test_light_in_the_room_is_told_below_the_state_on_every_page(fresh: Served) -> None:
    kiosk = fresh.kiosk
    assert isinstance(kiosk, MemoryKiosk)
    kiosk.change(warnings=("There is <b>light</b> in the room.",))
    for path in ("/", "/schedule"):
        with fresh.entered("vera") as client:
            page = client.get(path).text
        assert "There is &lt;b&gt;light&lt;/b&gt; in the room." in page
    with fresh.client() as machine:
        assert machine.get("/api/v1/state", headers=fresh.token(Role.VIEWER)).json()["warnings"]


def test_the_lamps_page_tells_each_days_hours_and_what_happened(panel: Served) -> None:
    page = text_of(panel, "/lamps", "vera")
    assert "2026-01-05" in page
    assert "7.0 h" in page
    assert "13.7 hours a strike" in page


def test_a_report_is_saved_and_never_shown_as_a_page_of_ours(panel: Served) -> None:
    with panel.entered("vera") as client:
        answer = client.get("/see/runs/first/report")
        assert answer.headers["content-disposition"].startswith("attachment")
        assert "A report" in answer.text
        assert client.get("/see/runs/nothing/report").status_code == 404


def test_accounts_are_managed_by_the_api_and_sessions_end_with_them(fresh: Served) -> None:
    technician = fresh.token(Role.TECHNICIAN)
    with fresh.client() as machine, fresh.entered("vera") as vera:
        new = {"name": "nora", "role": "viewer", "password": "a long pass phrase"}
        assert machine.post("/api/v1/accounts", json=new, headers=technician).status_code == 200
        assert machine.post("/api/v1/accounts", json=new, headers=technician).status_code == 422
        names = [one["name"] for one in machine.get("/api/v1/accounts", headers=technician).json()]
        assert names == ["nora", "otto", "tina", "vera"]
        changed = machine.put("/api/v1/accounts/vera/role", json={"role": "operator"}, headers=technician)
        assert changed.status_code == 200
        assert vera.get("/").status_code == 303, "her session has ended"
        made = machine.post("/api/v1/tokens", json={"name": "watch", "role": "viewer"}, headers=technician).json()
        watch = {"authorization": f"Bearer {made['token']}"}
        assert machine.get("/api/v1/state", headers=watch).status_code == 200
        assert machine.get("/api/v1/accounts", headers=watch).status_code == 403
        machine.delete("/api/v1/tokens/watch", headers=technician)
        assert machine.get("/api/v1/state", headers=watch).status_code == 401
        last = machine.delete("/api/v1/accounts/tina", headers=technician)
        assert (last.status_code, last.json()["code"]) == (422, "last-technician")


@pytest.mark.parametrize("role", ["viewer", "operator"])
def test_only_technicians_manage_accounts(panel: Served, role: str) -> None:
    token = panel.token(Role.named(role))
    with panel.client() as machine:
        for path in ("/accounts", "/tokens"):
            assert machine.get(f"/api/v1{path}", headers=token).status_code == 403
