"""What the pages' controls do, in a real Chromium: the picture's verbs, an outline, a wipe, a report, two languages."""

from __future__ import annotations

import io
import json
import time
from collections.abc import Iterator

import pytest
from PIL import Image
from playwright.sync_api import Browser, Page, expect

from controller.panel.app import STATIC
from tests.controller.panel.browser import SHELL, chromium, enter, picture, tab
from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.controller.panel.served import Served, csrf
from tests.controller.panel.test_in_browser import violations

pytestmark = pytest.mark.skipif(
    not SHELL.exists(), reason="needs Debian's chromium-headless-shell (a package of the test set-up)"
)
FIRST_PAGE_BYTES = 250_000


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium(program=SHELL) as started:
        yield started


def kiosk_of(served: Served) -> MemoryKiosk:
    assert isinstance(served.kiosk, MemoryKiosk)
    return served.kiosk


def choose(page: Page, picture: Image.Image) -> None:
    """As a file of the form that is shown."""
    out = io.BytesIO()
    picture.save(out, "PNG")
    page.set_input_files("#file", {"name": "t.png", "mimeType": "image/png", "buffer": out.getvalue()})


def test_the_picture_is_made_darker_black_and_followed_by_the_next(fresh: Served, browser: Browser) -> None:
    kiosk = kiosk_of(fresh)
    with tab(browser, fresh.address) as page:
        enter(page, "otto")
        page.get_by_label("Brightness", exact=True).fill("40")
        page.get_by_role("button", name="Set", exact=True).click()
        expect(page.locator("p.state em")).to_have_text("Brightness 40 %")
        page.get_by_role("button", name="Black", exact=True).click()
        expect(page.locator("p.state em")).to_have_text("Black")
        assert (kiosk.snapshot().brightness, kiosk.snapshot().black) == (40, True)
        for name in ("Next appearance", "Black", "Set"):
            expect(page.get_by_role("button", name=name, exact=True)).to_be_hidden()
        page.get_by_role("button", name="Show the picture again").click()
        page.get_by_role("button", name="Next appearance").click()
        expect(page.locator("p.state b")).to_have_text("warm wood")
        page.get_by_role("button", name="Show all in turn").click()
        page.get_by_role("button", name="Pause").click()
        page.get_by_role("button", name="Continue").click()
        kiosk.stop()
        for name in ("Next appearance", "Black", "Pause", "Set"):
            expect(page.get_by_role("button", name=name, exact=True)).to_be_hidden()


@pytest.mark.parametrize(("look", "word"), [("dark", "dark"), ("light", "light")])
def test_a_switch_makes_pages_dark_or_light_whatever_the_device_asks(
    fresh: Served, browser: Browser, look: str, word: str
) -> None:
    with tab(browser, fresh.address) as page:
        page.emulate_media(color_scheme="light" if look == "dark" else "dark")
        page.goto("/login")
        page.locator("#look").select_option(look)
        page.get_by_role("button", name="Use").click()
        page.wait_for_load_state()
        assert page.evaluate("getComputedStyle(document.documentElement).colorScheme") == word
        enter(page, "otto")
        assert page.evaluate("getComputedStyle(document.documentElement).colorScheme") == word


def test_what_is_chosen_is_not_said_to_play_while_the_lamps_are_dark(fresh: Served) -> None:
    kiosk_of(fresh).change(state="powering", playing="")
    with fresh.entered("otto") as otto:
        sent = {"csrf": csrf(otto.get("/").text), "name": "warm wood", "back": "/"}
        kiosk_of(fresh).play = lambda name, fade_s=None: None  # type: ignore[method-assign]
        otto.post("/do/play", data=sent)
        assert "warm wood is chosen. It is shown when the lamps are lit." in otto.get("/").text


