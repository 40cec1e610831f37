"""Aiming without a picture, light in the room, the lamps' page and the report: what the pages say."""

from __future__ import annotations

import html
import io
import re
import time
from pathlib import Path

import pytest
from PIL import Image

from controller.kiosk.state import DriftCheck, EventRow
from controller.kiosk.store.accounts import Role
from controller.kiosk.values import Aiming, ProjectorAim
from controller.optics.calibrate.verify.error_causes import COLOURS, WORDS
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
    assert "<img" not in page.partition("<main")[2]
    assert "no live picture now" in page
    assert "Nothing has been measured yet" in page
    assert "<meter" not in page


def test_the_page_says_how_far_apart_outputs_change_where_that_was_measured(fresh: Served) -> None:
    assert "ms apart" not in text_of(fresh, "/")
    assert isinstance(fresh.kiosk, MemoryKiosk)
    fresh.kiosk.change(drifts=(DriftCheck("night", time.time(), "nothing", 0.04, 0.0083, 0.0006),))
    assert "Outputs change 8.3 ± 0.6 ms apart, seen by the camera" in text_of(fresh, "/")


def test_the_results_page_has_small_pictures_that_lead_to_the_whole_ones(fresh: Served) -> None:
    run = fresh.kiosk.runs()[0]
    file = fresh.kiosk.results(run).pictures["error"]
    assert isinstance(file, Path)
    Image.effect_noise((1600, 1200), 90).save(file)
    with fresh.entered("vera") as client:
        page, at = client.get("/results").text, f"/see/runs/{run}/pictures/error"
        assert f'src="{at}?small"' in page
        assert f'href="{at}"' in page
        small, whole = client.get(f"{at}?small"), client.get(at)
        assert client.get(f"/see/runs/{run}/pictures/none?small").status_code >= 400
    assert Image.open(io.BytesIO(small.content)).size == (480, 360)
    assert Image.open(io.BytesIO(whole.content)).size == (1600, 1200)
    assert len(small.content) < len(whole.content) / 4


def test_test_shots_are_begun_from_the_aiming_page(fresh: Served) -> None:
    with fresh.entered("tina") as client:
        page = client.get("/aiming").text
        answer = client.post(
            "/do/test-shots", data={"csrf": csrf(page)}, headers={"origin": fresh.address}, follow_redirects=True
        )
        assert "The test shots have started." in answer.text
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
    assert "Mon 05 Jan" in page
    assert "7.0 h" in page
    assert "13.7 hours per strike" in page


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


def compared(running: Served, **fields: str) -> str:
    """The results page after the button "Photograph and compare" of the appearances' page."""
    with running.entered("otto") as client:
        page = client.get("/appearances").text
        assert page.count('action="/do/compare"') == 3, "one for all, and one for each"
        sent = {"csrf": csrf(page)} | fields
        answer = client.post("/do/compare", data=sent, headers={"origin": running.address}, follow_redirects=True)
        assert "photographed, one after the other." in answer.text
        until_s = time.monotonic() + 60
        while not running.kiosk.snapshot().job.ended:  # type: ignore[union-attr]
            assert time.monotonic() < until_s
            time.sleep(0.02)
        return html.unescape(client.get("/results").text)


def test_appearances_are_photographed_and_the_results_show_the_newest_and_the_history(fresh: Served) -> None:
    assert "No appearance has been photographed yet." in text_of(fresh, "/results", "otto")
    page = compared(fresh)
    assert page.count("Colour difference, whole object") == 2
    assert page.count("From what was aimed at</dt><dd>0.41") == page.count("White could be 1.23 times as bright") == 2
    again = compared(fresh, name="warm wood")
    wood = again[again.index(">warm wood</h3>") :]
    assert "Colour difference, whole object</dt><dd>2.25</dd>" in wood
    assert wood.index(">2.25<") < wood.index(">1.25<"), "the newest first"
    with fresh.entered("vera") as vera:
        for kind in ("before", "target", "achieved", "error", "resolution"):
            picture = vera.get(f"/see/appearances/warm wood/pictures/{kind}?run-2")
            assert (picture.status_code, picture.headers["content-type"]) == (200, "image/png")
            assert f"/see/appearances/warm%20wood/pictures/{kind}?" in wood
        assert vera.get("/see/appearances/glass/pictures/error").status_code == 404
        assert 'action="/do/compare"' not in vera.get("/results").text


