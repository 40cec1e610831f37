"""What a technician does, in a real Chromium."""

from __future__ import annotations

import contextlib
import io
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import cast

import pytest
from axe_playwright_python.sync_playwright import Axe
from PIL import Image
from playwright.sync_api import Browser, Page, expect

from controller.kiosk.operations.house import House, HouseNow, Rollout, Stagehouse, StageUpdate
from controller.kiosk.state import BundleIdentity, Grade
from controller.kiosk.store.accounts import Accounts
from controller.panel import live
from controller.panel.pages.routes import NAVIGATION
from hal.notices import Notice
from tests.controller.panel.browser import SHELL, chromium, enter, picture, tab
from tests.controller.panel.memory_kiosk import TOML, MemoryKiosk
from tests.controller.panel.served import PASSWORD, QUICK_HASH, Served, served
from tests.ports import kept_port

pytestmark = pytest.mark.skipif(
    not SHELL.exists(), reason="needs Debian's chromium-headless-shell (a package of the test set-up)"
)

PAGES = (
    "/",
    "/appearances",
    "/appearances/new",
    "/appearances/scenes/gold",
    "/house",
    "/mesh",
    "/mesh/bust.glb",
    "/schedule",
    "/results",
    "/lamps",
    "/events",
    "/doctor",
    "/aiming",
    "/settings",
    "/care",
    "/accounts",
    "/setup",
    "/password",
    "/results/nothing",
)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium(program=SHELL) as started:
        yield started


@pytest.fixture
def slow(tmp_path: Path) -> Iterator[Served]:
    """Its jobs take long enough to be watched."""
    with served(MemoryKiosk(tmp_path / "pictures", step_s=0.6), tmp_path / "private") as running:
        yield running


def violations(page: Page) -> str:
    found = Axe().run(page)
    return str(found.generate_report()) if found.violations_count else ""


def test_recalibration_is_one_click_and_is_followed_live_to_its_end(slow: Served, browser: Browser) -> None:
    with tab(browser, slow.address) as page:
        enter(page, "otto")
        page.get_by_role("button", name="Recalibrate", exact=True).click()
        expect(page.get_by_text("Calibrating", exact=True)).to_be_visible()
        expect(page.locator("details .steps .now")).to_be_attached()
        expect(page.locator(".steps .now")).to_be_hidden()
        page.locator("#live-job summary").click()
        expect(page.locator(".steps .now")).to_be_visible()
        expect(page.get_by_alt_text("What the camera sees now")).to_be_visible()
        expect(page.locator("#live-job")).to_contain_text(" left")
        expect(page.locator(".steps li").nth(1)).to_have_class("done")
        expect(page.locator(".steps li").nth(1), "it stays unfolded while it is drawn anew").to_be_visible()
        for name in ("Recalibrate", "Quick recalibration", "Open"):
            expect(page.get_by_role("button", name=name, exact=True)).to_be_hidden()
        picture(page, "recalibrating")
        expect(page.get_by_text("It ended well.")).to_be_visible()
        expect(page.get_by_role("button", name="Cancel this job")).to_be_hidden()


def test_cancel_ends_the_job_and_says_so(slow: Served, browser: Browser) -> None:
    with tab(browser, slow.address) as page:
        enter(page, "otto")
        page.get_by_role("button", name="Quick recalibration").click()
        page.get_by_role("button", name="Cancel this job").click()
        expect(page.get_by_text("It was cancelled.")).to_be_visible()


def test_a_new_appearance_comes_to_open_pages_and_is_announced_until_it_plays(fresh: Served, browser: Browser) -> None:
    kiosk = fresh.kiosk
    assert isinstance(kiosk, MemoryKiosk)
    with tab(browser, fresh.address) as page, tab(browser, fresh.address) as other:
        enter(page, "otto")
        enter(other, "otto")
        other.goto("/appearances")
        kiosk.compute_scene("herbst", "gold")
        for one in (page, other):
            expect(one.locator("#shelf").get_by_text("herbst")).to_be_visible()
        expect(page.get_by_text("herbst is ready.")).to_be_visible()
        picture(page, "ready")
        page.locator("#made").get_by_role("button", name="Play now").click()
        expect(page.get_by_text("herbst is ready.")).to_be_hidden()
        expect(page.get_by_role("button", name="Show herbst")).to_have_attribute("aria-pressed", "true")


