"""Stream Deck key panels, through the library ``streamdeck``: the technician's keys."""

from __future__ import annotations

import contextlib
import queue
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from StreamDeck.DeviceManager import DeviceManager, ProbeError
from StreamDeck.Transport.Transport import TransportError

from hal.codecs.ptp.values import printable
from hal.deadline import Deadline, in_seconds
from hal.errors import DeviceGone, DeviceRefused, PluginError, ProtocolError
from hal.registry import Driver, OpenContext, setting
from hal.values import DeviceIdentity, PanelCapabilities
from plugins.worker_link import NotOpened, WorkerLink

_SLICE_S: Final = 0.1
_LOOK_S: Final = 5.0
"""Time limit of checking that the panel is still connected; on a busy machine it may take a second."""
_MOST_WAITING: Final = 16
"""Number of presses that are kept until they are read; older ones are dropped."""
_ENCODINGS: Final = {"JPEG": ".jpg", "BMP": ".bmp"}


class StreamDeckPanel(WorkerLink[Any]):
    """``hal.interfaces.ButtonPanel``. Its pictures are restored after it was unplugged."""

    def __init__(self, *, serial: str = "", deadline: Deadline) -> None:
        super().__init__("key panel", broken=(TransportError,))
        self._serial = serial
        self._pressed: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._pictures: dict[int, bytes] = {}
        try:
            self._manager = DeviceManager()
        except ProbeError as error:
            raise PluginError(
                "hidapi-missing",
                what="The library for key panels could not be loaded.",
                remedy="Install the system's package libhidapi-libusb0.",
            ) from error
        try:
            self._format: Mapping[str, Any] | None = None
            self._capabilities = self.call(self._measure, deadline=deadline)
        except BaseException:
            self.close()
            raise

    @property
    def capabilities(self) -> PanelCapabilities:
        return self._capabilities

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        def query(deck: Any) -> DeviceIdentity:
            return DeviceIdentity("Elgato", deck.deck_type(), _text(deck.get_serial_number()),
                                  _text(deck.get_firmware_version()))  # fmt: skip

        return self.call(query, deadline=deadline)

    def show(self, key: int, picture: npt.NDArray[np.uint8], *, deadline: Deadline) -> None:
        """See ``hal.interfaces.ButtonPanel.show``. Raises DeviceRefused("panel-no-key", "panel-picture")."""
        encoded = self._encoded(key, picture)

        def put(deck: Any) -> None:
            deck.set_key_image(key, encoded)

        self.call(put, deadline=deadline)
        self._pictures[key] = encoded

    def wait_pressed(self, *, deadline: Deadline) -> int | None:
        """See ``hal.interfaces.ButtonPanel.wait_pressed``. Raises DeviceGone while it is unplugged.

        For a hanging panel, it raises at most 5 s after the deadline.
        """
        while True:
            deadline.sleep(0.0)  # a cancelled wait ends
            with contextlib.suppress(queue.Empty):
                return self._pressed.get(timeout=min(_SLICE_S, deadline.left_s()) or 1e-6)
            if deadline.left_s() < _SLICE_S / 10:
                return None
            self.call(_still_open, deadline=in_seconds(_LOOK_S, deadline.cancel))

    def find(self) -> Any:
        """See ``WorkerLink.find``. Raises DeviceGone, or DeviceRefused (several of them, or no permission)."""
        matching = self._matching()
        if len(matching) > 1:
            for deck, _ in matching:
                deck.close()
            raise DeviceRefused(
                "hid-several",
                what=f"There are {len(matching)} key panels ({', '.join(serial for _, serial in matching)}).",
                remedy="Write the serial number of the right one into stage.toml, or unplug the others.",
            )
        if not matching:
            which = f" with serial number {self._serial}" if self._serial else ""
            raise DeviceGone(
                "hid-unplugged",
                what=f"No key panel{which} is plugged in, or this user may not open it.",
                remedy="Check its cable, and install firmware_configs/udev/70-velatura-hid.rules.",
            )
        deck, self._serial = matching[0]
        deck.set_key_callback(self._changed)
        try:
            for key, picture in tuple(self._pictures.items()):
                deck.set_key_image(key, picture)
        except TransportError:  # it was unplugged again
            self.let_go(deck)
            raise
        return deck

    def _matching(self) -> list[tuple[Any, str]]:
        matching: list[tuple[Any, str]] = []
        refused: NotOpened | None = None
        for deck in self._manager.enumerate():
            try:
                deck.open()
                serial = _text(deck.get_serial_number())
            except TransportError as error:
                deck.close()
                if any(other.id() == deck.id() for other in self._manager.enumerate()):
                    refused = self.not_opened(error)
                continue  # it was just unplugged, or another one is the right panel
            if deck.is_visual() and self._serial in ("", serial):
                matching.append((deck, serial))
            else:
                deck.close()
        if refused is not None and not (matching and self._serial):
            for deck, _ in matching:
                deck.close()
            raise refused
        return matching

    def let_go(self, opened: Any) -> None:
        # Dark keys: presses have no effect any more. An unplugged panel needs none.
        with contextlib.suppress(TransportError):
            opened.reset()
        with contextlib.suppress(TransportError):
            opened.close()

    def _measure(self, deck: Any) -> PanelCapabilities:
        self._format = deck.key_image_format()
        return PanelCapabilities(deck.key_count(), tuple(self._format["size"]))

    def _changed(self, deck: Any, key: int, down: bool) -> None:
        """On the library's reading thread."""
        if down:
            self._pressed.put(key)
            if self._pressed.qsize() > _MOST_WAITING:
                with contextlib.suppress(queue.Empty):
                    self._pressed.get_nowait()

    def _encoded(self, key: int, picture: npt.NDArray[np.uint8]) -> bytes:
        assert self._format is not None
        width, height = self._format["size"]
        if not 0 <= key < self._capabilities.keys:
            raise DeviceRefused(
                "panel-no-key",
                what=f"The key panel has no key {key}.",
                remedy=f"Use a key from 0 to {self._capabilities.keys - 1}.",
            )
        if picture.shape != (height, width, 3) or picture.dtype != np.uint8:
            raise DeviceRefused(
                "panel-picture",
                what=f"A picture of {picture.shape} {picture.dtype} does not fit on a key.",
                remedy=f"Use {height} rows of {width} pixels with three bytes each.",
            )
        across, down = self._format["flip"]
        turned = picture[:: -1 if down else 1, :: -1 if across else 1]
        import cv2

        turned = np.rot90(turned, self._format["rotation"] // 90)
        done, file = cv2.imencode(
            _ENCODINGS[self._format["format"]], cv2.cvtColor(np.ascontiguousarray(turned), cv2.COLOR_RGB2BGR)
        )
        if not done:
            raise ProtocolError(
                "panel-picture",
                what="A picture could not be encoded.",
                remedy="Report this mistake to the maintainers.",
                theirs=False,
            )
        return file.tobytes()


def _still_open(deck: Any) -> None:
    # The library's reading thread closes a deck that it can't read.
    if not deck.is_open():
        raise TransportError("unplugged")


def _text(text: str) -> str:
    return printable(text[:64])


def open_key_panel(settings: Mapping[str, Any], context: OpenContext, deadline: Deadline) -> StreamDeckPanel:
    """Open the key panel of a stage's table."""
    return StreamDeckPanel(serial=setting(settings, "serial", str, ""), deadline=deadline)


DRIVER: Final = Driver(
    kind="button_panel",
    name="stream-deck",
    summary="Elgato Stream Deck key panels with pictures on their keys.",
    open=open_key_panel,
    settings={"serial": "its serial number (default: the only key panel)"},
)
