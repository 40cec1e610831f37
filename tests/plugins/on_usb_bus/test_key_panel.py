"""The technician's keys: the library ``streamdeck``, and our driver on it, with an emulated Stream Deck."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing

import cv2
import numpy as np
import pytest
from StreamDeck.DeviceManager import DeviceManager
from StreamDeck.Devices.StreamDeckOriginalV2 import StreamDeckOriginalV2

from controller.run.state_machine import Event, Machine, State
from controller.stage.rig.key_panel import KeyService, key_picture, technicians_keys
from hal.conformance import ButtonPanelConformance
from hal.deadline import in_seconds
from hal.errors import DeviceError, DeviceGone, DeviceRefused
from lab.emulated.usb.process import UsbBusProcess
from plugins.hid import stream_deck
from plugins.hid.stream_deck import StreamDeckPanel


@pytest.fixture
def panel(bus: UsbBusProcess) -> Iterator[StreamDeckPanel]:
    bus.add("keys", "keys")
    panel = StreamDeckPanel(deadline=in_seconds(20))
    yield panel
    panel.close()


class TestStreamDeck(ButtonPanelConformance):
    @pytest.fixture
    def button_panel(self, panel: StreamDeckPanel) -> StreamDeckPanel:
        return panel


def on_key(bus: UsbBusProcess, key: int, name: str = "keys") -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """What is seen on a key, RGB: the panel turns what it gets by half a turn."""
    file = np.frombuffer(bytes.fromhex(bus.call(name, "picture_of", key)), np.uint8)
    decoded = cv2.imdecode(file, cv2.IMREAD_COLOR)
    assert decoded is not None
    return np.asarray(decoded[::-1, ::-1, ::-1], np.uint8)


def test_the_unchanged_library_takes_the_emulated_panel_for_a_real_one(bus: UsbBusProcess) -> None:
    bus.add("keys", "keys", serial="PEER12345", firmware="1.02.003")
    (deck,) = DeviceManager().enumerate()
    deck.open()
    assert (deck.get_serial_number(), deck.get_firmware_version()) == ("PEER12345", "1.02.003")
    assert (deck.key_count(), deck.deck_type()) == (15, "Stream Deck Original")
    deck.set_brightness(30)
    assert bus.get("keys", "brightness") == 30
    heard: list[tuple[int, bool]] = []
    deck.set_key_callback(lambda _, key, down: heard.append((key, down)))
    bus.call("keys", "press", 7)
    wait_until = time.monotonic() + 30
    while len(heard) < 2 and time.monotonic() < wait_until:
        time.sleep(0.01)
    assert heard == [(7, True), (7, False)]
    picture = bytes(range(256)) * 12  # three pages
    deck.set_key_image(4, picture)
    assert bytes.fromhex(bus.call("keys", "picture_of", 4)) == picture
    deck.reset()
    assert bus.call("keys", "picture_of", 4) == ""
    deck.close()


def test_a_picture_is_seen_upright_and_in_its_colours(bus: UsbBusProcess, panel: StreamDeckPanel) -> None:
    assert panel.capabilities.keys == 15
    assert panel.capabilities.picture_px == (72, 72)
    picture = np.zeros((72, 72, 3), np.uint8)
    picture[:36, :36] = (255, 0, 0)
    picture[36:, 36:] = (0, 0, 255)
    panel.show(3, picture, deadline=in_seconds(20))
    assert np.abs(on_key(bus, 3).astype(int) - picture)[4:32, 4:32].max() < 12
    assert np.abs(on_key(bus, 3).astype(int) - picture)[40:68, 40:68].max() < 12


def test_presses_are_told_once_and_in_their_order(bus: UsbBusProcess, panel: StreamDeckPanel) -> None:
    for key in (2, 0, 14):
        bus.call("keys", "press", key)
    assert [panel.wait_pressed(deadline=in_seconds(20)) for _ in range(3)] == [2, 0, 14]
    assert panel.wait_pressed(deadline=in_seconds(0.2)) is None


def test_an_unplugged_panel_is_gone_and_gets_its_pictures_back(bus: UsbBusProcess, panel: StreamDeckPanel) -> None:
    picture = np.full((72, 72, 3), 200, np.uint8)
    panel.show(1, picture, deadline=in_seconds(20))
    pull = threading.Timer(0.3, bus.unplug, ["keys"])
    pull.start()
    started = time.monotonic()
    with pytest.raises(DeviceGone):
        panel.wait_pressed(deadline=in_seconds(20))
    assert time.monotonic() - started < 10
    pull.join()
    bus.plug("keys")
    assert bus.call("keys", "picture_of", 1) == ""
    assert panel.wait_pressed(deadline=in_seconds(2)) is None
    assert on_key(bus, 1).mean() == pytest.approx(200, abs=3)
    bus.call("keys", "press", 5)
    assert panel.wait_pressed(deadline=in_seconds(20)) == 5


def test_a_panel_that_was_pulled_and_is_still_listed_is_gone(bus: UsbBusProcess, panel: StreamDeckPanel) -> None:
    bus.set("keys", "faults.lingers_s", 0.7)
    pull = threading.Thread(target=bus.unplug, args=["keys"])
    pull.start()
    with pytest.raises(DeviceGone):
        panel.wait_pressed(deadline=in_seconds(20))
    pull.join()


def test_a_panel_that_works_is_used_beside_one_that_cannot_be_opened(bus: UsbBusProcess) -> None:
    bus.add("mine", "keys", serial="KEYS-1")
    with closing(StreamDeckPanel(deadline=in_seconds(20))):
        bus.add("other", "keys", serial="KEYS-2")
        with closing(StreamDeckPanel(serial="KEYS-2", deadline=in_seconds(20))) as other:
            other.show(0, np.full((72, 72, 3), 100, np.uint8), deadline=in_seconds(20))
            assert on_key(bus, 0, "other").mean() == pytest.approx(100, abs=3)
            with pytest.raises(DeviceRefused) as caught:
                StreamDeckPanel(deadline=in_seconds(20))
            assert caught.value.code == "hid-not-opened"


def test_a_panel_that_leaves_again_while_it_gets_its_pictures_back_is_gone_until_it_stays(
    bus: UsbBusProcess, panel: StreamDeckPanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    panel.show(1, np.full((72, 72, 3), 200, np.uint8), deadline=in_seconds(20))
    bus.unplug("keys")
    with pytest.raises(DeviceGone):
        panel.wait_pressed(deadline=in_seconds(20))
    put = StreamDeckOriginalV2.set_key_image

    def pull_and_put(deck: StreamDeckOriginalV2, key: int, picture: bytes) -> None:
        bus.unplug("keys")
        put(deck, key, picture)

    bus.plug("keys")
    with monkeypatch.context() as loose:
        loose.setattr(StreamDeckOriginalV2, "set_key_image", pull_and_put)
        with pytest.raises(DeviceGone):
            panel.identity(deadline=in_seconds(20))
    bus.plug("keys")
    panel.identity(deadline=in_seconds(20))
    assert on_key(bus, 1).mean() == pytest.approx(200, abs=3)


def test_a_machine_that_is_busy_for_longer_than_a_wait_is_no_failure_of_the_panel(
    bus: UsbBusProcess, panel: StreamDeckPanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked = threading.Event()

    def slowly(deck: object) -> None:
        time.sleep(0.4)
        looked.set()

    monkeypatch.setattr(stream_deck, "_still_open", slowly)
    assert panel.wait_pressed(deadline=in_seconds(2)) is None
    assert looked.is_set()
    bus.call("keys", "press", 4)
    assert panel.wait_pressed(deadline=in_seconds(20)) == 4


def test_a_silent_panel_ends_at_the_deadline(bus: UsbBusProcess, panel: StreamDeckPanel) -> None:
    bus.set("keys", "faults.silent", True)
    started = time.monotonic()
    with pytest.raises(DeviceError):
        panel.show(0, np.zeros((72, 72, 3), np.uint8), deadline=in_seconds(0.5))
    assert time.monotonic() - started < 10
    bus.set("keys", "faults.silent", False)
    panel.show(0, np.zeros((72, 72, 3), np.uint8), deadline=in_seconds(15))


def test_closing_leaves_dark_keys(bus: UsbBusProcess, panel: StreamDeckPanel) -> None:
    panel.show(2, np.full((72, 72, 3), 250, np.uint8), deadline=in_seconds(20))
    panel.close()
    assert bus.call("keys", "picture_of", 2) == ""


def test_two_panels_are_told_apart_by_serial_number(bus: UsbBusProcess) -> None:
    bus.add("one", "keys", serial="KEYS-1")
    bus.add("two", "keys", serial="KEYS-2")
    with pytest.raises(DeviceRefused) as caught:
        StreamDeckPanel(deadline=in_seconds(20))
    assert caught.value.code == "hid-several"
    panel = StreamDeckPanel(serial="KEYS-2", deadline=in_seconds(20))
    bus.call("one", "press", 1)
    bus.call("two", "press", 2)
    assert panel.wait_pressed(deadline=in_seconds(20)) == 2
    panel.close()


def test_without_a_panel_the_error_says_what_to_check(bus: UsbBusProcess) -> None:
    with pytest.raises(DeviceGone) as caught:
        StreamDeckPanel(deadline=in_seconds(20))
    assert "udev" in caught.value.remedy


def test_keys_of_the_panel_command_a_stage(bus: UsbBusProcess, panel: StreamDeckPanel) -> None:
    machine, pressed = Machine(), queue.SimpleQueue[str]()
    for event in (Event.START, Event.LAMPS_LIT, Event.LAMPS_STABLE):
        machine.handle(event)

    def command(name: str, event: Event) -> Callable[[], None]:
        def press() -> None:
            machine.handle(event)
            pressed.put(name)

        return press

    commands = technicians_keys(
        command("play", Event.PLAY), command("stop", Event.STOP), command("recalibrate", Event.RECALIBRATE)
    )
    service = KeyService(panel, commands, state=lambda: machine.state)
    service.start()
    try:
        bus.call("keys", "press", 1)
        assert pressed.get(timeout=10) == "play"
        bus.call("keys", "press", 2)
        assert pressed.get(timeout=10) == "stop"
        bus.call("keys", "press", 3)  # not possible while the lamps cool
        assert machine.state is State.COOLING
        wanted = key_picture(commands[0], State.COOLING, (72, 72))
        wait_until = time.monotonic() + 30
        while np.abs(on_key(bus, 0).astype(int) - wanted).mean() > 8 and time.monotonic() < wait_until:
            time.sleep(0.05)
        assert np.abs(on_key(bus, 0).astype(int) - wanted).mean() < 8
        assert pressed.empty()
    finally:
        service.stop()
