"""Checks that the room is dark for calibration, because room light is in every photograph and changes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from hal.deadline import Deadline
from hal.errors import DeviceRefused
from hal.interfaces import Display, LightSensor
from hal.notices import Level

ANSWER_S = 10.0


@dataclass(frozen=True, slots=True)
class AmbientLightLimit:
    """A light sensor at the object, and the maximum illuminance in lux for a calibration."""

    sensor: LightSensor
    most_lux: float

    def require(self, *, deadline: Deadline) -> float:
        """The illuminance now. Raises DeviceRefused("room-not-dark"), and what the sensor raises."""
        lux = self.sensor.illuminance_lux(deadline=deadline.within(ANSWER_S))
        if lux > self.most_lux:
            raise DeviceRefused(
                "room-not-dark",
                what=f"The light at the object is {lux:.2f} lux. Calibration needs at most {self.most_lux:g} lux.",
                remedy="Switch off the lights and close the blinds, or increase most_lux under [light_sensor].",
            )
        return lux

    def warning(self, *, deadline: Deadline) -> str | None:
        """A warning for the technician if it is no longer dark; None if it is."""
        try:
            self.require(deadline=deadline)
        except DeviceRefused as error:
            if error.code != "room-not-dark":
                raise
            return f"{error.what} The last measurements are valid only in this light: calibrate again in the dark."
        return None


class LightWatch:
    """Separates room light from the projectors' light while something is played.

    The sensor at the object measures both. The minimum during one picture counts as that picture's own
    light; anything above it is room light. Constant room light is therefore noticed only when the
    picture changes; for calibrations, ``AmbientLightLimit`` checks it.

    Parameters
    ----------
    most_lux : warn above this much room light
    readings : so many readings in a row, so that a visitor's torch causes no warning
    """

    def __init__(self, most_lux: float, *, readings: int = 2) -> None:
        self._most_lux, self._readings = most_lux, readings
        self._least: dict[str, float] = {}
        self._in_a_row = 0
        self._bright = False

    def observe(self, lux: float, scene: str | None) -> str | None:
        """A warning while there is room light; ``scene`` names the picture shown, None: none that stays."""
        if scene is None:
            self._in_a_row, self._bright = 0, False
            return None
        own = min(lux, self._least.get(scene, lux))
        self._least = {**dict(list(self._least.items())[-99:]), scene: own}
        room = lux - own
        # The warning ends only below half the limit, so that light around the limit causes one warning.
        self._in_a_row = self._in_a_row + 1 if room > self._most_lux else 0
        self._bright = self._in_a_row >= self._readings or (self._bright and room > self._most_lux / 2)
        if not self._bright:
            return None
        return f"The room is not dark: {room:.1f} lux at the object do not come from the projectors."


def dark_before(ambient_limit: AmbientLightLimit | None) -> list[Step]:
    """The step that refuses a bright room; it runs before the lamps are struck, so that their light does not count."""
    if ambient_limit is None:
        return []

    def check(context: Context) -> Sequence[Path]:
        lux = ambient_limit.require(deadline=context.deadline)
        context.reporter.say(f"The room is dark: {lux:.2f} lux at the object.")
        return ()

    return [Step(StepId("dark-before"), check, title="Checking that the room is dark", weight=0.1, always=True)]


def dark_after(ambient_limit: AmbientLightLimit | None, display: Display) -> list[Step]:
    """The step that warns of light switched on meanwhile; the projectors show black for it."""
    if ambient_limit is None:
        return []

    def check(context: Context) -> Sequence[Path]:
        display.show({}, deadline=context.deadline.within(ANSWER_S))
        if (warning := ambient_limit.warning(deadline=context.deadline)) is not None:
            context.reporter.say(warning, Level.WARNING)
        return ()

    return [Step(StepId("dark-after"), check, title="Checking that the room stayed dark", weight=0.1)]
