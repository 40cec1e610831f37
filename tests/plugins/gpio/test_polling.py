"""Keys on a chip without interrupts, whose lines are looked at again and again."""

from __future__ import annotations

import errno
import os
import time
from types import SimpleNamespace

import pytest
from gpiod.line import Value

from plugins.gpio.keys import Lines


class _Request:
    """Requested lines of such a chip; ``values``: what each has now; ``error``: what a look ends with, if not 0."""

    def __init__(self) -> None:
        self.values = {4: Value.INACTIVE, 7: Value.ACTIVE}
        self.looks = self.error = 0
        self.released = False

    def get_values(self, lines: list[int]) -> list[Value]:
        self.looks += 1
        if self.error:
            raise OSError(self.error, os.strerror(self.error))
        return [self.values[line] for line in lines]

    def release(self) -> None:
        self.released = True

    def wait_for_looks(self, count: int = 12) -> None:
        ends_s, until = time.monotonic() + 20, self.looks + count
        while self.looks < until:
            assert time.monotonic() < ends_s
            time.sleep(0.001)


def _opened(request: _Request, heard: list[int], **settings: float) -> Lines:
    chip = SimpleNamespace(get_info=lambda: SimpleNamespace(name="chip", label="label"), close=lambda: None)
    return Lines(chip, request, {4: 1, 7: 2}, heard.append, debounce_s=0.02, edges=False, **settings)


def test_a_press_is_told_once_and_a_key_that_was_held_before_is_not() -> None:
    heard: list[int] = []
    request = _Request()
    lines = _opened(request, heard)
    request.wait_for_looks()
    assert heard == []
    for value in (Value.ACTIVE, Value.INACTIVE) * 3:  # it bounces
        request.values[4] = value
        request.wait_for_looks(1)
    request.values[4] = Value.ACTIVE
    request.wait_for_looks(20)
    assert heard == [1]
    request.values[7] = Value.INACTIVE
    request.wait_for_looks(20)
    request.values[7] = Value.ACTIVE
    request.wait_for_looks(20)
    assert heard == [1, 2]
    lines.close()
    assert request.released


@pytest.mark.parametrize("error", [errno.EAGAIN, errno.ETIMEDOUT])
def test_a_chip_that_is_busy_for_some_looks_keeps_its_lines_and_a_press_meanwhile_is_told(error: int) -> None:
    heard: list[int] = []
    request = _Request()
    lines = _opened(request, heard)
    request.error = error
    request.wait_for_looks()
    request.values[4] = Value.ACTIVE
    request.wait_for_looks()
    lines.check()
    request.error = 0
    request.wait_for_looks(20)
    assert heard == [1]
    lines.check()
    assert not request.released
    lines.close()


def test_a_chip_is_lost_when_it_has_not_answered_for_long_and_not_before() -> None:
    request = _Request()
    lines = _opened(request, [], silent_s=0.3)
    for _ in range(6):
        time.sleep(0.1)
        request.wait_for_looks(1)
        lines.check()
    request.error = errno.EAGAIN
    time.sleep(0.5)
    with pytest.raises(TimeoutError):
        lines.check()
    lines.close()


def test_a_chip_that_was_unplugged_is_lost_at_once() -> None:
    request = _Request()
    lines = _opened(request, [])
    request.error = errno.ENODEV
    ends_s = time.monotonic() + 20
    while not request.released:
        assert time.monotonic() < ends_s
        time.sleep(0.001)
    with pytest.raises(OSError, match="No such device"):
        lines.check()
