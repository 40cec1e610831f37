"""Several cameras at one display: each picture is shown once, and stays until all that need it have it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
import pytest

from controller.stage.rig.shared_display import Seat, SharedDisplay
from hal.deadline import Cancelled, Deadline, in_seconds
from hal.errors import DeviceTimeout
from tests.controller.stage.rig.rig_model import ModelDisplay

Frames = dict[str, npt.NDArray[np.uint8]]


def picture(value: int) -> Frames:
    return {"P1": np.full((3, 4, 3), value, np.uint8)}


def values(display: ModelDisplay) -> list[int]:
    return [int(frames["P1"][0, 0, 0]) for frames in display.shown]


class Views:
    """``count`` seats; each photographs a row of pictures in a thread, and notes what the display showed meanwhile."""

    def __init__(self, count: int) -> None:
        self.display = ModelDisplay()
        self.shared = SharedDisplay(self.display)
        self.seats = [self.shared.seat() for _ in range(count)]
        self.seen: list[list[int]] = [[] for _ in range(count)]
        self.numbers: list[list[int]] = [[] for _ in range(count)]

    def photograph(self, n: int, row: Sequence[int], each_s: float = 0.0) -> None:
        seat = self.seats[n]
        try:
            for value in row:
                self.numbers[n].append(seat.show(picture(value), deadline=in_seconds(20)).sequence)
                time.sleep(each_s)
                self.seen[n].append(values(self.display)[-1])
                seat.done()
        finally:
            seat.leave()

    def run(self, *work: Callable[[], None]) -> None:
        for seat in self.seats:
            seat.join()
        threads = [threading.Thread(target=one) for one in work]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(20)
            assert not thread.is_alive()


def test_a_picture_that_all_ask_for_is_shown_once() -> None:
    views, row = Views(3), [1, 2, 3, 4, 5]
    views.run(*(lambda n=n: views.photograph(n, row) for n in range(3)))
    assert views.seen == [row] * 3
    assert values(views.display) == row


def test_a_picture_stays_until_the_slowest_camera_has_it() -> None:
    views, row = Views(2), [1, 2, 3]
    views.run(lambda: views.photograph(0, row), lambda: views.photograph(1, row, each_s=0.03))
    assert views.seen == [row, row]
    assert values(views.display) == row


def test_more_exposures_of_one_picture_are_one_cameras_own() -> None:
    views = Views(2)
    views.run(lambda: views.photograph(0, [1, 1, 1, 2]), lambda: views.photograph(1, [1, 2, 2]))
    assert views.seen == [[1, 1, 1, 2], [1, 2, 2]]
    assert values(views.display) == [1, 2]


def test_a_picture_that_one_view_alone_needs_is_shown_for_it_and_the_rest_stays_common() -> None:
    views = Views(2)
    views.run(lambda: views.photograph(0, [1, 2, 3, 4, 5, 6]), lambda: views.photograph(1, [1, 9, 2, 3, 4, 5, 6]))
    assert views.seen == [[1, 2, 3, 4, 5, 6], [1, 9, 2, 3, 4, 5, 6]]
    # One picture is shown again at most, for the view that is behind.
    assert len(values(views.display)) <= 8


def test_a_picture_follows_the_one_before_only_where_nothing_else_was_shown_between() -> None:
    views = Views(2)
    views.run(lambda: views.photograph(0, [1, 2]), lambda: views.photograph(1, [1, 9, 8, 2]))
    first, second = views.numbers[0]
    shown = values(views.display)
    assert (second - first == 1) == (shown[shown.index(1) + 1] == 2)


def test_a_view_that_has_ended_keeps_no_picture() -> None:
    views = Views(2)

    def fails() -> None:
        views.seats[1].show(picture(1), deadline=in_seconds(20))
        views.seats[1].leave()

    views.run(lambda: views.photograph(0, [1, 2, 3]), fails)
    assert views.seen[0] == [1, 2, 3]


def test_alone_no_other_view_changes_the_picture() -> None:
    views = Views(2)
    begun = threading.Event()

    def measures() -> None:
        with views.seats[1].only(in_seconds(20)):
            begun.set()
            views.photograph(1, [7, 8, 7, 8], each_s=0.01)

    def waits() -> None:
        begun.wait(20)
        views.photograph(0, [1, 2])

    views.run(waits, measures)
    assert views.seen == [[1, 2], [7, 8, 7, 8]]
    assert values(views.display) == [7, 8, 7, 8, 1, 2]


def test_a_view_that_waits_can_be_stopped() -> None:
    views = Views(2)
    for seat in views.seats:
        seat.join()
    stop = threading.Event()
    stop.set()
    with pytest.raises(Cancelled):
        views.seats[0].show(picture(1), deadline=Deadline(time.monotonic() + 20, stop))


def test_a_view_waits_no_longer_than_it_may_for_one_that_photographs_or_measures() -> None:
    views = Views(2)
    slow, other = views.seats
    for seat in views.seats:
        seat.join()
    with slow.only(in_seconds(20)):
        with pytest.raises(DeviceTimeout) as alone, other.only(in_seconds(0.1)):
            pass
        slow.show(picture(1), deadline=in_seconds(20))
    with pytest.raises(DeviceTimeout) as photographing:
        other.show(picture(2), deadline=in_seconds(0.1))
    assert [alone.value.code, photographing.value.code] == ["views-too-slow"] * 2
    assert values(views.display) == [1]
    slow.leave()
    other.show(picture(2), deadline=in_seconds(20))
    assert values(views.display) == [1, 2], "a view that gave up keeps no picture"


def test_before_it_joins_a_seat_is_the_display_itself() -> None:
    display = ModelDisplay()
    seat: Seat = SharedDisplay(display).seat()
    assert [seat.show(picture(value), deadline=in_seconds(20)).sequence for value in (1, 1, 2)] == [1, 2, 3]
    assert values(display) == [1, 1, 2]
