"""Tests for drivers of key panels."""

from __future__ import annotations

import threading
import time

import numpy as np
import numpy.typing as npt
import pytest

from hal.conformance.device import DeviceConformance
from hal.deadline import Cancelled, in_seconds
from hal.driver_calls import Caller
from hal.errors import DeviceRefused, DeviceTimeout
from hal.interfaces import ButtonPanel


class ButtonPanelConformance(DeviceConformance):
    """Run on every key panel driver; supply a fixture ``button_panel``. Do not press a key during the test."""

    def test_says_who_it_is(self, button_panel: ButtonPanel) -> None:
        assert isinstance(button_panel, ButtonPanel)
        self.check_identity(button_panel)

    def test_has_keys(self, button_panel: ButtonPanel) -> None:
        keys = button_panel.capabilities
        assert keys.keys > 0
        assert keys.picture_px is None or min(keys.picture_px) > 0

    def test_shows_pictures_or_refuses_them(self, button_panel: ButtonPanel) -> None:
        if button_panel.capabilities.picture_px is None:
            with pytest.raises(DeviceRefused):
                button_panel.show(0, np.zeros((8, 8, 3), np.uint8), deadline=self.soon())
            return
        for key in (0, button_panel.capabilities.keys - 1):
            button_panel.show(key, self.picture(button_panel), deadline=self.soon())

    def test_refuses_what_does_not_fit(self, button_panel: ButtonPanel) -> None:
        picture = self.picture(button_panel)
        for key in (-1, button_panel.capabilities.keys):
            with pytest.raises(DeviceRefused):
                button_panel.show(key, picture, deadline=self.soon())
        for wrong in (picture[:-1], picture[:, :, :2], picture.astype(np.float32)):
            with pytest.raises(DeviceRefused):
                button_panel.show(0, wrong, deadline=self.soon())  # type: ignore[arg-type]

    def test_no_key_is_pressed_by_itself(self, button_panel: ButtonPanel) -> None:
        started = time.monotonic()
        assert button_panel.wait_pressed(deadline=in_seconds(0.3)) is None
        assert 0.2 < time.monotonic() - started < 0.3 + self.prompt_s
        assert button_panel.wait_pressed(deadline=in_seconds(-1.0)) is None

    def test_waiting_ends_when_cancelled(self, button_panel: ButtonPanel) -> None:
        stop = threading.Event()
        threading.Timer(0.2, stop.set).start()
        started = time.monotonic()
        with pytest.raises(Cancelled):
            button_panel.wait_pressed(deadline=in_seconds(self.patience_s, stop))
        assert time.monotonic() - started < 0.2 + self.prompt_s

    def test_keeps_deadlines_and_stops_when_cancelled(self, button_panel: ButtonPanel) -> None:
        self.check_deadline_and_cancel(button_panel)
        if button_panel.capabilities.picture_px is not None:
            with pytest.raises(DeviceTimeout):
                button_panel.show(0, self.picture(button_panel), deadline=in_seconds(-1.0))

    def test_every_answer_and_error_is_of_its_type(self, button_panel: ButtonPanel) -> None:
        assert Caller("The driver under test").device("button_panel", button_panel).capabilities.keys > 0
        self.check_types("button_panel", button_panel)

    def test_closing_twice_is_harmless(self, button_panel: ButtonPanel) -> None:
        self.check_closes_twice(button_panel)

    def picture(self, button_panel: ButtonPanel) -> npt.NDArray[np.uint8]:
        """A grey picture of the right size."""
        width, height = button_panel.capabilities.picture_px or (8, 8)
        return np.full((height, width, 3), 128, np.uint8)
