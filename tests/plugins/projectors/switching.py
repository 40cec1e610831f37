"""What projectors on a serial line and on a LAN port must do alike; ``pair``: a driver and its emulator."""

from __future__ import annotations

from typing import Any

from hal.deadline import in_seconds
from hal.values import Power, ProjectorStatus
from tests.plugins.conftest import wait_for_power

SOON = 30.0


def status(pair: Any) -> ProjectorStatus:
    return pair.driver.status(deadline=in_seconds(SOON))  # type: ignore[no-any-return]


def switches_without_hours(pair: Any) -> None:
    pair.driver.switch_on(deadline=in_seconds(SOON))
    wait_for_power(pair.driver, Power.ON)
    assert status(pair).lamp_hours is None
    pair.driver.switch_off(deadline=in_seconds(SOON))
    assert status(pair).power in (Power.COOLING, Power.OFF)
    assert pair.emulator.lamp.strikes == 1


def strikes_once_when_its_second_answer_is_lost(pair: Any) -> None:
    lose = pair.emulator.faults.loses_this_one
    answers: list[bool] = []

    def lose_the_second() -> bool:
        answers.append(len(answers) == 1)
        return answers[-1] or lose()

    pair.emulator.faults.loses_this_one = lose_the_second
    pair.driver.switch_on(deadline=in_seconds(SOON))
    assert pair.emulator.lamp.strikes == 1
    wait_for_power(pair.driver, Power.ON)
