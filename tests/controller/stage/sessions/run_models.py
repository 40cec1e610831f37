"""A stage whose drivers are models, for tests of what is done with devices during a run."""

from __future__ import annotations

import errno
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from controller.run.journal import Journal
from controller.run.progress import Progress
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.rig.rig import Rig
from controller.stage.sessions.check import check_stage
from controller.stage.sessions.session import OwnSession, StageWork
from hal.deadline import Deadline
from hal.errors import DeviceGone, PluginError
from hal.notices import Level, Notice
from hal.registry import Driver, Drivers, OpenContext
from hal.values import DeviceIdentity, LampRules, Power, ProjectorCapabilities, ProjectorStatus
from tests.controller.stage.rig.rig_model import ModelCamera, ModelDisplay

STAGE = """\
[stage]
name = "models"
[[projectors]]
name = "left"
output = "P1"
driver = "model"
port = "A"
[[projectors]]
name = "right"
output = "P2"
driver = "model"
port = "B"
[camera]
driver = "model"
iso = 100
focal_length_px = 500
[display]
driver = "model"
[safety]
power_down_s = 0.3
"""


class QuickLamp:
    """Lit and dark at once; ``stuck``: it can be lit and never goes out; ``unclosable``: closing it fails."""

    def __init__(self, *, stuck: bool = False, unclosable: bool = False) -> None:
        self.lit, self.stuck, self.open, self.unclosable = False, stuck, True, unclosable
        self.odd: Exception | None = None

    @property
    def capabilities(self) -> ProjectorCapabilities:
        return ProjectorCapabilities(False, False, (), False, LampRules(0.0, 0.0, 0.0, 0.0))

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        return DeviceIdentity("Model", "Lamp")

    def close(self) -> None:
        if self.unclosable:
            raise OSError(5, "Input/output error")
        self.open = False

    def status(self, *, deadline: Deadline) -> ProjectorStatus:
        if self.odd is not None:
            raise self.odd
        return ProjectorStatus(Power.ON if self.lit else Power.OFF)

    def switch_on(self, *, deadline: Deadline) -> None:
        self.lit = True

    def switch_off(self, *, deadline: Deadline) -> None:
        if self.stuck:
            raise DeviceGone("port-lost", what="The port went away.", remedy="Plug it in.")
        self.lit = False

    def set_shutter(self, closed: bool, *, deadline: Deadline) -> None:
        """It has none."""


class OddLamp(QuickLamp):
    """Its driver has something to tell."""

    untold: tuple[str, ...] = ()

    def notices(self) -> list[Notice]:
        told, self.untold = self.untold, ()
        return [Notice.warning("projector-answer-odd", text) for text in told]


class Told:
    """A reporter that remembers what was said, until its terminal is ``closed``."""

    def __init__(self) -> None:
        self.said: list[tuple[Level, str]] = []
        self.closed = False

    def progress(self, now: Progress) -> None:
        """Not of interest here."""

    def say(self, text: str, level: Level = Level.INFO) -> None:
        if self.closed:
            raise BrokenPipeError(errno.EPIPE, "Broken pipe")
        self.said.append((level, text))


class Models:
    """A stage folder, its drivers, and the devices that they opened."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.lamps: dict[str, QuickLamp] = {}
        self.stuck: set[str] = set()
        self.unclosable: set[str] = set()
        self.odd_in = ""
        self.camera_error: Exception | None = None
        self.told = Told()
        self.cancel = threading.Event()
        (folder / "stage.toml").write_text(STAGE)
        settings = {"port": "the port"}
        self.drivers = Drivers(
            (
                Driver("projector", "model", "A lamp.", self._lamp, settings, ("port",)),
                Driver("camera", "model", "A camera.", self._camera),
                Driver("display", "model", "A display.", lambda *_: ModelDisplay()),
            )
        )

    def _lamp(self, settings: Mapping[str, Any], context: OpenContext, deadline: Deadline) -> QuickLamp:
        if settings["port"] == "nowhere":
            raise PluginError("setting-wrong", what="The setting 'port' is 'nowhere'.", remedy="Correct it.")
        port = settings["port"]
        lamp = OddLamp(stuck=port in self.stuck, unclosable=port in self.unclosable)
        lamp.untold = (self.odd_in,) if self.odd_in and port == "A" else ()
        self.lamps[port] = lamp
        return lamp

    def _camera(self, settings: Mapping[str, Any], context: OpenContext, deadline: Deadline) -> ModelCamera:
        if self.camera_error is not None:
            raise self.camera_error
        return ModelCamera()

    def run(self, work: Callable[[Context], Sequence[Path]] = lambda context: (), name: str = "trial") -> Path:
        def steps(rig: Rig, run: Path) -> Sequence[Step]:
            assert run.parent == self.folder / "runs"
            return [Step(StepId("work"), work)]

        checked = check_stage(self.folder, drivers=self.drivers)
        return OwnSession(checked.stage.folder).run(
            checked, StageWork(name, steps), reporter=self.told, cancel=self.cancel
        )

    def states(self) -> list[str]:
        (run,) = (self.folder / "runs").iterdir()
        with Journal(run) as journal:
            return [event.text.split(" (")[0] for event in journal.events() if event.code == "state"]
