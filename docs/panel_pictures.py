"""Makes docs/pictures/panel-*.png again, from the panel with an example kiosk: python -m docs.panel_pictures."""

from __future__ import annotations

import io
import tempfile
from pathlib import Path
from typing import Final

from PIL import Image
from playwright.sync_api import Browser, Page, expect

from tests.controller.panel.browser import chromium, enter, tab
from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.controller.panel.served import served

PICTURES: Final = Path(__file__).parent / "pictures"


def save(page: Page, name: str) -> None:
    """Save the whole page with 256 colours: half of the bytes."""
    with Image.open(io.BytesIO(page.screenshot(full_page=True))) as whole:
        # The octree keeps colours of small areas, which the median cut gives up.
        whole.convert("RGB").quantize(256, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(
            PICTURES / name, optimize=True
        )


def photograph(browser: Browser, folder: Path) -> None:
    with served(MemoryKiosk(folder / "pictures", step_s=1.0), folder / "private") as running:
        with tab(browser, running.address, phone=True) as page:
            enter(page, "tina")
            expect(page.locator("#live-job")).to_be_visible()
            save(page, "panel-phone.png")
        with tab(browser, running.address) as page:
            enter(page, "otto")
            page.get_by_role("button", name="Recalibrate", exact=True).click()
            page.locator("#live-job summary").click()
            expect(page.locator(".steps li").nth(1)).to_have_class("done")
            expect(page.get_by_alt_text("What the camera sees now")).to_be_visible()
            save(page, "panel-recalibrating.png")
            expect(page.get_by_text("It ended well.")).to_be_visible()
            page.get_by_role("link", name="Appearances").click()
            page.get_by_role("button", name="Photograph and compare all").click()
            expect(page.get_by_text("It ended well.")).to_be_visible()
        with tab(browser, running.address) as page:
            enter(page, "tina")
            page.emulate_media(color_scheme="dark")
            save(page, "panel-now.png")
            page.goto("/aiming")
            expect(page.locator("#live-view")).to_be_visible()
            save(page, "panel-aiming.png")
            page.emulate_media(color_scheme="light")
            page.goto("/results")
            save(page, "panel-results.png")
            page.goto("/schedule")
            page.locator("#language").select_option("de")
            page.locator("footer button").click()
            save(page, "panel-german.png")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as scratch, chromium() as started:
        photograph(started, Path(scratch))