def test_the_legend_of_the_error_map_has_the_maps_names_and_colours(fresh: Served) -> None:
    page = text_of(fresh, "/results")
    with fresh.client() as anybody:
        style = anybody.get("/static/style.css").text
    shown = dict(re.findall(r'<span class="swatch (\w+)"></span>([^<]+)</li>', page))
    asked = {cause.name.lower(): WORDS[cause][0] for cause in COLOURS}
    assert shown == asked
    for cause, colour in COLOURS.items():
        assert f".swatch.{cause.name.lower()}{{background:#{bytes(colour).hex()}}}" in style


def test_the_api_photographs_and_tells_what_was_achieved(fresh: Served) -> None:
    operator, viewer = fresh.token(Role.OPERATOR), fresh.token(Role.VIEWER)
    with fresh.client() as machine:
        assert machine.get("/api/v1/comparisons", headers=viewer).json() == []
        assert machine.post("/api/v1/comparisons", json={}, headers=viewer).status_code == 403
        wrong = machine.post("/api/v1/comparisons", json={"name": "glass"}, headers=operator)
        assert (wrong.status_code, wrong.json()["code"]) == (404, "appearance-unknown")
        assert machine.post("/api/v1/comparisons", json={"name": "marble"}, headers=operator).json()["number"] == 1
        until_s = time.monotonic() + 60
        while not (found := machine.get("/api/v1/comparisons", headers=viewer).json()):
            assert time.monotonic() < until_s
            time.sleep(0.02)
        assert [one["name"] for one in found] == ["marble"]
        assert found[0]["history"][0]["delta_e_p95"] == 3.5
        assert "pictures" not in found[0], "no path leaves the machine"


def test_what_failed_stays_on_every_page_until_an_operator_has_seen_it(fresh: Served) -> None:
    kiosk = fresh.kiosk
    assert isinstance(kiosk, MemoryKiosk)
    kiosk.change(failures=(EventRow(7, 1e9, "error", "wood was <b>not</b> solved.", "appearance-failed"),))
    for path in ("/", "/schedule"):
        assert "wood was <b>not</b> solved." in text_of(fresh, path, "vera")
    assert 'action="/do/seen"' not in text_of(fresh, "/", "vera")
    with fresh.entered("otto") as client:
        form = {"csrf": csrf(client.get("/").text), "number": "7"}
        answer = client.post("/do/seen", data=form, headers={"origin": fresh.address}, follow_redirects=True)
        assert "not</b> solved" not in html.unescape(answer.text)
        assert "The failures are confirmed." in answer.text


def test_an_upload_is_fitted_to_the_cameras_view_as_was_chosen(fresh: Served) -> None:
    out = io.BytesIO()
    Image.new("RGB", (100, 100), (200, 30, 30)).save(out, "PNG")
    token = fresh.token(Role.OPERATOR)
    shares = {}
    with fresh.client() as machine:
        for fit in ("fit", "fill", "crop"):
            made = machine.post(f"/api/v1/targets?fit={fit}", content=out.getvalue(), headers=token).json()
            png = machine.get(f"/api/v1/targets/{made['target']}", headers=token).content
            with Image.open(io.BytesIO(png)) as picture:
                assert picture.size == (240, 160)
                shares[fit] = picture.convert("RGBA").getchannel("A").getbbox()
        wrong = machine.post("/api/v1/targets?fit=stretch", content=out.getvalue(), headers=token)
        assert wrong.json()["code"] == "field-wrong"
    assert shares == {"fit": (40, 0, 200, 160), "fill": (0, 0, 240, 160), "crop": (70, 30, 170, 130)}


def test_the_naming_has_a_button_each_that_keeps_its_label(fresh: Served) -> None:
    with fresh.entered("otto") as client:
        for on, shown, hidden in (("true", "identifying", "!identifying"), ("false", "!identifying", "identifying")):
            form = {"csrf": csrf(client.get("/").text), "on": on}
            page = client.post("/do/identify", data=form, headers={"origin": fresh.address}, follow_redirects=True).text
            assert f'data-if="{shown}">' in page
            assert f'data-if="{hidden}" hidden>' in page


class CalibratedKiosk(MemoryKiosk):
    """No one took test shots yet."""

    def aiming(self) -> Aiming:
        return Aiming((ProjectorAim("left", 0.8, 0.9),), 0.7, 0.0, 0.0, source="calibration", measured_unix_s=1e9)


def test_what_a_calibration_does_not_measure_is_not_shown(tmp_path: Path) -> None:
    with served(CalibratedKiosk(tmp_path / "pictures"), tmp_path / "private") as running:
        page = text_of(running, "/aiming")
    assert "Focus of left" in page
    assert "Sharpest pattern" not in page
    assert "Brightest parts" not in page
    assert "Take test shots to see how sharp" in page
