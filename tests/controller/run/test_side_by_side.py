"""Work on several projectors at once: in order, as memory allows, and an error ends it. A calculation beside it."""

from __future__ import annotations

import threading
import time

import pytest

from controller.run.background import beside, side_by_side, threads_at_once

LITTLE, ALL = 1, 1 << 60


def test_results_come_in_order_though_the_first_takes_longest() -> None:
    def work(n: int) -> int:
        time.sleep(0.05 * (3 - n))
        return n * n

    assert list(side_by_side(work, 4, bytes_each=LITTLE)) == [0, 1, 4, 9]
    assert list(side_by_side(work, 0, bytes_each=LITTLE)) == []


@pytest.mark.parametrize("bytes_each", [LITTLE, ALL])
def test_no_more_at_once_than_memory_allows(bytes_each: int) -> None:
    running, most, lock = 0, 0, threading.Lock()

    def work(n: int) -> None:
        nonlocal running, most
        with lock:
            running += 1
            most = max(most, running)
        time.sleep(0.05)
        with lock:
            running -= 1

    list(side_by_side(work, 4, bytes_each=bytes_each))
    assert most == min(4, threads_at_once(bytes_each))
    assert threads_at_once(ALL) == 1


@pytest.mark.parametrize("bytes_each", [LITTLE, ALL])
def test_an_error_comes_through_and_the_rest_is_left(bytes_each: int) -> None:
    begun: list[int] = []

    def work(n: int) -> int:
        begun.append(n)
        if n == 1:
            raise ZeroDivisionError
        time.sleep(0.02)
        return n

    results = side_by_side(work, 50, bytes_each=bytes_each)
    with pytest.raises(ZeroDivisionError):
        list(results)
    assert len(begun) < 50


def test_a_calculation_runs_while_other_work_is_done() -> None:
    begun, photographed = threading.Event(), threading.Event()

    def calculation() -> int:
        begun.set()
        assert photographed.wait(10)
        return 7

    def photograph() -> None:
        assert begun.wait(10)
        photographed.set()

    assert beside(calculation, photograph) == 7


def test_an_error_of_the_other_work_does_not_wait_for_the_calculation() -> None:
    ended = threading.Event()

    def photograph() -> None:
        raise ZeroDivisionError

    try:
        with pytest.raises(ZeroDivisionError):
            beside(lambda: ended.wait(60), photograph)
        assert not ended.is_set()
    finally:
        ended.set()


def test_an_error_of_the_calculation_comes_once_the_other_work_is_done() -> None:
    done: list[str] = []

    def calculation() -> int:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        beside(calculation, lambda: done.append("photograph"))
    assert done == ["photograph"]