def test_a_server_that_hangs_is_told_within_seconds(
    fresh: Served, browser: Browser, monkeypatch: pytest.MonkeyPatch
) -> None:
    with tab(browser, fresh.address) as page:
        enter(page, "otto")
        expect(page.get_by_text("No connection, trying again")).to_be_hidden()
        monkeypatch.setattr(live, "KEEP_ALIVE_S", 60.0)
        expect(page.get_by_text("No connection, trying again")).to_be_visible(timeout=12_000)


def test_what_was_typed_is_there_again_after_a_session_that_ended(fresh: Served, browser: Browser) -> None:
    with tab(browser, fresh.address) as page:
        enter(page, "tina")
        page.goto("/settings")
        page.locator("#text").fill("[stage]\nname = 'half written'\n")
        fresh.app.state.panel.sessions.end_all("tina")
        page.wait_for_url("**/login")
        page.get_by_label("Name").fill("tina")
        page.get_by_label("Password").fill(PASSWORD)
        page.get_by_role("button", name="Log in").click()
        page.wait_for_url("**/settings")
        expect(page.locator("#text")).to_have_value("[stage]\nname = 'half written'\n")
        expect(page.get_by_text("What you typed is here again.")).to_be_visible()
        fresh.app.state.panel.sessions.end_all("tina")
        page.get_by_role("button", name="Check", exact=True).click()
        page.goto("/login")
        page.get_by_label("Name").fill("tina")
        page.get_by_label("Password").fill(PASSWORD)
        page.get_by_role("button", name="Log in").click()
        page.wait_for_url("**/settings")
        expect(page.locator("#text")).to_have_value("[stage]\nname = 'half written'\n")
        page.get_by_role("button", name="Check", exact=True).click()
        page.goto("/settings")
        expect(page.get_by_text("What you typed is here again.")).to_be_hidden()


def test_a_reload_in_the_middle_of_a_job_loses_nothing(slow: Served, browser: Browser) -> None:
    with tab(browser, slow.address) as page:
        enter(page, "otto")
        page.get_by_role("button", name="Recalibrate", exact=True).click()
        expect(page.locator(".steps li").first).to_have_class("done")
        page.reload()
        assert page.locator(".steps .done").count() >= 1
        expect(page.get_by_text("It ended well.")).to_be_visible()


def test_two_technicians_see_the_same_job_and_only_one_can_begin_it(slow: Served, browser: Browser) -> None:
    with tab(browser, slow.address) as first, tab(browser, slow.address) as second:
        enter(first, "otto")
        enter(second, "tina")
        first.get_by_role("button", name="Recalibrate", exact=True).click()
        expect(second.locator(".whole")).to_be_visible()
        expect(second.get_by_role("button", name="Quick recalibration")).to_be_hidden()
        second.get_by_role("button", name="Cancel this job").click()
        expect(first.get_by_text("It was cancelled.")).to_be_visible()


def test_an_open_page_finds_the_service_again_after_a_restart(tmp_path: Path, browser: Browser) -> None:
    kiosk = MemoryKiosk(tmp_path / "pictures")
    with kept_port() as port, contextlib.ExitStack() as closing:
        with served(kiosk, tmp_path / "private", port=port) as running:
            page = closing.enter_context(tab(browser, running.address))
            enter(page, "otto")
        expect(page.get_by_text("No connection, trying again")).to_be_visible()
        with served(kiosk, tmp_path / "private", port=port):
            expect(page.get_by_text("No connection, trying again")).to_be_hidden()
            kiosk.change(reason="The service was started again.")
            expect(page.get_by_text("The service was started again.")).to_be_visible()
            page.get_by_role("button", name="Quick recalibration").click()
            expect(page.get_by_text("It ended well.")).to_be_visible()


