"""A technician before a real kiosk: its service, player and devices as processes, its panel in a real browser."""

from __future__ import annotations

import re
import subprocess
import sys
import time
import zoneinfo
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime, timedelta
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from controller.panel.words.spoken import PLACES
from tests.campaigns.kills import ports
from tests.campaigns.mini_stage import APPEARANCE, prepare_mini
from tests.controller.panel.browser import CHROMIUM, chromium, tab
from tests.end_to_end.program import REPOSITORY, Command, processes_on

pytestmark = [
    pytest.mark.long,
    pytest.mark.timeout(900),
    pytest.mark.skipif(not CHROMIUM.exists(), reason="needs Debian's chromium (a package of the test set-up)"),
]
PASSWORD = "seven tall horses"
LONG_MS = 800_000
"""For machines that do much else meanwhile; a calibration of this stage takes half a minute."""


@contextmanager
def devices(stage: Path) -> Iterator[None]:
    """The emulated devices, in a process."""
    command = [sys.executable, "-m", "tests.campaigns.mini_stage", str(stage)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=REPOSITORY) as process:
        assert process.stdout is not None
        assert any('"ready"' in line for line in process.stdout)
        try:
            yield
        finally:
            process.terminate()


def first_password(kiosk: Command) -> str:
    """The one-time password that the console showed."""
    kiosk.wait_for_message("First login")
    told = [str(record["message"]["text"]) for record in kiosk.records if "message" in record]
    found = re.search(r"password (\S+) \(once\)", " ".join(told))
    assert found is not None, told
    return found[1]


def log_in(page: Page, password: str) -> None:
    page.goto("/login")
    page.get_by_label("Name").fill("technician")
    page.get_by_label("Password").fill(password)
    page.get_by_role("button", name="Log in").click()


def dim_the_picture_and_name_the_projectors(page: Page) -> None:
    page.goto("/")
    page.get_by_label("Brightness", exact=True).fill("40")
    page.get_by_role("button", name="Set", exact=True).click()
    expect(page.locator("p.state em")).to_have_text("Brightness 40 %", timeout=LONG_MS)
    # The calibration found where each one stands; the page does not show the names of outputs.
    places = page.locator("#live-around tbody td:nth-child(2)").all_inner_texts()
    assert len(places) == len(set(places)) == 2
    assert set(places) <= set(PLACES)
    assert "P1" not in page.locator("body").inner_text()
    page.locator(".commands summary").click()
    page.get_by_role("button", name="Identify projectors").click()
    expect(page.get_by_role("button", name="Stop identifying")).to_be_visible(timeout=LONG_MS)
    page.get_by_role("button", name="Stop identifying").click()
    expect(page.get_by_role("button", name="Stop identifying")).to_be_hidden(timeout=LONG_MS)


def type_hours_that_are_refused_or_close_the_show(page: Page) -> None:
    """They are typed for a zone in which it is about noon, whatever the time is here."""
    page.goto("/schedule")
    zone = next(zone for zone in map("Etc/GMT{:+d}".format, range(-12, 13)) if f"{hour_in(zone):02d}" in ("11", "12"))
    page.get_by_label("Time zone").fill(zone)
    rows = page.locator("fieldset.hours")

    def fill(number: int, days: str, opens: str, closes: str) -> None:
        for label, text in (("Days", days), ("Opens", opens), ("Closes", closes)):
            rows.nth(number).get_by_label(label).fill(text)

    fill(0, "Monday - sun", "02:00", "04:00")
    fill(1, "Tue", "03:00", "05:00")
    page.get_by_role("button", name="Save the schedule").click()
    expect(page.get_by_role("alert")).to_be_visible()
    assert rows.nth(1).get_by_label("Opens").input_value() == "03:00", "what was typed stays"
    fill(1, "", "", "")
    page.get_by_role("button", name="Save the schedule").click()
    expect(page.get_by_text("The stage closes at once")).to_be_visible()
    page.get_by_role("button", name="No").click()
    assert rows.nth(0).get_by_label("Days").input_value() == "Monday - sun"
    fill(0, "daily", "02:00", "23:00")
    page.get_by_role("button", name="Save the schedule").click()
    expect(page.get_by_text("The schedule is in use.")).to_be_visible()
    expect(page.locator("p.state")).to_contain_text("until 23:00", timeout=LONG_MS)
    at = datetime.now(zoneinfo.ZoneInfo(zone))
    page.goto("/events")
    shown = page.locator(".events time").first.inner_text()
    assert shown[-8:-6] in (f"{at:%H}", f"{at - timedelta(minutes=5):%H}"), f"{shown} is not in {zone}"


