"""Keys on a chip without interrupts, whose lines are looked at again and again."""

from __future__ import annotations

import time
from types import SimpleNamespace

from gpiod.line import Value

from plugins.gpio.lines import Lines


class _Request:
    """Requested lines of such a chip; ``values``: what each has now."""

    def __init__(self) -> None:
        self.values = {4: Value.INACTIVE, 7: Value.ACTIVE}
        self.looks = 0
        self.released = False

    def get_values(self, lines: list[int]) -> list[Value]:
        self.looks += 1
        return [self.values[line] for line in lines]

    def release(self) -> None:
        self.released = True

    def wait_for_looks(self, count: int = 12) -> None:
        ends_s, until = time.monotonic() + 20, self.looks + count
        while self.looks < until:
            assert time.monotonic() < ends_s
            time.sleep(0.001)


def test_a_press_is_told_once_and_a_key_that_was_held_before_is_not() -> None:
    heard: list[int] = []
    request = _Request()
    chip = SimpleNamespace(get_info=lambda: SimpleNamespace(name="chip", label="label"), close=lambda: None)
    lines = Lines(chip, request, {4: 1, 7: 2}, heard.append, debounce_s=0.02, edges=False)
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