def test_a_target_is_uploaded_looked_at_and_computed(fresh: Served, browser: Browser) -> None:
    out = io.BytesIO()
    Image.radial_gradient("L").convert("RGB").save(out, "JPEG", comment=b"who took this picture")
    with tab(browser, fresh.address) as page:
        enter(page, "otto")
        page.get_by_role("link", name="Appearances").click()
        page.get_by_role("link", name="New appearance").click()
        page.set_input_files("#file", {"name": "t.jpg", "mimeType": "image/jpeg", "buffer": out.getvalue()})
        page.get_by_role("button", name="Upload").click()
        expect(page.get_by_text("45 % of the object can look like the picture.")).to_be_visible()
        expect(page.get_by_text("30 % needs more light than the projectors have")).to_be_visible()
        for alt in ("What the object will look like, calculated", "Map of what can't be reached"):
            # a picture that was put into the page a moment ago says that it is complete before it is fetched
            expect(page.get_by_alt_text(alt)).not_to_have_js_property("naturalWidth", 0)
        assert not violations(page)
        picture(page, "feasibility")
        page.get_by_label("Name").fill("bronze")
        page.get_by_role("button", name="Compute").click()
        expect(page.get_by_text("It ended well.")).to_be_visible()
        page.get_by_role("link", name="Appearances").click()
        expect(page.get_by_role("heading", name="bronze")).to_be_visible()


def test_hours_are_typed_saved_and_stand_in_the_calendar(fresh: Served, browser: Browser) -> None:
    with tab(browser, fresh.address) as page:
        enter(page, "otto")
        page.get_by_role("link", name="Schedule").click()
        row = page.locator("fieldset.hours").nth(1)
        row.get_by_label("Days").fill("Tuesday - Thursday")
        row.get_by_label("Opens").fill("09:15")
        row.get_by_label("Closes").fill("17:45")
        page.get_by_role("button", name="Save the schedule").click()
        expect(page.get_by_text("The schedule is in use.")).to_be_visible()
        expect(page.get_by_text("09:15 to 17:45").first).to_be_visible()
        assert [row.day for row in fresh.kiosk.schedule().rows] == ["mon", "tue", "wed", "thu"]
        page.locator("fieldset.hours").nth(2).get_by_label("Days").fill("someday")
        page.get_by_role("button", name="Save the schedule").click()
        expect(page.get_by_role("alert")).to_contain_text("The day of row 3 is 'someday'.")
        assert page.locator("fieldset.hours").nth(2).get_by_label("Days").input_value() == "someday"


class SlowDoctor(MemoryKiosk):
    """It examines for longer than a person waits before a white page."""

    def doctor(self) -> Sequence[Notice]:
        time.sleep(3)
        return super().doctor()


def test_the_doctors_page_is_there_before_its_findings(tmp_path: Path, browser: Browser) -> None:
    with served(SlowDoctor(tmp_path / "pictures"), tmp_path / "private") as running:
        with tab(browser, running.address) as page:
            enter(page, "otto")
            began_s = time.monotonic()
            page.goto("/doctor", wait_until="domcontentloaded")
            expect(page.get_by_text("This takes some seconds.")).to_be_visible()
            assert time.monotonic() - began_s < 2.5
            expect(page.get_by_text("Check its mains plug.").first).to_be_visible()
            assert not violations(page)
        with running.entered("otto") as client:
            assert "Check its mains plug." in client.get("/doctor?wait=yes").text, "without a script"


def test_each_role_sees_only_what_it_may_do(panel: Served, browser: Browser) -> None:
    with tab(browser, panel.address) as page:
        enter(page, "vera")
        assert page.get_by_role("button").all_inner_texts() == ["Log out", "Use"]
        assert page.get_by_role("link", name="Settings").count() == 0
    with tab(browser, panel.address) as page:
        enter(page, "otto")
        assert page.get_by_role("button", name="Recalibrate", exact=True).count() == 1
        assert page.get_by_role("link", name="Settings").count() == 0


