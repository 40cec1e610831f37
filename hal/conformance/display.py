"""Tests for display drivers."""

from __future__ import annotations

import time
from pathlib import Path
from typing import ClassVar

import numpy as np
import numpy.typing as npt
import pytest

from hal.conformance.device import DeviceConformance
from hal.deadline import in_seconds
from hal.errors import DeviceError, DeviceRefused, DeviceTimeout, DriverFault
from hal.interfaces import BundleDisplay, Display

Frames = dict[str, npt.NDArray[np.uint8]]


class DisplayConformance(DeviceConformance):
    """Run on every display driver; supply a fixture ``display``."""

    kind = "display"
    interface = Display

    @pytest.fixture
    def device(self, display: Display) -> Display:
        return display

    def frames(self, display: Display, value: int) -> Frames:
        outputs = display.outputs(deadline=self.soon())
        return {o.name: np.full((o.height_px, o.width_px, 3), value, dtype=np.uint8) for o in outputs}

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

    def test_shows_no_frame_late(self, display: Display) -> None:
        with pytest.raises(DeviceTimeout):
            display.show(self.frames(display, 60), deadline=in_seconds(-1.0))

    def test_every_answer_and_error_is_of_its_type(self, display: Display) -> None:
        self.check_types(
            display, lambda it: it.outputs(deadline=self.soon()), lambda it: it.show({}, deadline=self.soon())
        )


class BundleDisplayConformance(DisplayConformance):
    """Run on every display that plays bundles; supply ``bundle`` beside ``display``.

    ``bundle``: (file, names of two of its appearances), made for the display's outputs and trusted by the display.
    """

    bundle_patience_s: ClassVar[float] = 30.0
    """Time for a sequence of four short items."""

    def test_a_bundle_is_loaded_and_its_appearances_are_shown_by_name(
        self, display: BundleDisplay, bundle: tuple[Path, tuple[str, str]]
    ) -> None:
        path, names = bundle
        identity = display.load_bundle(path, deadline=self.soon())
        assert identity == display.load_bundle(path, deadline=self.soon()), "one bundle has one identity"
        assert bytes.fromhex(identity)
        first, second = (display.play(name, deadline=self.soon()) for name in names)
        assert first.sequence < second.sequence
        assert first.at_s <= second.at_s
        status = display.playing(deadline=self.soon())
        assert (status.appearance, status.bundle) == (names[1], identity)
        assert status.presented_at_s >= second.at_s
        assert not status.running
        assert status.live is None

    def test_a_file_that_is_no_bundle_is_refused_and_the_old_one_stays(
        self, display: BundleDisplay, bundle: tuple[Path, tuple[str, str]], tmp_path: Path
    ) -> None:
        path, names = bundle
        identity = display.load_bundle(path, deadline=self.soon())
        (tmp_path / "cut.vel").write_bytes(path.read_bytes()[:100])
        for wrong in (tmp_path / "cut.vel", tmp_path / "missing.vel"):
            with pytest.raises(DeviceError) as caught:
                display.load_bundle(wrong, deadline=self.soon())
            assert not isinstance(caught.value, DriverFault)
        display.play(names[0], deadline=self.soon())
        assert display.playing(deadline=self.soon()).bundle == identity

    def test_a_sequence_shows_every_item_and_ends(
        self, display: BundleDisplay, bundle: tuple[Path, tuple[str, str]]
    ) -> None:
        path, names = bundle
        display.load_bundle(path, deadline=self.soon())
        before = display.playing(deadline=self.soon()).swaps
        display.play_sequence([(name, 0.05) for name in names], repeat=2, deadline=self.soon())
        ends = in_seconds(self.bundle_patience_s)
        while (status := display.playing(deadline=self.soon())).running:
            assert not ends.passed, "a sequence with repeat=2 ends"
            ends.sleep(0.02)
        assert status.swaps - before >= 4
        assert status.appearance == names[1], "the last item stays"

    def test_a_sequence_of_unknown_appearances_is_refused(
        self, display: BundleDisplay, bundle: tuple[Path, tuple[str, str]]
    ) -> None:
        path, names = bundle
        display.load_bundle(path, deadline=self.soon())
        with pytest.raises(DeviceRefused):
            display.play_sequence([(names[0], 0.05), ("there is no such appearance", 0.05)], deadline=self.soon())

    def test_stop_shows_black_and_ends_a_sequence(
        self, display: BundleDisplay, bundle: tuple[Path, tuple[str, str]]
    ) -> None:
        path, names = bundle
        display.load_bundle(path, deadline=self.soon())
        began = display.play_sequence([(name, 60.0) for name in names], deadline=self.soon())
        assert display.playing(deadline=self.soon()).running
        stopped = display.stop(deadline=self.soon())
        assert stopped.sequence > began.sequence
        status = display.playing(deadline=self.soon())
        assert not status.running
        assert status.appearance is None

    def test_a_live_source_that_does_not_exist_is_refused(self, display: BundleDisplay, tmp_path: Path) -> None:
        with pytest.raises(DeviceError) as caught:
            display.live(tmp_path / "no-such-source", deadline=self.soon())
        assert not isinstance(caught.value, DriverFault)
        assert display.playing(deadline=self.soon()).live is None
