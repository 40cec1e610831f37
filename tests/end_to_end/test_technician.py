"""A technician before a real kiosk: its service, player and devices as processes, its panel in a real browser."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from tests.campaigns.kills import ports
from tests.campaigns.mini_stage import APPEARANCE, prepare_mini
from tests.controller.panel.browser import CHROMIUM, chromium, tab
from tests.end_to_end.program import REPOSITORY, Command, processes_on

pytestmark = [
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
    """The one-time password that the console told."""
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


def test_from_a_cold_stage_to_a_playing_one_by_one_click_over_a_cancel_a_second_person_and_a_death_of_the_service(
    tmp_path: Path,
) -> None:
    stage = prepare_mini(tmp_path)
    address = f"127.0.0.1:{ports()[0]}"
    served = ("serve", stage, "--panel", address)
    with devices(stage), chromium() as browser, tab(browser, f"http://{address}") as page:
        with Command(*served) as first:
            log_in(page, first_password(first))
            page.get_by_label("The one-time password").fill(first_password(first))
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
            assert second.interrupt().code == 0
    until_s = time.monotonic() + 60
    while processes_on(stage) and time.monotonic() < until_s:
        time.sleep(0.1)
    assert processes_on(stage) == []
    assert len(list((stage / "runs").glob("*-calibrate"))) == 1