def hour_in(zone: str) -> int:
    return datetime.now(zoneinfo.ZoneInfo(zone)).hour


def look_at_aiming_and_doctor(page: Page) -> None:
    page.goto("/aiming")
    page.get_by_role("button", name="Take test shots").click()
    # The page comes back by itself when they are done.
    expect(page.get_by_text("From the test shots of")).to_be_visible(timeout=LONG_MS)
    measured = {
        name: float(page.get_by_label(name, exact=True).get_attribute("value") or 0)
        for name in ("Sharpest pattern", "Brightest parts of the picture", "Too bright for the camera")
    }
    assert 0 < measured["Sharpest pattern"] <= 1
    assert 0.2 < measured["Brightest parts of the picture"] <= 1
    assert 0 <= measured["Too bright for the camera"] < 0.2
    page.goto("/doctor", wait_until="domcontentloaded")
    expect(page.get_by_text("This takes some seconds.")).to_be_visible()
    expect(page.locator(".waiting")).to_have_count(0, timeout=LONG_MS)
    assert page.locator("#main").inner_text().count("No problems found.") == 1 or page.locator(".device").count()


def test_from_a_cold_stage_to_a_playing_one_by_one_click_over_a_cancel_a_second_person_and_a_death_of_the_service(
    tmp_path: Path,
) -> None:
    stage = prepare_mini(tmp_path)
    address = f"127.0.0.1:{ports()[0]}"
    served = ("kiosk", "serve", stage, "--panel", address)
    with devices(stage), chromium() as browser, tab(browser, f"http://{address}") as page:
        with Command(*served) as first:
            log_in(page, first_password(first))
            page.get_by_label("New password, 10 characters or more").fill(PASSWORD)
            page.get_by_label("New password again").fill(PASSWORD)
            page.get_by_role("button", name="Change").click()
            page.wait_for_url(re.compile(r"/(?!password)[^/]*$"))
            page.goto("/")
            page.get_by_role("button", name="Recalibrate", exact=True).click()
            expect(page.locator("p.state strong")).to_have_text("Calibrating", timeout=LONG_MS)
            expect(page.locator(".steps .done").first).to_be_attached(timeout=LONG_MS)
            with tab(browser, f"http://{address}") as colleague:
                log_in(colleague, PASSWORD)
                expect(colleague.locator(".steps .done").first).to_be_attached(timeout=LONG_MS)
                colleague.get_by_role("button", name="Cancel this job").click()
                expect(page.get_by_text("stopped on request").first).to_be_visible(timeout=LONG_MS)
            page.get_by_role("button", name="Recalibrate", exact=True).click()
            expect(page.locator("p.state strong")).to_have_text("Calibrating", timeout=LONG_MS)
            first.kill()
        with Command(*served) as second:
            # The page was open all the time, and its login holds.
            expect(page.get_by_role("button", name="Recalibrate", exact=True)).to_be_enabled(timeout=LONG_MS)
            second.wait_for_message("The panel is at")
            page.get_by_role("button", name="Recalibrate", exact=True).click()
            expect(page.locator("p.state strong")).to_have_text("Calibrating", timeout=LONG_MS)
            expect(page.locator("p.state strong")).to_have_text("Playing", timeout=LONG_MS)
            expect(page.get_by_text(APPEARANCE).first).to_be_visible(timeout=LONG_MS)
            page.set_default_timeout(LONG_MS)
            dim_the_picture_and_name_the_projectors(page)
            type_hours_that_are_refused_or_close_the_show(page)
            look_at_aiming_and_doctor(page)
            assert second.interrupt().code == 0
    until_s = time.monotonic() + 60
    while processes_on(stage) and time.monotonic() < until_s:
        time.sleep(0.1)
    assert processes_on(stage) == []
    assert len(list((stage / "runs").glob("*-calibrate"))) == 1
