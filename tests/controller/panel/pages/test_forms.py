"""The forms of the pages over a served panel: what they change, and what they must not lose."""

from __future__ import annotations

import html
import io
import re
from pathlib import Path
from typing import Any

import httpx
import pytest
from PIL import Image

from controller.kiosk.values import Schedule, ScheduleRow
from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.controller.panel.served import Served, csrf

KEPT = Schedule("Europe/Vienna", (ScheduleRow("mon", "10:00", "18:00", "marble"),), "03:00")
FORM: dict[str, Any] = {
    "time_zone": "Europe/Vienna", "drift_check": "04:00", "day": ["tue", "", "2026-12-24"],
    "opens": ["10:00", "", ""], "closes": ["18:00", "", ""], "appearance": ["warm wood", "", ""],
}  # fmt: skip


def sent(client: httpx.Client, form: dict[str, Any], **files: Any) -> str:
    """Send the schedule; what the page then says."""
    token = csrf(client.get("/schedule").text)
    answer = client.post("/do/set-schedule", data=form | {"csrf": token}, **files)
    if answer.status_code == 422:
        return answer.text
    assert (answer.status_code, answer.headers["location"]) == (303, "/schedule")
    return client.get("/schedule").text


def test_rows_stay_together_and_empty_ones_are_left_out(fresh: Served) -> None:
    with fresh.entered("otto") as client:
        sent(client, FORM | {"day": [" tue ", "", "2026-12-24"]})
    rows = (ScheduleRow("tue", "10:00", "18:00", "warm wood"), ScheduleRow("2026-12-24", "", "", ""))
    assert fresh.kiosk.schedule() == Schedule("Europe/Vienna", rows, "04:00")


WRONG: tuple[tuple[dict[str, Any], str], ...] = (
    ({"appearance": []}, "The table of hours is incomplete."),
    ({"opens": ["10:00", ""]}, "The table of hours is incomplete."),
    ({"day": ["tue"]}, "The table of hours is incomplete."),
    ({"day": [], "opens": ["10:00"]}, "The table of hours is incomplete."),
    ({"day": ["someday", "", ""]}, "day"),
    ({"opens": ["25:00", "", ""]}, "opens"),
    ({"drift_check": "3:00"}, "drift_check"),
    ({"time_zone": ""}, "time_zone"),
    ({"appearance": ["<script>", "", ""]}, "appearance"),
    ({"day": ["mon"] * 401, "opens": [""] * 401, "closes": [""] * 401, "appearance": [""] * 401}, "rows"),
)


def test_hours_that_are_wrong_or_did_not_arrive_whole_change_nothing(fresh: Served) -> None:
    with fresh.entered("otto") as client:
        for change, word in WRONG:
            page = sent(client, FORM | change)
            (note,) = re.findall(r'class="note[^>]*>(.*?)</', page, re.DOTALL)
            assert word in note
            assert fresh.kiosk.schedule() == KEPT
            assert "2026-12-24" in page or len(change.get("day", FORM["day"])) != 3, "what was typed is still there"


def test_days_are_written_as_people_write_them_and_come_back_in_few_rows(fresh: Served) -> None:
    with fresh.entered("otto") as client:
        page = sent(client, FORM | {"day": ["Monday, Tue - Fri", "", "2026-12-24 to 2026-12-26"]})
    days = [row.day for row in fresh.kiosk.schedule().rows]
    assert days == ["mon", "tue", "wed", "thu", "fri", "2026-12-24", "2026-12-25", "2026-12-26"]
    assert 'value="Mon-Fri"' in page
    assert 'value="2026-12-24 \u2013 2026-12-26"' in page


def test_hours_that_overlap_are_refused_and_stay_in_the_form(fresh: Served) -> None:
    with fresh.entered("otto") as client:
        page = sent(client, FORM | {"day": ["mon-fri", "Tue", ""], "opens": ["10:00", "17:30", ""],
                                    "closes": ["18:00", "22:15", ""]})  # fmt: skip
    assert "Hours overlap (tue): 10:00-18:00 and 17:30-22:15." in page
    assert all(f'value="{typed}"' in page for typed in ("mon-fri", "Tue", "17:30", "22:15"))
    assert fresh.kiosk.schedule() == KEPT


