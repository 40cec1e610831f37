"""Darkness as a condition of calibration: the room's light is in every photograph, and it changes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from controller.run.progress import Level
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from hal.deadline import Deadline
from hal.errors import DeviceRefused
from hal.interfaces import Display, LightSensor

ANSWER_S = 10.0


@dataclass(frozen=True, slots=True)
class Darkness:
    """A light sensor at the object, and the illuminance in lux above which nobody should calibrate."""

    sensor: LightSensor
    most_lux: float

    def require(self, *, deadline: Deadline) -> float:
        """The illuminance now. Raises DeviceRefused("room-not-dark"), and what the sensor raises."""
        lux = self.sensor.illuminance_lux(deadline=deadline.within(ANSWER_S))
        if lux > self.most_lux:
            raise DeviceRefused(
                "room-not-dark",
                what=f"There are {lux:.2f} lux at the object, and calibration needs at most {self.most_lux:g}.",
                remedy="Switch the lights off and close the blinds, or raise most_lux under [light_sensor].",
            )
        return lux

    def warning(self, *, deadline: Deadline) -> str | None:
        """What to tell the technician if it is no longer dark; None if it is."""
        try:
            self.require(deadline=deadline)
        except DeviceRefused as error:
            if error.code != "room-not-dark":
                raise
            return f"{error.what} What was just measured holds for this light only: calibrate again in the dark."
        return None


class LightWatch:
    """Tells the room's light from the projectors' own while something is played.

    The sensor stands at the object and sees both. What it saw least under one picture counts as that picture's own
    light; what comes on top of it is the room's. A room that was bright ever since is therefore not noticed before the
    picture changes; whoever calibrates is told by ``Darkness``.

    Parameters
    ----------
    most_lux : more than this on top of the picture's own light is told
    looks : so many in a row, so that nobody is told of a visitor's torch
    """

    def __init__(self, most_lux: float, *, looks: int = 2) -> None:
        self._most_lux, self._looks = most_lux, looks
        self._least: dict[str, float] = {}
        self._in_a_row = 0
        self._bright = False

    def saw(self, lux: float, scene: str | None) -> str | None:
        """What to tell people for as long as it holds; ``scene`` names what is shown, None: nothing that lasts."""
        if scene is None:
            self._in_a_row, self._bright = 0, False
            return None
        own = min(lux, self._least.get(scene, lux))
        self._least = {**dict(list(self._least.items())[-99:]), scene: own}
        room = lux - own
        # Half of it must be gone before all is well: light that flickers about the limit is told once.
        self._in_a_row = self._in_a_row + 1 if room > self._most_lux else 0
        self._bright = self._in_a_row >= self._looks or (self._bright and room > self._most_lux / 2)
        if not self._bright:
            return None
        return f"There is light in the room: {room:.1f} lux at the object that are not the projectors'."


def dark_before(darkness: Darkness | None) -> list[Step]:
    """The step that refuses a bright room, for before the lamps are struck: their light must not count."""
    if darkness is None:
        return []

    def look(context: Context) -> Sequence[Path]:
        lux = darkness.require(deadline=context.deadline)
        context.reporter.say(f"The room is dark: {lux:.2f} lux at the object.")
        return ()

    return [Step(StepId("dark-before"), look, title="Looking whether the room is dark", weight=0.1, always=True)]


def dark_after(darkness: Darkness | None, display: Display) -> list[Step]:
    """The step that warns of light that came on meanwhile; the projectors show black for it."""
    if darkness is None:
        return []

    def look(context: Context) -> Sequence[Path]:
        display.show({}, deadline=context.deadline.within(ANSWER_S))
        if (warning := darkness.warning(deadline=context.deadline)) is not None:
            context.reporter.say(warning, Level.WARNING)
        return ()

    return [Step(StepId("dark-after"), look, title="Looking whether the room stayed dark", weight=0.1)]
