"""The set-up of a stage without stage.toml: find devices, try them, name the object, write the file."""

from __future__ import annotations

import json
from typing import Any

from starlette.requests import Request
from starlette.responses import RedirectResponse, Response

from controller.kiosk.interface import FoundDevice, TriedDevice
from controller.kiosk.store.accounts import Role
from controller.panel import answers
from controller.panel.auth.identity import Entry, Visitor
from controller.panel.context import Panel
from controller.panel.pages.forms import Sent, checked
from controller.panel.pages.routes import Pages
from controller.panel.words.language import gettext


class Setup:
    def __init__(self, panel: Panel, pages: Pages) -> None:
        self._panel, self._pages = panel, pages

    def entries(self) -> list[Entry]:
        forms = (("/setup/find", self._find), ("/setup/write", self._write))
        return [
            Entry("POST", path, "session", Role.TECHNICIAN, checked(self._panel, handler)) for path, handler in forms
        ]

    async def _find(self, _: Request, visitor: Visitor, sent: Sent) -> Response:
        """Search devices, and try the selected ones."""
        assert visitor.session is not None
        chosen = sent.many.get("key", [])
        try:
            devices = await self._panel.in_thread(lambda: list(self._panel.kiosk.find_devices()))
            tried = await self._panel.in_thread(lambda: self._tried(devices, chosen))
        except answers.FAILURES as error:
            visitor.session.notes.append(("error", f"{error.what} {error.remedy}"))
            kept: dict[str, Any] = {
                "found": None,
                "tried": {},
                "name": sent.texts.get("name", ""),
                "chosen": chosen,
                "here": "/setup",
            }
            return await self._pages.show("setup.html", visitor, kept, answers.status_of(error))
        name = sent.texts.get("name", "")
        facts = {"found": devices, "tried": tried, "name": name, "chosen": chosen, "here": "/setup"}
        return await self._pages.show("setup.html", visitor, facts)

    def _tried(self, devices: list[FoundDevice], chosen: list[str]) -> dict[str, TriedDevice]:
        tried: dict[str, TriedDevice] = {}
        for device in devices:
            if device.key in chosen:
                try:
                    tried[device.key] = self._panel.kiosk.try_device(device.key)
                except answers.FAILURES as error:
                    tried[device.key] = TriedDevice(False, f"{error.what} {error.remedy}")
        return tried

    async def _write(self, _: Request, visitor: Visitor, sent: Sent) -> Response:
        """Write the tables of the selected devices; the settings page shows what is wrong with them."""
        assert visitor.session is not None
        chosen = sent.many.get("key", [])
        text = ""
        try:
            devices = await self._panel.in_thread(lambda: list(self._panel.kiosk.find_devices()))
            text = stage_text(sent.texts.get("name", ""), [device for device in devices if device.key in chosen])
            await self._panel.in_thread(lambda: self._panel.kiosk.save_settings(text))
        except answers.FAILURES as error:
            return await self._pages.show(
                "settings.html", visitor, {"text": text, "problem": error, "here": "/settings"}, 422
            )
        visitor.session.notes.append(("good", gettext("The stage is set up. Aim the projectors next.")))
        return RedirectResponse("/aiming", 303)


def stage_text(name: str, devices: list[FoundDevice]) -> str:
    """A stage.toml of these devices. A JSON string is also a TOML string."""
    tables = "\n".join(device.table.strip() + "\n" for device in devices)
    return f"[stage]\nname = {json.dumps(name.strip(), ensure_ascii=False)}\n\n{tables}"