def test_hours_that_close_the_running_show_ask_first_and_no_leads_back_to_what_was_typed(fresh: Served) -> None:
    kiosk = fresh.kiosk
    assert isinstance(kiosk, MemoryKiosk)
    kiosk.effect = "The stage closes at once."
    with fresh.entered("otto") as client:
        form = FORM | {"csrf": csrf(client.get("/schedule").text)}
        asked = client.post("/do/set-schedule", data=form).text
        assert "Save these hours now? The stage closes at once." in asked
        assert kiosk.schedule() == KEPT
        kept = re.findall(r'<textarea name="(\w+)"[^>]*>\n(.*?)</textarea>', asked)
        again = {"csrf": form["csrf"], **{name: [v for n, v in kept if n == name] for name, _ in kept}}
        back = client.post("/do/set-schedule", data=again | {"sure": "no"})
        assert (back.status_code, kiosk.schedule()) == (200, KEPT)
        assert all(f'value="{typed}"' in back.text for typed in ("tue", "2026-12-24", "04:00"))
        assert "<option selected>warm wood</option>" in back.text
        assert client.post("/do/set-schedule", data=again | {"sure": "yes"}).status_code == 303
    assert [row.day for row in kiosk.schedule().rows] == ["tue", "2026-12-24"]


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"appearance": ["", "", "no such"]}, "row 2"),
        ({"opens": ["10:00", "", "9"], "closes": ["18:00", "", "12:00"]}, "row 2"),
        ({"opens": ["10:00", "", "09:00"], "closes": ["18:00", "", ""]}, "row 2"),
        ({"day": ["mon-fri", "", "wed"], "opens": ["10:00", "", "9:00"], "closes": ["18:00", "", "12:00"]}, "row 2"),
        ({"day": ["mon-fri", "", "wed"], "opens": ["10:00", "", "09:00"], "closes": ["18:00", "", "12:00"]}, "row 1"),
    ],
)  # fmt: skip
def test_an_error_names_the_row_of_the_form(fresh: Served, changes: dict[str, Any], told: str) -> None:
    with fresh.entered("otto") as client:
        assert told in sent(client, FORM | {"day": ["mon-fri", "", "sat"], "appearance": ["", "", ""]} | changes)


def test_special_days_after_two_weeks_are_in_sight(fresh: Served) -> None:
    with fresh.entered("otto") as client:
        page = sent(client, FORM | {"day": ["tue", "", "2099-12-24 to 2099-12-26"]})
    assert "Special days after that" in page
    assert "2099-12-24 – 2099-12-26: closed" in " ".join(page.split())


def test_a_picture_is_fitted_anew_without_another_upload_and_its_file_proposes_a_name(fresh: Served) -> None:
    Image.new("RGB", (60, 40), (200, 90, 30)).save(picture := io.BytesIO(), "PNG")
    with fresh.entered("otto") as client:
        form = {"csrf": csrf(client.get("/appearances/new").text), "fit": "fit"}
        files = {"file": ("Grüne Wiese (2).png", picture.getvalue())}
        there = client.post("/do/upload-target", data=form, files=files).headers["location"]
        assert 'name="name" value="Grüne-Wiese-2"' in client.get(there).text
        sent_on = form | {"fit": "crop", "target": there.rpartition("/")[2]}
        again = client.post("/do/fit-target", data=sent_on).headers["location"]
        assert again != there
        assert 'name="name" value="Grüne-Wiese-2"' in client.get(again).text
        seen = [client.get(f"/see/targets/{at.rpartition('/')[2]}").content for at in (there, again)]
        assert seen[0] != seen[1]


