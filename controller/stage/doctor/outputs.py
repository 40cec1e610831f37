"""Finds which projector shows which output: numbers for people, white light and shutters for the camera.

One output at a time shows white. If the photograph goes dark when the projector named in stage.toml closes its
shutter, the cables are right; otherwise the other shutters show whose light it is. The lamps are switched on for this,
under the lamp rules, and off afterwards.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Protocol, runtime_checkable

import numpy as np

from controller.core.arrays import ByteImage
from controller.core.storage import exclusive
from controller.optics.capture.acquire import Shot
from controller.optics.capture.raw import is_jpeg, read_jpeg_values, read_samples
from controller.run.progress import Reporter
from controller.run.state_machine import Machine
from controller.stage.doctor.values import Examination
from controller.stage.rig.lamp_session import lit
from controller.stage.rig.power import light
from controller.stage.rig.rig import Rig, RigProjector
from controller.stage.sessions.check import Checked, check_stage
from controller.stage.sessions.open import opened_rig
from controller.stage.sessions.run import LOCK
from hal.deadline import Deadline, in_seconds
from hal.notices import Level, Notice
from hal.runtime.caches import temporary
from hal.values import Presented

LONGEST_S: Final = 3600.0
NUMBERS_S: Final = 10.0
"""How long the numbers are shown."""
ANSWER_S: Final = 10.0
LEAST_LIGHT: Final = 1e-4
"""Less light than this share of full scale is noise."""
DARKER: Final = 0.5
"""A shutter that removes more than this share blocks the light."""


@runtime_checkable
class _Identifies(Protocol):
    """A display that can show the number of each output."""

    def identify(self, *, deadline: Deadline) -> Presented: ...


@dataclass(frozen=True, slots=True)
class OutputOwner:
    """The projector that shows an output, or None if no shutter removed the light."""

    output: str
    projector: str | None


def examine_outputs(
    seen: Examination, *, stage: Path, reporter: Reporter, cancel: threading.Event, checked: Checked | None = None
) -> Examination:
    """Add to ``seen`` which projector shows each output. Strikes the lamps; raises what the session raises."""
    checked = checked or check_stage(stage)
    deadline = in_seconds(LONGEST_S, cancel)
    safety = checked.stage.tables.safety
    with (
        exclusive(stage / LOCK, what_is_running="Velatura"),
        opened_rig(checked, deadline=deadline) as rig,
        lit(rig, Machine(), power_down_s=safety.power_down_s, reporter=reporter),
    ):
        reporter.say("Switching the lamps on.")
        light(
            rig.guards,
            deadline=deadline.within(safety.power_up_s),
            advance=lambda fraction, note: None,
            tell=lambda sentence: reporter.say(sentence, Level.WARNING),
        )
        show_numbers(rig, reporter, deadline)
        with temporary() as folder:
            shown = who_shows_what(rig, folder, deadline=deadline)
    findings = judge(rig.projectors, shown)
    return replace(seen, findings=(*seen.findings, *findings))


def show_numbers(rig: Rig, reporter: Reporter, deadline: Deadline, seconds: float = NUMBERS_S) -> None:
    """Show numbers on the outputs, if the display can, and list the projector that should show each."""
    if not isinstance(rig.display, _Identifies):
        return
    numbers = {info.name: n for n, info in enumerate(rig.display.outputs(deadline=deadline.within(ANSWER_S)), 1)}
    rig.display.identify(deadline=deadline.within(ANSWER_S))
    for projector in rig.projectors:
        reporter.say(f"Projector {projector.name} should show the number {numbers[projector.output]}.")
    deadline.sleep(seconds)


def who_shows_what(rig: Rig, folder: Path, *, deadline: Deadline) -> list[OutputOwner]:
    """Light one output after the other, and find the shutter that removes the light."""
    look = _Camera(rig, folder, deadline)
    exposure_s = look.exposure_s()
    with_shutter = [projector for projector in rig.projectors if projector.guard.capabilities.shutter]
    shown = []
    for projector in rig.projectors:
        frames = rig.on_outputs({projector.name: projector.white()})
        bright = look.brightness(frames, exposure_s)
        # First the one in stage.toml: if the cables are right, one photograph per output is enough.
        suspects = sorted(with_shutter, key=lambda one: one is not projector)
        owner = next(
            (suspect.name for suspect in suspects if look.goes_dark(suspect, frames, bright, exposure_s)), None
        )
        shown.append(OutputOwner(projector.output, owner))
    return shown


def judge(projectors: Sequence[RigProjector], shown: Sequence[OutputOwner]) -> list[Notice]:
    """Problems with the cables, by output."""
    findings = []
    for projector, output in zip(projectors, shown, strict=True):
        if output.projector is None:
            what = f"The projector on output {output.output} could not be found: no shutter made the photograph darker."
            remedy = "Check that the lamp is on and the camera sees the picture, or compare the numbers yourself."
            findings.append(Notice.warning("output-unseen", what, remedy, about=output.output))
        elif output.projector != projector.name:
            what = f"Output {output.output} is shown by projector {output.projector}, not by {projector.name}."
            remedy = f'Swap the cables, or write output = "{output.output}" for {output.projector} into stage.toml.'
            findings.append(Notice.warning("output-swapped", what, remedy, about=output.output))
    return findings


class _Camera:
    """Photographs to measure total light."""

    def __init__(self, rig: Rig, folder: Path, deadline: Deadline) -> None:
        self._rig = rig
        self._folder = folder
        self._deadline = deadline
        self._taken = 0
        self._black: float | None = None

    def exposure_s(self) -> float:
        """Short enough for white on all outputs, so that no single output is clipped either."""
        frames = {p.output: p.white() for p in self._rig.projectors}
        for exposure_s in reversed(self._rig.acquirer.exposures_s()):
            if exposure_s <= 1.0 and self._values(frames, exposure_s)[1] < 0.01:
                return exposure_s
        return self._rig.acquirer.exposures_s()[0]

    def brightness(self, frames: Mapping[str, ByteImage], exposure_s: float) -> float:
        return self._values(frames, exposure_s)[0]

    def goes_dark(
        self, projector: RigProjector, frames: Mapping[str, ByteImage], bright: float, exposure_s: float
    ) -> bool:
        """Whether closing this projector's shutter removes the light; the shutter is always opened again."""
        with self._closed(projector):
            dark = self.brightness(frames, exposure_s)
        if self._black is None:
            self._black = self.brightness(self._rig.on_outputs({}), exposure_s)
        light_of_white = bright - self._black
        return light_of_white > LEAST_LIGHT and bright - dark > DARKER * light_of_white

    @contextlib.contextmanager
    def _closed(self, projector: RigProjector) -> Iterator[None]:
        guard = projector.guard
        guard.set_shutter(True, deadline=self._deadline.within(ANSWER_S))
        try:
            yield
        finally:
            guard.set_shutter(False, deadline=in_seconds(ANSWER_S))

    def _values(self, frames: Mapping[str, ByteImage], exposure_s: float) -> tuple[float, float]:
        """Mean of a photograph, 0 to 1, and its clipped share."""
        self._taken += 1
        shot = Shot(f"look-{self._taken}", dict(frames), exposure_s)
        file, _ = self._rig.acquirer.take(shot, self._folder, deadline=self._deadline)
        if is_jpeg(file.path):
            image = read_jpeg_values(file.path) / np.float32(255)
            return float(image.mean()), float((image >= 1).any(axis=2).mean())
        linear, clipped = read_samples(file.path)
        return float(linear.mean()), float(clipped.mean())
