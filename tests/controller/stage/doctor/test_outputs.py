"""Which projector shows which output, on a model room: light reaches the camera from lamps, cables and shutters."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pytest

from controller.optics.capture.acquire import Acquirer
from controller.stage.doctor.outputs import judge, show_numbers, who_shows_what
from controller.stage.rig.lamp_guard import LampGuard
from controller.stage.rig.rig import Rig, RigProjector
from hal.deadline import Deadline, in_seconds
from hal.values import CapturedFile, ExposureSettings, FileKind, Presented, ProjectorCapabilities
from tests.controller.stage.rig.lamp_model import RULES, Lamp, Shelf, World, soon
from tests.controller.stage.rig.rig_model import EXPOSURES_S, ModelCamera, ModelDisplay
from tests.controller.stage.sessions.run_models import Told

NAMES = ("left", "right")
SIZE_PX = (4, 3)
AMBIENT, BLACK, WHITE = 0.02, 0.01, 0.3


@dataclass
class Shuttered(Lamp):
    """A lamp with a shutter."""

    closed: bool = False

    @property
    def capabilities(self) -> ProjectorCapabilities:
        return ProjectorCapabilities(lamp_hours=False, shutter=True, inputs=(), errors=False, lamp_rules=RULES)

    def set_shutter(self, closed: bool, *, deadline: Deadline) -> None:
        self.closed = closed


@dataclass
class Room(ModelDisplay, ModelCamera):
    """Display and camera in one, because the light goes from one to the other. ``cables``: output -> projector."""

    cables: dict[str, str] = field(default_factory=lambda: {"P1": "left", "P2": "right"})
    lamps: dict[str, Shuttered] = field(default_factory=dict)
    identified: int = 0
    exposure_s: float = 1.0

    def identify(self, *, deadline: Deadline) -> Presented:
        self.identified += 1
        return Presented(0, 0.0)

    def configure(self, settings: ExposureSettings, *, deadline: Deadline) -> ExposureSettings:
        self.exposure_s = settings.exposure_s
        return settings

    def light(self) -> float:
        total = AMBIENT
        for output, name in self.cables.items():
            lamp = self.lamps[name]
            if lamp.lit_at_s is not None and not lamp.closed:
                frame = self.shown[-1].get(output)
                total += BLACK + (0.0 if frame is None else WHITE * float(frame.mean()) / 255)
        return total * self.exposure_s

    def capture(self, destination: Path, *, deadline: Deadline) -> list[CapturedFile]:
        value = min(255, round(255 * self.light()))
        done, data = cv2.imencode(".jpg", np.full((24, 32, 3), value, np.uint8))
        assert done
        path = destination.with_suffix(".jpg")
        path.write_bytes(data.tobytes())
        return [CapturedFile(path, FileKind.JPEG, len(data), hashlib.sha256(data.tobytes()).hexdigest())]


def hall(folder: Path, **options: object) -> tuple[Room, Rig]:
    world, room, shelf = World(), Room(), Shelf()
    room.lamps = {name: Shuttered(world) for name in NAMES}
    for key, value in options.items():
        setattr(room, key, value)
    guards = [LampGuard(name, room.lamps[name], shelf, clock=world) for name in NAMES]
    for guard in guards:
        guard.switch_on(deadline=soon())
    projectors = tuple(RigProjector(g.name, o, SIZE_PX, g) for g, o in zip(guards, ("P1", "P2"), strict=True))
    acquirer = Acquirer(room, room, iso=100, aperture_f=None, settle_s=0.0)
    return room, Rig(folder, projectors, room, room, acquirer)


def test_right_cables_are_no_problem(tmp_path: Path) -> None:
    room, rig = hall(tmp_path)
    shown = who_shows_what(rig, tmp_path, deadline=in_seconds(20))
    assert [(one.output, one.projector) for one in shown] == [("P1", "left"), ("P2", "right")]
    assert judge(rig.projectors, shown) == []
    assert not any(lamp.closed for lamp in room.lamps.values())
    assert room.exposure_s == max(EXPOSURES_S[:3])


def test_swapped_cables_are_named_on_both_outputs(tmp_path: Path) -> None:
    _, rig = hall(tmp_path, cables={"P1": "right", "P2": "left"})
    findings = judge(rig.projectors, who_shows_what(rig, tmp_path, deadline=in_seconds(20)))
    assert [one.code for one in findings] == ["output-swapped", "output-swapped"]
    assert "Output P1 is shown by projector right, not by left" in findings[0].what
    assert 'output = "P1" for right' in findings[0].remedy


def test_a_projector_that_shows_nothing_is_not_guessed(tmp_path: Path) -> None:
    room, rig = hall(tmp_path)
    room.lamps["right"].go_dark()
    findings = judge(rig.projectors, who_shows_what(rig, tmp_path, deadline=in_seconds(20)))
    assert [(one.about, one.code) for one in findings] == [("P2", "output-unseen")]


def test_a_shutter_is_opened_again_when_the_camera_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    room, rig = hall(tmp_path)
    once = room.capture

    def failing(destination: Path, *, deadline: Deadline) -> list[CapturedFile]:
        if any(lamp.closed for lamp in room.lamps.values()):
            raise RuntimeError("the camera died")
        return once(destination, deadline=deadline)

    monkeypatch.setattr(room, "capture", failing)
    with pytest.raises(RuntimeError):
        who_shows_what(rig, tmp_path, deadline=in_seconds(20))
    assert not any(lamp.closed for lamp in room.lamps.values())


def test_people_get_numbers_and_the_list_of_whose_they_are(tmp_path: Path) -> None:
    room, rig = hall(tmp_path)
    told = Told()
    show_numbers(rig, told, in_seconds(5), seconds=0.0)
    assert room.identified == 1
    assert [text for _, text in told.said] == [
        "Projector left should show the number 1.",
        "Projector right should show the number 2.",
    ]