def test_a_wrong_name_stays_beside_its_target_and_the_rule_is_told_before(fresh: Served, tmp_path: Path) -> None:
    Image.new("RGB", (60, 40), (200, 90, 30)).save(tmp_path / "t.png")
    with fresh.entered("otto") as client:
        form = {"csrf": csrf(client.get("/appearances/new").text), "fit": "fill"}
        refused = client.post("/do/upload-target", data=form, files={"file": ("a.png", b"no picture")})
        assert refused.status_code == 422
        assert 'name="fit" value="fill" checked>' in refused.text
        picture = (tmp_path / "t.png").read_bytes()
        there = client.post("/do/upload-target", data=form, files={"file": ("t.png", picture)})
        page = client.get(there.headers["location"]).text
        assert "Letters, digits, - and _." in page
        target = there.headers["location"].rpartition("/")[2]
        answer = client.post("/do/compute", data={"csrf": form["csrf"], "name": "two words", "target": target})
        assert answer.status_code == 422
        assert 'value="two words"' in answer.text
        assert f'value="{target}"' in answer.text


def test_an_account_that_is_refused_keeps_its_name_and_role_but_no_password(fresh: Served) -> None:
    with fresh.entered("tina") as client:
        form = {"csrf": csrf(client.get("/accounts").text), "role": "operator", "password": "a long pass phrase"}
        answer = client.post("/accounts/add", data=form | {"name": "Nora Two"})
        assert answer.status_code == 422
        assert 'value="Nora Two"' in answer.text
        assert "a long pass phrase" not in answer.text
        token = client.post("/tokens/add", data=form | {"name": "No Name!"})
        assert 'value="No Name!"' in token.text


def test_a_file_that_nobody_asked_for_is_removed_and_leaves_the_form_as_it_is(fresh: Served) -> None:
    incoming: Path = fresh.app.state.panel.options.folder / "incoming"
    with fresh.entered("otto") as client:
        sent(client, FORM, files={"day": ("evil.toml", b"mon", "text/plain")})
    assert len(fresh.kiosk.schedule().rows) == 2
    assert list(incoming.iterdir()) == []


def test_a_disk_that_takes_no_upload_is_told_in_words(fresh: Served) -> None:
    incoming: Path = fresh.app.state.panel.options.folder / "incoming"
    incoming.write_bytes(b"no folder")
    with fresh.entered("otto") as client:
        form = {"csrf": csrf(client.get("/appearances/new").text)}
        answer = client.post("/do/upload-target", data=form, files={"file": ("a.png", b"x")})
        assert answer.status_code == 507
        assert "Free some space" in answer.text
        page = client.post("/do/upload-target", data=form, files={"file": ("a.png", b"x")},
                           headers={"accept": "text/html"})  # fmt: skip
        assert (page.status_code, "<h1>" in page.text, "Free some space" in page.text) == (507, True, True)
        assert "set-schedule" in sent(client, FORM), "the panel goes on"
    assert len(fresh.kiosk.schedule().rows) == 2


def test_a_form_that_is_none_is_refused_and_ends_no_session(fresh: Served) -> None:
    with fresh.entered("otto") as client:
        token = csrf(client.get("/schedule").text)
        plain = {"content-type": "text/plain"}
        assert client.post("/do/set-schedule", content=b"csrf=" + token.encode(), headers=plain).status_code == 403
        many = {"csrf": token} | {f"x{number}": "" for number in range(2500)}
        assert client.post("/do/set-schedule", data=many).status_code == 400
        assert client.post("/do/set-schedule", files={"csrf": ("csrf", token.encode())}).status_code == 403
        assert client.get("/schedule").status_code == 200
    assert fresh.kiosk.schedule() == KEPT


def test_a_form_that_failed_leads_to_no_address_of_its_senders(fresh: Served) -> None:
    with fresh.entered("otto") as client:
        form = {"csrf": csrf(client.get("/appearances/new").text), "name": "wood"}
        for target in ("../../login", "//elsewhere.example", "\u00e9\u00e9", "abc?x=1", "a/../b", ""):
            answer = client.post("/do/compute", data=form | {"target": target})
            assert (answer.status_code, answer.headers["location"]) == (303, "/")
        answer = client.post("/do/compute", data=form | {"target": "ab" * 12})
        assert (answer.status_code, "This target no longer exists." in answer.text) == (404, True)


def test_settings_that_are_wrong_come_back_as_they_were_typed(fresh: Served) -> None:
    with fresh.entered("tina") as client:
        form = {"csrf": csrf(client.get("/settings").text), "text": "[stage\r\nname = <b>", "other": "field"}
        answer = client.post("/do/save-settings", data=form)
        assert answer.status_code == 422
        assert "[stage\r\nname = &lt;b&gt;" in answer.text.replace("\n", "\r\n").replace("\r\r", "\r")
        assert "<b>" not in answer.text.partition("<textarea")[2].partition("</textarea")[0]


