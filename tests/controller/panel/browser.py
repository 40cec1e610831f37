"""A real headless Chromium on a served panel, whole or without what is around its pages."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from playwright.sync_api import Browser, BrowserContext, Page, expect, sync_playwright

from tests.controller.panel.served import PASSWORD

CHROMIUM: Final = Path("/usr/bin/chromium")
SHELL: Final = Path("/usr/bin/chromium-headless-shell")
"""Chromium without its windows and stored profiles: pages are the same, and a fresh profile is made quickly."""
FLAGS: Final = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
ARTEFACTS: Final = Path(__file__).parents[3] / "artefacts" / "panel"
PHONE: Final = {"width": 390, "height": 844}
DESK: Final = {"width": 1100, "height": 900}


@contextlib.contextmanager
def chromium(*flags: str, program: Path = CHROMIUM) -> Iterator[Browser]:
    """``program``: what starts it."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(program), args=[*FLAGS, *flags])
        try:
            yield browser
        finally:
            browser.close()


PATIENCE_MS = 30_000
"""For what comes within a second on a free machine."""
expect.set_options(timeout=PATIENCE_MS)


@contextlib.contextmanager
def tab(browser: Browser, address: str, *, phone: bool = False) -> Iterator[Page]:
    """A page of a fresh profile. Whatever the browser's console calls an error fails the test."""
    context: BrowserContext = browser.new_context(
        base_url=address, viewport={"width": 390, "height": 844} if phone else {"width": 1100, "height": 900}
    )
    page = context.new_page()
    page.set_default_timeout(PATIENCE_MS)
    complaints: list[str] = []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("console", lambda line: complaints.append(line.text) if "Content Security Policy" in line.text else None)
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    try:
        yield page
        assert not complaints, complaints
        assert all(url.startswith((address, "data:", "blob:")) for url in asked), asked
    finally:
        context.close()


def enter(page: Page, name: str, password: str = PASSWORD) -> None:
    page.goto("/login")
    page.get_by_label("Name").fill(name)
    page.get_by_label("Password").fill(password)
    page.get_by_role("button", name="Log in").click()
    page.wait_for_url("**/")


def picture(page: Page, name: str) -> Path:
    ARTEFACTS.mkdir(parents=True, exist_ok=True)
    path = ARTEFACTS / f"{name}.png"
    page.screenshot(path=path, full_page=True)
    return path
