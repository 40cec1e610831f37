"""Tests for display drivers."""

from __future__ import annotations

import time

import numpy as np
import numpy.typing as npt
import pytest

from hal.conformance.device import DeviceConformance
from hal.deadline import in_seconds
from hal.errors import DeviceRefused, DeviceTimeout
from hal.interfaces import Display

Frames = dict[str, npt.NDArray[np.uint8]]


class DisplayConformance(DeviceConformance):
    """Run on every display driver; supply a fixture ``display``."""

    def frames(self, display: Display, value: int) -> Frames:
        outputs = display.outputs(deadline=self.soon())
        return {o.name: np.full((o.height_px, o.width_px, 3), value, dtype=np.uint8) for o in outputs}

    def test_says_who_it_is(self, display: Display) -> None:
        assert isinstance(display, Display)
        self.check_identity(display)

    def test_outputs_have_unlike_names_and_sizes(self, display: Display) -> None:
        outputs = display.outputs(deadline=self.soon())
        assert outputs
        assert len({output.name for output in outputs}) == len(outputs)
        assert all(output.name and output.width_px > 0 and output.height_px > 0 for output in outputs)

    def test_frames_are_presented_in_order(self, display: Display) -> None:
        before = time.monotonic()
        first = display.show(self.frames(display, 10), deadline=self.soon())
        second = display.show(self.frames(display, 200), deadline=self.soon())
        assert before <= first.at_s <= second.at_s <= time.monotonic()
        assert first.sequence < second.sequence

    def test_an_output_without_a_frame_is_allowed(self, display: Display) -> None:
        display.show({}, deadline=self.soon())

    def test_wrong_frames_are_refused_before_anything_is_shown(self, display: Display) -> None:
        shown = display.show(self.frames(display, 30), deadline=self.soon())
        name = display.outputs(deadline=self.soon())[0].name
        right = self.frames(display, 90)
        wrongs: tuple[Frames, ...] = (
            {**right, "no-such-output": right[name]},
            {**right, name: right[name][:-1]},
            {**right, name: right[name][:, :, :2]},
            {**right, name: right[name].astype(np.float32)},
        )
        for wrong in wrongs:
            with pytest.raises(DeviceRefused):
                display.show(wrong, deadline=self.soon())
        again = display.show(right, deadline=self.soon())
        assert again.sequence - shown.sequence <= 2, "a refused set counts as not shown"

    def test_an_unknown_appearance_is_refused(self, display: Display) -> None:
        with pytest.raises(DeviceRefused):
            display.play("there is no appearance of this name", deadline=self.soon())

    def test_keeps_deadlines_and_stops_when_cancelled(self, display: Display) -> None:
        with pytest.raises(DeviceTimeout):
            display.show(self.frames(display, 60), deadline=in_seconds(-1.0))
        self.check_deadline_and_cancel(display)

    def test_every_answer_and_error_is_of_its_type(self, display: Display) -> None:
        self.check_types(
            "display",
            display,
            lambda it: it.outputs(deadline=self.soon()),
            lambda it: it.show({}, deadline=self.soon()),
        )

    def test_closing_twice_is_harmless(self, display: Display) -> None:
        self.check_closes_twice(display)