FIELDS = """# ours
[stage]
name = "vase"  # by Anna

[[projectors]]
name = "left"
output = "P1"
driver = "serial"
port = "/dev/ttyUSB0"
profile = "optoma-later"

[camera]
driver = "ptp"
iso = 100
focal_length_px = 4100.0

[display]
driver = "player"

[[display.outputs]]
name = "P1"
width_px = 1400
height_px = 1050

[[appearances]]
name = "wood"
kind = "pattern"
shown_s = 20

[disk]
keep_runs = 7
"""


@pytest.mark.parametrize(
    ("field", "typed", "old", "new"),
    [
        ("stage.name", "jar", '"vase"', '"jar"'),
        ("appearances.0.shown_s", "7.5", "shown_s = 20", "shown_s = 7.5"),
        ("appearances.0.fade_s", "2", "shown_s = 20\n", "shown_s = 20\nfade_s = 2.0\n"),
        ("appearances.0.shown_s", "", "shown_s = 20\n", ""),
        ("disk.keep_runs", "9", "keep_runs = 7", "keep_runs = 9"),
        ("calibration.photograph_at_night", "true", "", "\n[calibration]\nphotograph_at_night = true\n"),
        ("backup.at", "02:30", "", '\n[backup]\nat = "02:30"\n'),
        (
            "object.outline",
            "[[[0, 0.25], [1, 0.25], [0.5, 0.75]]]",
            "",
            "\n[object]\noutline = [[[0, 0.25], [1, 0.25], [0.5, 0.75]]]\n",
        ),
    ],
)
def test_a_field_of_the_settings_changes_its_key_alone(
    fresh: Served, field: str, typed: str, old: str, new: str
) -> None:
    fresh.kiosk.save_settings(FIELDS)
    with fresh.entered("tina") as client:
        page = client.get("/settings").text
        form = dict(re.findall(r'<input name="([a-z_.0-9]+)" value="([^"]*)"', page))
        assert field in form or f'<select name="{field}"' in page
        answer = client.post("/settings/fields", data=form | {"csrf": csrf(page), field: typed, "sure": "yes"})
        if answer.status_code == 200:  # it asks first
            text = answer.text.partition('<textarea name="text" hidden aria-hidden="true">\n')[2].partition(
                "</textarea"
            )[0]
            sent = {"csrf": csrf(answer.text), "text": html.unescape(text), "sure": "yes"}
            answer = client.post("/do/save-settings", data=sent)
        assert answer.status_code == 303, answer.text
    assert fresh.kiosk.settings() == (FIELDS.replace(old, new, 1) if old else FIELDS + new)


def test_a_list_is_typed_with_commas(fresh: Served) -> None:
    fresh.kiosk.save_settings(FIELDS)
    mail = {"alerts.mail_to": "a@b.c, d@e.f,", "alerts.mail_from": "v@e.f", "alerts.mail_host": "mail.e.f"}
    with fresh.entered("tina") as client:
        form = mail | {"csrf": csrf(client.get("/settings").text)}
        assert client.post("/settings/fields", data=form).status_code == 303
        assert 'value="a@b.c, d@e.f"' in client.get("/settings").text
    assert 'mail_to = ["a@b.c", "d@e.f"]\n' in fresh.kiosk.settings()


def test_what_a_field_may_not_hold_is_named_and_what_was_typed_stays(fresh: Served) -> None:
    fresh.kiosk.save_settings(FIELDS)
    with fresh.entered("tina") as client:
        form = {"csrf": csrf(client.get("/settings").text), "disk.keep_runs": "<many>", "stage.name": "jar"}
        answer = client.post("/settings/fields", data=form)
        assert answer.status_code == 422
        assert "keep_runs" in answer.text.partition('role="alert"')[2].partition("</p>")[0]
        assert "&lt;many&gt;" in answer.text
        assert 'value="jar"' in answer.text
    assert fresh.kiosk.settings() == FIELDS