def test_an_outline_restricts_the_target_and_the_result_is_played(fresh: Served, browser: Browser) -> None:
    with tab(browser, fresh.address) as page:
        enter(page, "otto")
        page.goto("/appearances/new")
        choose(page, Image.new("RGB", (240, 160), "white"))
        page.get_by_role("button", name="Upload").click()
        expect(page.get_by_text("45 %").first).to_be_visible()
        page.get_by_label("Target over the object").fill("20")
        assert page.locator("#on-object .over").evaluate("one => getComputedStyle(one).opacity") == "0.2"
        place = page.locator("#draw")
        place.scroll_into_view_if_needed()
        box = place.bounding_box()
        assert box is not None
        for x, y in ((0.01, 0.02), (0.5, 0.02), (0.5, 0.98), (0.01, 0.98)):
            place.click(position={"x": x * box["width"], "y": y * box["height"]})
        assert not violations(page)
        page.get_by_role("button", name="Use this outline").click()
        expect(page.get_by_text("The outline is used.")).to_be_visible()
        key = page.url.rpartition("/")[2]
        with Image.open(fresh.app.state.panel.targets.path(key)) as kept:
            assert kept.mode == "RGBA"
            alpha = kept.getchannel("A")
            assert (alpha.getpixel((20, 80)), alpha.getpixel((220, 80))) == (255, 0)
        assert len(json.loads(page.locator("#outline").input_value())[0]) == 4, "it can be drawn on"
        page.get_by_label("Name", exact=True).fill("bronze")
        page.get_by_role("button", name="Compute").click()
        expect(page.get_by_text("It ended well.")).to_be_visible()
        page.get_by_role("button", name="Play now").click()
        expect(page.locator("p.state b")).to_have_text("bronze")
        expect(page.get_by_role("button", name="Play now")).to_be_hidden()


def test_points_in_the_picture_and_on_the_object_lay_it(fresh: Served, browser: Browser) -> None:
    with tab(browser, fresh.address) as page:
        enter(page, "otto")
        page.goto("/appearances/new")
        choose(page, Image.new("RGB", (240, 160), "white"))
        page.get_by_role("button", name="Upload").click()
        lay = page.get_by_role("button", name="Lay it by these points")
        for name in ("The uploaded target", "The object in white light"):
            place = page.get_by_role("application", name=name)
            place.scroll_into_view_if_needed()
            box = place.bounding_box()
            assert box is not None
            assert lay.is_disabled()
            for x, y in ((0.1, 0.1), (0.9, 0.1), (0.9, 0.9)):
                place.click(position={"x": x * box["width"], "y": y * box["height"]})
            place.press("Enter")
            place.press("ArrowLeft")
            place.press("Shift+ArrowDown")
        assert not violations(page)
        page.get_by_label("Blink").check()
        lay.click()
        expect(page.get_by_text("The picture is fitted again.")).to_be_visible()
    ((_, sent),) = [one for one in kiosk_of(fresh).asked if one[0] == "points"]
    pairs = json.loads(str(sent))
    assert len(pairs) == 4
    assert pairs[1] == pytest.approx([0.9, 0.1, 0.9, 0.1], abs=0.01)
    assert pairs[3][:2] == pytest.approx([0.5 - 1 / 240, 0.5 + 10 / 160], abs=1e-4)


COLOUR_AT = """([way, x, y]) => {
  const canvas = document.querySelector(`input[value=${way}] ~ .way canvas`);
  return [...canvas.getContext("2d").getImageData(x * canvas.width / 96, y * canvas.height / 80, 1, 1).data];
}"""


