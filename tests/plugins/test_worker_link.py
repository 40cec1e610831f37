"""Calls of a library that may hang: what becomes of those that wait when the device is closed."""

from __future__ import annotations

import threading

import pytest

from hal.deadline import Cancelled, Deadline, in_seconds
from hal.errors import DeviceGone, DeviceTimeout, ProtocolError
from plugins.worker_link import NotOpened, WorkerLink


class Broken(Exception):
    """What a library raises."""


class Board(WorkerLink[int]):
    """Opens numbers; ``fails``: so many openings break; ``refuses``: so many are refused."""

    def __init__(self, *, refuses: int = 0) -> None:
        super().__init__("board", broken=(Broken,))
        self.opened = 0
        self.let_gone = 0
        self.fails = 0
        self.refuses = refuses
        self.gone = False

    def find(self) -> int:
        if self.gone:
            raise DeviceGone("hid-unplugged", what="It was pulled.", remedy="Plug it in.")
        if self.refuses:
            self.refuses -= 1
            raise NotOpened("hid-not-opened", what="It is not to be opened.", remedy="Unplug it.")
        if self.fails:
            self.fails -= 1
            raise Broken
        self.opened += 1
        return self.opened

    def let_go(self, opened: int) -> None:
        self.let_gone += 1


class Doing(threading.Event):
    """A cancellation that no one asks for: does ``work`` when it is looked at the ``turn``-th time."""

    def __init__(self, turn: int, work: threading.Thread) -> None:
        super().__init__()
        self.left, self.work = turn, work

    def is_set(self) -> bool:
        self.left -= 1
        if self.left == 0:
            self.work.start()
            self.work.join()
        return super().is_set()


def test_what_waits_for_a_call_that_was_left_behind_is_not_done_after_the_closing() -> None:
    board, go, moved = Board(), threading.Event(), threading.Event()
    with pytest.raises(DeviceTimeout):
        board.call(lambda opened: go.wait(30), deadline=in_seconds(0.02))

    def close() -> None:
        board.close()
        go.set()

    # looked at before the wait begins, then in it
    closing = Doing(2, threading.Thread(target=close))
    with pytest.raises(DeviceGone) as caught:
        board.call(lambda opened: moved.set(), deadline=Deadline(in_seconds(30).at_s, closing))
    assert closing.left <= 0
    assert caught.value.code == "hid-closed"
    assert not moved.is_set()
    assert (board.opened, board.let_gone) == (1, 1)


def test_a_device_that_breaks_while_it_is_opened_is_opened_once_more() -> None:
    board = Board()
    board.fails = 1
    assert board.call(lambda opened: opened, deadline=in_seconds(30)) == 1
    board.close()


def test_a_device_that_breaks_at_each_opening_is_told_in_our_words() -> None:
    board = Board()
    board.fails = 2
    with pytest.raises(ProtocolError) as caught:
        board.call(lambda opened: opened, deadline=in_seconds(30))
    assert caught.value.code == "hid-transfer"
    board.close()


def test_a_device_that_is_pulled_while_it_is_used_for_the_second_time_is_gone() -> None:
    board = Board()

    def pulled(opened: int) -> None:
        board.gone = board.opened == 2
        raise Broken

    with pytest.raises(DeviceGone):
        board.call(pulled, deadline=in_seconds(30))
    board.gone = False
    assert board.call(lambda opened: opened, deadline=in_seconds(30)) == 3
    board.close()


def test_a_device_that_breaks_at_each_use_is_told_in_our_words() -> None:
    board = Board()

    def broken(opened: int) -> None:
        raise Broken

    with pytest.raises(ProtocolError) as caught:
        board.call(broken, deadline=in_seconds(30))
    assert caught.value.code == "hid-transfer"
    board.close()
    assert board.let_gone == board.opened


def test_a_device_that_cannot_be_opened_yet_is_tried_for_a_while() -> None:
    board = Board()
    board.refuses = 3
    assert board.call(lambda opened: opened, deadline=in_seconds(30)) == 1
    board.refuses = 1_000_000
    board.call(lambda opened: None, deadline=in_seconds(30))
    with pytest.raises(NotOpened):
        Board(refuses=1_000_000).call(lambda opened: None, deadline=in_seconds(2))
    board.close()


def test_a_call_after_the_closing_is_refused_at_once_though_another_hangs() -> None:
    board, go = Board(), threading.Event()
    with pytest.raises(DeviceTimeout):
        board.call(lambda opened: go.wait(30), deadline=in_seconds(0.02))
    board.close()
    with pytest.raises(DeviceGone):
        board.call(lambda opened: None, deadline=in_seconds(30))
    go.set()


def test_a_call_that_was_cancelled_before_opens_nothing() -> None:
    board, cancelled = Board(), threading.Event()
    cancelled.set()
    with pytest.raises(Cancelled):
        board.call(lambda opened: None, deadline=in_seconds(30, cancelled))
    board.close()
    assert board.opened == 0
