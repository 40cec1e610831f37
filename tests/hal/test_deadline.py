"""Taking turns at a device: one caller at a time, none waits longer than it may, a cancelled one not at all."""

from __future__ import annotations

import threading
import time
from functools import partial

import pytest

from hal.deadline import Cancelled, Deadline, in_seconds, turn
from hal.errors import DeviceTimeout


def check(deadline: Deadline) -> None:
    deadline.check("device-busy", what="Others have the device.", remedy="Try again later.")


def test_one_caller_at_a_time_has_it() -> None:
    lock, inside, most = threading.Lock(), [0], [0]

    def call() -> None:
        deadline = in_seconds(30)
        for _ in range(20):
            with turn(lock, deadline, partial(check, deadline)):
                inside[0] += 1
                most[0] = max(most[0], inside[0])
                time.sleep(0.001)
                inside[0] -= 1

    threads = [threading.Thread(target=call) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (inside, most) == ([0], [1])


def test_a_caller_whose_time_is_over_is_told_and_the_lock_stays_with_the_other() -> None:
    lock, deadline = threading.Lock(), in_seconds(0.12)
    with lock, pytest.raises(DeviceTimeout) as told, turn(lock, deadline, partial(check, deadline)):
        raise AssertionError("it was not its turn")
    assert told.value.code == "device-busy"
    assert deadline.passed
    assert lock.acquire(blocking=False)


def test_a_cancelled_caller_does_not_wait() -> None:
    lock, cancel = threading.Lock(), threading.Event()
    deadline = in_seconds(60, cancel)
    began_s = time.monotonic()
    threading.Timer(0.1, cancel.set).start()
    with lock, pytest.raises(Cancelled), turn(lock, deadline, partial(check, deadline)):
        raise AssertionError("it was not its turn")
    assert time.monotonic() - began_s < 30


def test_a_call_that_fails_lets_the_next_one_in() -> None:
    lock = threading.Lock()
    with pytest.raises(ZeroDivisionError), turn(lock, in_seconds(1), lambda: None):
        raise ZeroDivisionError
    assert not lock.locked()


def test_a_free_lock_is_had_at_once_whatever_time_is_left() -> None:
    lock, deadline = threading.Lock(), in_seconds(0)
    with turn(lock, deadline, partial(check, deadline)):
        assert lock.locked()