def test_a_chosen_picture_is_shown_in_each_way_to_fit_it(panel: Served, browser: Browser) -> None:
    """The view is 240 x 160, drawn as 80 x 53.3 around (48, 40); the picture is 120 x 20, red with a blue left edge."""
    chosen = Image.new("RGB", (120, 20), (255, 0, 0))
    chosen.paste((0, 0, 255), (0, 0, 30, 20))
    red, blue, nothing = [255, 0, 0, 255], [0, 0, 255, 255], [0, 0, 0, 0]
    with tab(browser, panel.address) as page:
        enter(page, "otto")
        page.goto("/appearances/new")
        expect(page.locator(".way canvas").first).to_be_hidden()
        choose(page, chosen)
        expect(page.locator(".way canvas").first).to_be_visible()
        for way, at, colour in [
            ("fit", (48, 40), red), ("fit", (12, 40), blue), ("fit", (48, 20), nothing),
            ("fill", (12, 18), red), ("fill", (12, 8), nothing),
            ("crop", (48, 40), red), ("crop", (30, 40), blue), ("crop", (24, 40), nothing), ("crop", (48, 46), nothing),
            ("wrap", (48, 40), red), ("wrap", (12, 40), nothing),
        ]:  # fmt: skip
            assert page.evaluate(COLOUR_AT, [way, *at]) == colour, (way, at)
        page.set_input_files("#file", {"name": "t.txt", "mimeType": "text/plain", "buffer": b"no picture"})
        expect(page.locator(".way canvas").first).to_be_hidden()


def test_a_scene_is_looked_at_on_the_object_computed_and_played(fresh: Served, browser: Browser) -> None:
    with tab(browser, fresh.address) as page:
        enter(page, "otto")
        page.get_by_role("link", name="Appearances").click()
        page.get_by_role("link", name="New appearance").click()
        for picture in page.locator(".scenes img").all():
            picture.scroll_into_view_if_needed()
            expect(picture).not_to_have_js_property("naturalWidth", 0)
        named = ["Marble", "Gold", "Blue glaze", "Bent forward", "leaves"]
        assert page.locator(".scenes li").all_inner_texts() == named
        assert not violations(page)
        page.get_by_role("link", name="Gold").click()
        expect(page.get_by_text("45 % of the object can look like the picture.")).to_be_visible()
        expect(page.get_by_alt_text("What the object will look like, calculated")).not_to_have_js_property(
            "naturalWidth", 0
        )
        assert not violations(page)
        page.get_by_label("Name", exact=True).fill("-")
        page.get_by_role("button", name="Compute").click()
        expect(page.get_by_role("alert")).to_contain_text("name")
        assert page.get_by_label("Name", exact=True).input_value() == "-", "what was typed stays"
        page.get_by_label("Name", exact=True).fill("gold")
        page.get_by_role("button", name="Compute").click()
        expect(page.get_by_text("It ended well.")).to_be_visible()
        page.get_by_role("button", name="Play now").click()
        expect(page.locator("p.state b")).to_have_text("gold")
        assert ("compute-scene", ("gold", "gold")) in kiosk_of(fresh).asked


