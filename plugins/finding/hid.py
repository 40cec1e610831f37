"""HID devices that a driver knows: relay boards, light sensors, key panels. No relay is moved."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from hal.codecs import hid as hid_reports
from hal.codecs.ptp.values import printable
from hal.deadline import Cancelled, Deadline
from hal.errors import DeviceError, DeviceTimeout
from hal.finding import Finder, Found, SearchScope
from hal.notices import Notice
from plugins.finding.access import forbidden, holders
from plugins.hid.link import BACKENDS, HidHandle
from plugins.worker_link import WorkerLink

RULES: Final = "70-velatura-hid.rules"
ELGATO: Final = 0x0FD9
LISTING_S: Final = 5.0
ASKING_S: Final = 2.0
"""Time limit for one device, so that a silent one does not use up the time of the others."""


class _Hidapi(WorkerLink[Any]):
    """hidapi on its own thread, because its calls can hang; ``name`` is the device, for messages."""

    def __init__(self, name: str) -> None:
        super().__init__(name, broken=(OSError, ValueError))

    def find(self) -> Any:
        import importlib

        return importlib.import_module(BACKENDS["hidraw"])

    def let_go(self, opened: Any) -> None:
        """Nothing to close."""


def find(wanted: SearchScope, deadline: Deadline) -> Sequence[Found]:
    """Every HID device that could be supported. Raises DeviceError if hidapi is missing or hangs."""
    with contextlib.closing(_Hidapi("list of HID devices")) as listing:
        entries = listing.call(lambda hidapi: list(hidapi.enumerate()), deadline=deadline.within(LISTING_S))
    by_path = {entry["path"]: entry for entry in entries}
    return [found for entry in by_path.values() if (found := _found(entry, deadline)) is not None]


def _found(entry: Mapping[str, Any], deadline: Deadline) -> Found | None:
    numbers = (entry["vendor_id"], entry["product_id"])
    product, serial = (printable(str(entry[key] or "")[:60]) for key in ("product_string", "serial_number"))
    channels = (
        hid_reports.channels_of(product) if numbers == (hid_reports.RELAY_VENDOR, hid_reports.RELAY_PRODUCT) else None
    )
    if channels is not None:
        kind, driver, what = "power_switch", "usb-relay", f"relay board with {channels} relays"
    elif numbers == (hid_reports.LIGHT_SENSOR_VENDOR, hid_reports.LIGHT_SENSOR_PRODUCT):
        kind, driver, what = "light_sensor", "colorhug-als", "ambient light sensor"
    elif numbers[0] == ELGATO:
        kind, driver, what = "button_panel", "stream-deck", f"key panel, {product}"
    else:
        return None
    node = Path(entry["path"].decode("utf-8", "replace"))
    problem = forbidden(node, what, RULES, f"{numbers[0]:04x}") or _held(node, what)
    if problem is None and channels is not None:
        try:
            serial = _relay_serial(f"{what} at {node}", entry["path"], channels, deadline.within(ASKING_S))
        except Cancelled:
            raise
        except DeviceTimeout as error:
            problem = Notice.of(error)
        except DeviceError as error:
            problem = Notice.warning(
                "hid-not-opened",
                f"The {what} at {node} does not answer: {error.what}",
                "Unplug it and plug it in again.",
            )
    settings = {"serial": serial} if serial else {}
    problems = () if problem is None else (problem,)
    return Found(
        "hid", str(node), what, kind, driver, settings, serial or f"{numbers[0]:04x}:{numbers[1]:04x}", problems
    )


def _relay_serial(name: str, path: bytes, channels: int, deadline: Deadline) -> str:
    """A board's serial number must be requested; its USB descriptor has none."""

    def query(hidapi: Any) -> str:
        handle: HidHandle = hidapi.device()
        handle.open_path(path)
        try:
            return hid_reports.parse_state(
                handle.get_feature_report(0, hid_reports.RELAY_REPORT_LENGTH), channels
            ).serial
        finally:
            handle.close()

    link = _Hidapi(name)
    try:
        return link.call(query, deadline=deadline)
    finally:
        link.close()


def _held(node: Path, what: str) -> Notice | None:
    who = holders(node)
    if not who:
        return None
    return Notice.warning(
        "hid-taken", f"The {what} at {node} is open in {', '.join(who)}.", "End that program, unless it is Velatura."
    )


FINDER: Final = Finder("hid", find)
