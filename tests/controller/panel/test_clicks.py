"""How many clicks and fields things take, counted in a real Chromium, and that no page holds the keyboard."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path

import pytest
from PIL import Image
from playwright.sync_api import Browser, Page, expect

from controller.kiosk.schedule import WEEKDAYS
from controller.kiosk.store.accounts import Accounts
from tests.controller.panel.browser import CHROMIUM, chromium, enter, tab
from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.controller.panel.served import QUICK_HASH, Served, served
from tests.controller.panel.test_in_browser import PAGES

pytestmark = pytest.mark.skipif(not CHROMIUM.exists(), reason="needs Debian's chromium (a package of the test set-up)")
COUNT = """
addEventListener("click", (event) => {
  if (event.isTrusted && event.detail) sessionStorage.clicks = 1 + Number(sessionStorage.clicks || 0);
}, true);
addEventListener("change", (event) => { sessionStorage.fields = 1 + Number(sessionStorage.fields || 0); }, true);
"""
ONE_MORE_TAB = """() => {
  const at = document.activeElement;
  if (!at || at === document.body) return "";
  window.seen = window.seen || [];
  let number = window.seen.indexOf(at);
  if (number < 0) number = window.seen.push(at) - 1;
  return `${number}`;
}"""
REACHABLE = """() => [...document.querySelectorAll(
  "a[href], button, input, select, textarea, summary, iframe, [tabindex]")]
  .filter((one) => one.tabIndex >= 0 && !one.disabled && one.type !== "hidden" && one.checkVisibility())
  // Of radio buttons of one name, the chosen one is the place; arrow keys reach the others.
  .filter((one, _, all) => one.type !== "radio" || one.checked
    || (!all.some((other) => other.type === "radio" && other.name === one.name && other.checked)
      && one === all.find((other) => other.type === "radio" && other.name === one.name))).length"""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as started:
        yield started


def counted(page: Page) -> tuple[int, int]:
    """(clicks, fields) since the page was opened."""
    clicks, fields = page.evaluate("[Number(sessionStorage.clicks || 0), Number(sessionStorage.fields || 0)]")
    return clicks, fields


def test_a_picture_of_twelve_megapixels_is_on_the_object_and_plays_after_six_clicks(
    fresh: Served, browser: Browser
) -> None:
    out = io.BytesIO()
    Image.linear_gradient("L").convert("RGB").resize((4000, 3000)).save(out, "JPEG")
    with tab(browser, fresh.address) as page:
        page.add_init_script(COUNT)
        enter(page, "otto")
        page.evaluate("sessionStorage.clear()")
        page.get_by_role("link", name="Appearances").click()
        page.get_by_role("link", name="New appearance").click()
        # A person clicks once more, on the field of the file.
        page.set_input_files("#file", {"name": "t.jpg", "mimeType": "image/jpeg", "buffer": out.getvalue()})
        page.get_by_role("button", name="Upload").click()
        expect(page.get_by_alt_text("What the object will look like, calculated")).to_be_visible()
        page.get_by_label("Name", exact=True).fill("bronze")
        page.get_by_role("button", name="Compute").click()
        page.get_by_role("button", name="Play now").click()
        expect(page.locator("p.state b")).to_have_text("bronze")
        clicks, _ = counted(page)
        assert 1 < clicks + 1 <= 6


def test_a_week_with_two_special_days_takes_ten_fields_and_one_save(fresh: Served, browser: Browser) -> None:
    with tab(browser, fresh.address) as page:
        page.add_init_script(COUNT)
        enter(page, "otto")
        page.goto("/schedule")
        page.evaluate("sessionStorage.clear()")
        first, second, third = (page.locator("fieldset.hours").nth(n) for n in range(3))
        first.get_by_label("Days").fill("daily")
        first.get_by_label("Closes").fill("19:00")
        second.get_by_label("Days").fill("2026-12-24")
        third.get_by_label("Days").fill("31 December 2026")
        third.get_by_label("Opens").fill("10:00")
        third.get_by_label("Closes").fill("14:00")
        page.get_by_role("button", name="Save the schedule").click()
        expect(page.get_by_text("The schedule is in use.")).to_be_visible()
        clicks, fields = counted(page)
        assert (clicks, 1 < fields <= 10) == (1, True)
    rows = {row.day: (row.opens, row.closes) for row in fresh.kiosk.schedule().rows}
    assert rows == dict.fromkeys(WEEKDAYS, ("10:00", "19:00")) | {
        "2026-12-24": ("", ""), "2026-12-31": ("10:00", "14:00")
    }  # fmt: skip


def test_a_cold_stage_plays_three_clicks_and_three_fields_after_the_first_login_began(
    tmp_path: Path, browser: Browser
) -> None:
    kiosk = MemoryKiosk(tmp_path / "pictures")
    kiosk.change(state="ready", playing="", bundle=None, grades=())
    accounts = Accounts(tmp_path / "private" / "accounts.json", hasher=QUICK_HASH)
    password = accounts.first_start()
    assert password is not None
    with served(kiosk, tmp_path / "private", accounts=accounts) as running, tab(browser, running.address) as page:
        page.add_init_script(COUNT)
        page.goto("/login")
        page.get_by_label("Password").fill(password)
        page.get_by_role("button", name="Log in").click()
        page.wait_for_url("**/password")
        page.get_by_label("New password, 10 characters or more").fill("seven tall horses")
        page.get_by_label("New password again").fill("seven tall horses")
        page.get_by_role("button", name="Change").click()
        page.get_by_role("button", name="Recalibrate", exact=True).click()
        expect(page.locator("p.state strong")).to_have_text("Playing")
        assert counted(page) == (3, 3)
        page.get_by_role("button", name="Log out").click()
        assert page.get_by_label("Name").input_value() == "", "it has its own password now"


def test_an_appearance_is_switched_with_one_click_and_no_field(fresh: Served, browser: Browser) -> None:
    with tab(browser, fresh.address) as page:
        page.add_init_script(COUNT)
        enter(page, "otto")
        page.evaluate("sessionStorage.clear()")
        page.get_by_role("button", name="Show warm wood").click()
        expect(page.locator("p.state b")).to_have_text("warm wood")
        assert counted(page) == (1, 0)


def test_the_keyboard_reaches_everything_and_leaves_every_page(panel: Served, browser: Browser) -> None:
    with tab(browser, panel.address) as page:
        enter(page, "tina")
        for path in PAGES:
            page.goto(path)
            places = page.evaluate(REACHABLE)
            reached: list[str] = []
            # Parts of a time field and of the browser's own controls are places, too.
            for _ in range(4 * places + 20):
                page.keyboard.press("Tab")
                at = page.evaluate(ONE_MORE_TAB)
                if reached and at in ("", "0"):
                    break
                reached.append(at)
            else:
                raise AssertionError(f"{path}: the keyboard goes round in {reached[-8:]}")
            assert len(set(reached)) >= places, f"{path}: {places} places, {len(set(reached))} reached"