def test_a_mesh_is_laid_by_places_on_both_and_blinks(fresh: Served, browser: Browser) -> None:
    with tab(browser, fresh.address) as page:
        enter(page, "otto")
        page.goto("/appearances/new")
        page.get_by_role("link", name="Lay a mesh on the object").click()
        page.get_by_role("link", name="bust.glb").click()
        page.get_by_role("link", name="Turn right").click()
        mesh, view = page.locator("#by-points .overlay").all()
        for side in (mesh, view):
            expect(side.locator("img")).not_to_have_js_property("naturalWidth", 0)
        lay = page.get_by_role("button", name="Lay it by these points")
        for n in range(4):
            for side in (mesh, view):
                expect(lay).to_be_disabled()
                side.click(position={"x": 20 + 60 * (n % 2), "y": 20 + 40 * (n // 2)})
        assert not violations(page)
        lay.click()
        expect(page.get_by_text("The mesh lies on the object.")).to_be_visible()
        expect(page.get_by_text("They differ by 0.12 mm")).to_be_visible()
        over = page.locator("#laid .over")
        expect(over).to_have_css("animation-name", "none")
        page.get_by_label("Blink").check()
        expect(over).to_have_css("animation-name", "blink")
        sent = kiosk_of(fresh).asked[-1][1]
        assert isinstance(sent, tuple)
        assert (*sent[:2], len(json.loads(sent[2]))) == ("bust.glb", 1, 4)


def test_pictures_are_compared_by_a_line_and_a_report_opens_in_its_page(fresh: Served, browser: Browser) -> None:
    kiosk = kiosk_of(fresh)
    kiosk.compare()
    while not kiosk.comparisons():
        time.sleep(0.02)
    with tab(browser, fresh.address) as page:
        enter(page, "otto")
        page.goto("/results")
        wipe = page.locator("[data-wipe]").first
        wipe.get_by_role("slider").fill("30")
        assert wipe.locator(".over").evaluate("one => getComputedStyle(one).clipPath") == "inset(0px 0px 0px 30%)"
        wipe.get_by_role("button", name="Before").click()
        expect(wipe.locator(".under")).to_have_attribute("alt", "Before, marble")
        assert page.locator("svg.curve").count() >= 3, "trends"
        page.get_by_role("link", name="Report with plots and maps").click()
        expect(page.frame_locator("iframe").locator("body")).to_contain_text("")
        assert page.frames[1].title() == "A report"


def test_the_live_picture_says_how_sharp_and_how_bright_it_is(panel: Served, browser: Browser) -> None:
    with tab(browser, panel.address) as page:
        enter(page, "tina")
        page.goto("/aiming")
        expect(page.locator("#live-view")).to_be_visible()
        expect(page.locator("#sharp-now")).to_have_text("100%")
        assert page.locator("#levels path").get_attribute("d").count("H") == 32  # type: ignore[union-attr]


@pytest.mark.parametrize("language", ["de", "ja"])
def test_a_phone_shows_other_languages_without_scrolling_sideways(
    panel: Served, browser: Browser, language: str
) -> None:
    with tab(browser, panel.address, phone=True) as page:
        page.set_viewport_size({"width": 360, "height": 740})
        page.goto("/login")
        page.locator("#language").select_option(language)
        page.locator("footer button").click()
        assert page.locator("html").get_attribute("lang") == language
        page.locator("#name").fill("tina")
        page.locator("#password").fill("a long pass phrase")
        page.locator("button.main").click()
        page.wait_for_url("**/")
        for path in ("/", "/schedule", "/results", "/aiming"):
            page.goto(path)
            wider = page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")
            assert wider <= 0, f"{path} is wider than the screen by {wider} px"
        said = {"de": "Es läuft kein Auftrag.", "ja": "実行中の作業はありません。"}[language]
        page.goto("/aiming")
        expect(page.locator("#live-job")).to_contain_text(said)


def test_the_first_page_with_its_pictures_is_small(panel: Served) -> None:
    with panel.entered("otto") as client:
        page = client.get("/")
        size = len(page.content) + sum(len(client.get(f"/static/{name}").content) for name in STATIC)
        for address in {one.split('"')[0] for one in page.text.split('src="')[1:] if one.startswith("/see/")}:
            size += len(client.get(address).content)
        assert csrf(page.text)
        assert size <= FIRST_PAGE_BYTES, f"{size:,} bytes"


def test_an_outline_drawn_in_the_settings_says_what_the_object_is(fresh: Served, browser: Browser) -> None:
    with tab(browser, fresh.address) as page:
        enter(page, "tina")
        page.goto("/settings")
        place = page.locator("#draw")
        place.scroll_into_view_if_needed()
        box = place.bounding_box()
        assert box is not None
        for x, y in ((0.25, 0.25), (0.75, 0.25), (0.5, 0.75)):
            place.click(position={"x": x * box["width"], "y": y * box["height"]})
        assert not violations(page)
        picture(page, "outline")
        page.get_by_role("button", name="Check and save").first.click()
        if page.url.endswith("/do/save-settings"):
            page.get_by_role("button", name="Yes").click()
        expect(page.get_by_text("The settings are in use.")).to_be_visible()
        (region,) = json.loads(page.locator("#outline").input_value())
        assert region == [pytest.approx(corner, abs=0.01) for corner in ([0.25, 0.25], [0.75, 0.25], [0.5, 0.75])]
        assert "[object]\noutline = [[[0.2" in fresh.kiosk.settings()