def test_settings_that_are_wrong_are_not_saved_and_not_lost(fresh: Served, browser: Browser) -> None:
    with tab(browser, fresh.address) as page:
        enter(page, "tina")
        page.get_by_role("link", name="System").click()
        page.get_by_role("link", name="Settings").click()
        file = page.locator("form", has=page.get_by_label("stage.toml"))
        file.get_by_label("stage.toml").fill("[stag]\n")
        file.get_by_role("button", name="Check and save").click()
        expect(page.get_by_role("alert")).to_contain_text("no key 'stag'")
        assert page.get_by_label("stage.toml").input_value() == "[stag]\n"
        assert "[stage]" in fresh.kiosk.settings()
        new = TOML.replace("Head of a boy", "<new>")
        page.get_by_label("stage.toml").fill(new)
        file.get_by_role("button", name="Check and save").click()
        expect(page.get_by_text("The settings are in use.")).to_be_visible()
        assert fresh.kiosk.settings() == new


def test_everything_works_with_the_keyboard_only(fresh: Served, browser: Browser) -> None:
    def tab_to(page: Page, text: str) -> None:
        for _ in range(60):
            page.keyboard.press("Tab")
            if page.evaluate("document.activeElement.textContent.trim()") == text:
                return
        raise AssertionError(f"no way to {text} by the Tab key")

    with tab(browser, fresh.address) as page:
        page.goto("/login")
        for key in ("Tab", *"otto", "Tab", *"a long pass phrase"):
            page.keyboard.press("Space" if key == " " else key)
        page.keyboard.press("Enter")
        page.wait_for_url("**/")
        page.keyboard.press("Tab")
        assert page.evaluate("document.activeElement.textContent") == "Skip to the content"
        tab_to(page, "Quick recalibration")
        page.keyboard.press("Enter")
        expect(page.get_by_text("It ended well.")).to_be_visible()
        tab_to(page, "Schedule")
        page.keyboard.press("Enter")
        expect(page.get_by_role("heading", name="Schedule", exact=True)).to_be_visible()


def test_first_start_leads_from_the_one_time_password_to_a_stage(tmp_path: Path, browser: Browser) -> None:
    kiosk = MemoryKiosk(tmp_path / "pictures")
    kiosk.change(needs_setup=True)
    accounts = Accounts(tmp_path / "private" / "accounts.json", hasher=QUICK_HASH)
    password = accounts.first_start()
    assert password is not None
    with served(kiosk, tmp_path / "private", accounts=accounts) as running, tab(browser, running.address) as page:
        page.goto("/login")
        page.get_by_label("Name").fill("technician")
        page.get_by_label("Password").fill(password)
        page.get_by_role("button", name="Log in").click()
        page.wait_for_url("**/password")
        expect(page.get_by_role("navigation")).to_have_count(0)
        page.goto("/settings")
        page.wait_for_url("**/password")
        time.sleep(1.2)
        expect(page.get_by_text("No connection")).to_be_hidden()
        page.get_by_label("New password, 10 characters or more").fill("seven tall horses")
        page.get_by_label("New password again").fill("seven tall horses")
        page.get_by_role("button", name="Change").click()
        page.wait_for_url("**/setup")
        page.get_by_role("button", name="Find devices").click()
        for device in ("Canon EOS R5 on USB", "Optoma on ttyUSB0", "One output of the graphics card"):
            page.get_by_label(device).check()
        page.get_by_role("button", name="Test the selected devices").click()
        expect(page.get_by_text("It answered in 12 ms.")).to_be_visible()
        assert not violations(page)
        picture(page, "setup")
        page.get_by_role("button", name="Write stage.toml").click()
        page.wait_for_url("**/aiming")
        assert '[camera]\ndriver = "ptp"' in kiosk.settings()
        assert accounts.first_start() is None


def test_every_page_of_the_navigation_is_looked_at() -> None:
    assert {path for path, _, _, _ in NAVIGATION} <= set(PAGES)


def test_an_appearance_is_switched_by_one_touch_of_its_picture(fresh: Served, browser: Browser) -> None:
    with tab(browser, fresh.address, phone=True) as page:
        enter(page, "otto")
        expect(page.get_by_role("button", name="Show marble")).to_have_attribute("aria-pressed", "true")
        page.get_by_role("button", name="Show warm wood").click()
        expect(page.locator("p.state")).to_contain_text("warm wood")
        expect(page.get_by_role("button", name="Show warm wood")).to_have_attribute("aria-pressed", "true")
        expect(page.get_by_role("button", name="Show marble")).to_have_attribute("aria-pressed", "false")
        assert page.url.endswith("/"), "the first page again"


