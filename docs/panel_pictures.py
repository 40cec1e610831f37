"""Makes docs/pictures/panel-*.webp again, from the panel of a kiosk that runs:

PANEL_PASSWORD=... python -m docs.panel_pictures http://127.0.0.1:8377 NAME PICTURE

NAME is a technician. PICTURE is uploaded as a target. The stage of a demo is enough, after *Photograph and compare*; it
takes test shots.
"""

from __future__ import annotations

import contextlib
import io
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from PIL import Image
from playwright.sync_api import Browser, Page, expect

from tests.controller.panel.browser import chromium, enter

PICTURES: Final = Path(__file__).parent / "pictures"
DESK, PHONE = {"width": 1280, "height": 860}, {"width": 390, "height": 844}
TALLEST_PX: Final = 1700
PATIENCE_MS: Final = 600_000


def save(page: Page, name: str, tallest_px: int = TALLEST_PX) -> None:
    """The page from its top, without what is farther down than ``tallest_px``."""
    page.evaluate("document.querySelectorAll('img[loading=lazy]').forEach((one) => { one.loading = 'eager'; })")
    page.evaluate("Promise.all([...document.images].map((one) => one.decode().catch(() => null)))")
    page.wait_for_timeout(500)
    with Image.open(io.BytesIO(page.screenshot(full_page=True))) as whole:
        top = whole.convert("RGB").crop((0, 0, whole.width, min(whole.height, tallest_px)))
        top.save(PICTURES / f"{name}.webp", quality=72, method=6)


@contextlib.contextmanager
def looked_at(browser: Browser, address: str, name: str, *, phone: bool = False, dark: bool = True) -> Iterator[Page]:
    scheme = "dark" if dark else "light"
    context = browser.new_context(base_url=address, viewport=PHONE if phone else DESK, color_scheme=scheme)  # type: ignore[arg-type]
    page = context.new_page()
    page.set_default_timeout(PATIENCE_MS)
    try:
        enter(page, name, os.environ["PANEL_PASSWORD"])
        yield page
    finally:
        context.close()


def photograph(browser: Browser, address: str, name: str, target: Path) -> None:
    expect.set_options(timeout=PATIENCE_MS)
    with looked_at(browser, address, name) as page:
        save(page, "panel-now")
        page.goto("/results")
        save(page, "panel-results")
        page.get_by_role("button", name="Photograph and compare").click()
        page.goto("/")
        expect(page.locator("#photograph")).to_be_visible()
        save(page, "panel-job", 1000)
        expect(page.locator("[data-running]")).to_have_count(0)
        page.goto("/aiming")
        page.get_by_role("button", name="Take test shots").click()
        expect(page.locator("[data-running]")).to_have_count(1)
        expect(page.locator("[data-running]")).to_have_count(0)
        page.goto("/aiming")
        save(page, "panel-aiming")
    with looked_at(browser, address, name, dark=False) as page:
        page.goto("/appearances/new")
        page.set_input_files("#file", target)
        expect(page.locator(".way canvas").first).to_be_visible()
        save(page, "panel-new", 1120)
        page.get_by_role("button", name="Upload").click()
        expect(page.locator(".headline")).to_be_visible()
        save(page, "panel-reach", 1300)
        page.goto("/schedule")
        page.locator("#language").select_option("de")
        page.locator("footer button").click()
        save(page, "panel-german", 1500)
    with looked_at(browser, address, name, phone=True) as page:
        save(page, "panel-phone", 1500)


if __name__ == "__main__":
    with chromium() as started:
        photograph(started, sys.argv[1], sys.argv[2], Path(sys.argv[3]))