def test_there_is_one_switch_and_what_is_not_possible_is_not_offered(fresh: Served, browser: Browser) -> None:
    kiosk = fresh.kiosk
    assert isinstance(kiosk, MemoryKiosk)

    def offered(page: Page, *names: str) -> None:
        for name in ("Open", "Close", "Recalibrate", "Quick recalibration"):
            button = page.get_by_role("button", name=name, exact=True)
            expect(button).to_be_visible() if name in names else expect(button).to_be_hidden()

    with tab(browser, fresh.address) as page:
        enter(page, "otto")
        offered(page, "Close", "Recalibrate", "Quick recalibration")
        kiosk.change(state="off", playing="")
        offered(page, "Open", "Recalibrate", "Quick recalibration")
        kiosk.change(bundle=None, grades=())
        offered(page, "Recalibrate")
        page.reload()
        offered(page, "Recalibrate")


def test_a_stage_that_can_show_nothing_leads_step_by_step(fresh: Served, browser: Browser) -> None:
    kiosk = fresh.kiosk
    assert isinstance(kiosk, MemoryKiosk)
    kiosk.change(state="ready", playing="", bundle=None, grades=())
    with tab(browser, fresh.address) as page:
        enter(page, "tina")
        expect(page.locator("p.state strong")).to_have_text("Nothing to show yet")
        expect(page.locator(".todo .done")).to_have_count(1)
        expect(page.locator(".todo .now a")).to_have_attribute("href", "/aiming")
        assert not violations(page)
        kiosk.change(grades=(Grade("run", 1.0, "full", "A", True),))
        expect(page.locator(".todo .now a")).to_have_attribute("href", "/appearances/new")
        kiosk.change(bundle=BundleIdentity(1, "ab" * 32, 1.0))
        expect(page.locator(".todo")).to_have_count(0)


class UpdatingHouse:
    """A house, as far as its page for updates asks it."""

    begun = True

    def rollout(self) -> Rollout:
        states = ("trial", "failed", "waits", "comes", "done", "")
        stages = (StageUpdate(f"stage {one}", "0.8", one, "It is dark." * (one == "failed")) for one in states)
        return Rollout(
            "0.9", self.begun, tuple(stages), tuple(f"`velatura {word}` sings." for word in ("x" * 20, *"abcdefgh"))
        )

    def now(self) -> HouseNow:
        return HouseNow("museum", (), ("all floors",))


def test_the_page_of_a_houses_update_has_no_barrier(tmp_path: Path, browser: Browser) -> None:
    house = UpdatingHouse()
    kiosk = MemoryKiosk(tmp_path / "pictures")
    opened = House(open=lambda: cast("Stagehouse", house))
    with served(kiosk, tmp_path / "private", house=opened) as running, tab(browser, running.address) as page:
        page.set_viewport_size({"width": 360, "height": 740})
        enter(page, "tina")
        for house.begun, button in ((True, "Stop"), (False, "Begin the update")):
            page.goto("/house/update")
            expect(page.get_by_role("button", name=button, exact=True)).to_be_visible()
            assert not (found := violations(page)), found
            wider = page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")
            assert wider <= 0


@pytest.mark.parametrize(("phone", "light"), [(True, False), (False, True), (False, False)])
def test_no_page_has_a_barrier(panel: Served, browser: Browser, phone: bool, light: bool) -> None:
    if not panel.kiosk.comparisons():
        panel.kiosk.compare()
    while not panel.kiosk.comparisons():
        time.sleep(0.02)
    with tab(browser, panel.address, phone=phone) as page:
        page.emulate_media(color_scheme="light" if light else "dark")
        if phone:
            page.set_viewport_size({"width": 360, "height": 740})
        page.goto("/login")
        assert not violations(page)
        enter(page, "tina")
        for path in PAGES:
            page.goto(path)
            page.wait_for_load_state("load")
            assert not (found := violations(page)), f"{path}\n{found}"
            wider = page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")
            assert wider <= 0, f"{path} is wider than the screen by {wider} px"
            picture(
                page,
                ("phone" if phone else "light" if light else "desk")
                + (path.replace("/", "-") if path != "/" else "-now"),
            )
