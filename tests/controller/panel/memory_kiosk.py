"""A kiosk in memory, without devices: the panel can be driven to its ends.

It keeps the contract of tests/controller/kiosk/contract.py, as the real one does.
"""

from __future__ import annotations

import hashlib
import io
import itertools
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from PIL import Image

from controller.core.errors import UsageError, WorkError
from controller.kiosk.schedule import check
from controller.kiosk.state import DriftCheck, EventLevel, Grade, Job
from controller.kiosk.store import settings, targets
from controller.kiosk.values import (
    Achieved,
    Aiming,
    Appearance,
    Changes,
    Comparison,
    Computed,
    Fit,
    FoundDevice,
    LaidMesh,
    LampDay,
    Reach,
    RecalibrationKind,
    Results,
    Scene,
    Schedule,
    ScheduleRow,
    TriedDevice,
)
from controller.stage.blender.job import BUILTIN
from hal.notices import Notice
from tests.controller.kiosk.vase import TEXT
from tests.controller.panel import example_values as examples
from tests.controller.panel.example_values import BORN, OUTPUTS
from tests.controller.panel.memory_work import MemoryWork

TOML = TEXT.replace("The vase", "Head of a boy")


class MemoryKiosk(MemoryWork):
    """``step_s`` how long a step of a job takes. ``pictures`` a folder for what it draws. ``names``: its appearances,
    of which it plays the first; ``run``: the finished calibration; ``toml``: stage.toml.
    """

    def __init__(
        self, pictures: Path, *, step_s: float = 0.05, names: Sequence[str] = ("marble", "warm wood"),
        run: str = "first", toml: str = TOML,
    ) -> None:  # fmt: skip
        super().__init__(step_s, examples.state(names[0]))
        self.laid = ""
        self._folder, self._before = pictures, names[0]
        pictures.mkdir(parents=True, exist_ok=True)
        # Requests draw side by side, each into a file of its own.
        self._drawings = itertools.count()
        self._schedule = Schedule("Europe/Vienna", (ScheduleRow("mon", "10:00", "18:00", names[0]),), "03:00")
        self._toml = toml
        self.asked: list[tuple[str, object]] = []
        self.recorded: list[tuple[str, str]] = []
        self.others: dict[str, str] = {}
        self.effect = ""
        self._appearances = {
            name: Appearance(name, BORN, 1.2, name == names[0], self._drawn(name), OUTPUTS, "picture") for name in names
        }
        self._results: dict[str, Results] = {}
        self._comparisons: dict[str, Comparison] = {}
        self.change(
            dose_klx_h=12.34,
            drifts=tuple(DriftCheck(f"night-{n}", BORN - n * 86400, "nothing", 0.04 + 0.01 * n) for n in range(5)),
        )
        self._finish(run, "full")
        for number in range(12):
            self.note("info", f"Heartbeat {number}: all projectors answer.")
        self.note("warning", "The projector right was struck twice.", "lamp-struck")
        self.note("error", "The projector right does not answer.", "projector-no-answer")

    def _drawn(self, name: str, shade: int = 120) -> Path:
        file = self._folder / f"{next(self._drawings)}.png"
        examples.draw_ball(file, name, shade)
        return file

    def recalibrate(self, kind: RecalibrationKind, projector: str | None = None) -> Job:
        if projector is not None and projector not in [
            row.name for row in examples.devices() if row.kind == "projector"
        ]:
            raise UsageError("projector-unknown", what=f"There is no projector {projector}.", remedy="Choose another.")
        return self._begin(f"Recalibration ({kind})", "calibrating", lambda run: self._finish(run, kind))

    def _finish(self, run: str, kind: str) -> None:
        grade = Grade(run, BORN + len(self._results) * 86400, kind, "A", True, 1.23, "", 0.9 + 0.1 * len(self._results))
        names = ("before", "target", "achieved", "error", "resolution")
        pictures = {name: self._drawn(name, 60 + 30 * at) for at, name in enumerate(names)}
        self._results[run] = Results(run, grade, pictures, (("Reprojection", "0.08 px"), ("Photographs", "35")))
        self.change(grades=(*self._state.grades, grade))

    def play(self, name: str, fade_s: float | None = None) -> None:
        self._known(name)
        self.asked.append(("play", (name, fade_s)))
        self._show(name)
        self.change(in_turn=False, paused=False)

    def _show(self, name: str) -> None:
        self._appearances = {key: replace(one, playing=key == name) for key, one in self._appearances.items()}
        made = self._state.made if self._state.made != name else ""
        self.change(playing=name, state="playing", reason="Playing as asked.", black=False, made=made)

    def _require_open(self) -> None:
        if self._state.state in ("off", "cooling"):
            raise WorkError("nothing-plays", what="The stage is closed.", remedy="Open the stage first.")

    def next(self, fade_s: float | None = None) -> None:
        self._require_open()
        names = list(self._appearances)
        playing = self._before if self._state.black else self._state.playing
        self._show(names[(names.index(playing) + 1) % len(names) if playing in names else 0])

    def black(self, on: bool, fade_s: float | None = None) -> None:
        if on:
            self._require_open()
            self._before = self._state.playing or self._before
        if on != self._state.black:
            self.change(black=on, playing="" if on else self._before)

    def pause(self, on: bool) -> None:
        self._require_open()
        self.change(paused=on)

    def brightness(self, percent: float) -> None:
        self._require_open()
        self.change(brightness=percent)

    def rotate(self) -> None:
        self._show(self._state.playing or self._before)
        self.change(in_turn=True, paused=False)

    def record(self, code: str, what: str, level: EventLevel = "info") -> None:
        self.recorded.append((code, what))

    def warn(self, about: str, what: str) -> None:
        self.others[about] = what
        self.change(warnings=tuple(filter(None, self.others.values())))

    def test_alerts(self) -> None:
        raise UsageError("alerts-none", what="stage.toml names no receiver of alerts.", remedy="Name somebody.")

    def effect_of_settings(self, text: str) -> str:
        self.validate_settings(text)
        return self.effect

    def _known(self, name: str) -> Appearance:
        if name not in self._appearances:
            raise UsageError("appearance-unknown", what="There is no such appearance.", remedy="Choose another.")
        return self._appearances[name]

    def stop(self) -> None:
        self.change(state="cooling", reason="The stage was closed by hand.", playing="", black=False, paused=False,
                    brightness=100.0)  # fmt: skip

    def start(self) -> None:
        self.change(state="powering", reason="The stage was opened by hand.")

    def view_px(self) -> tuple[int, int] | None:
        return 240, 160

    def fitted(self, target: Path, fit: Fit = "fit", points: str = "") -> bytes:
        if points:
            self.asked.append(("points", points))
        return targets.fitted(target.read_bytes(), (240, 160), fit if fit in ("fit", "fill", "crop") else "stretch")

    def compute(self, name: str, target: Path, fit: Fit = "fit") -> Job:
        settings.check_name(name)
        self.fitted(target, fit)
        self.asked.append(("compute", (name, target.read_bytes()[:4])))
        return self._solve(name)

    def _solve(self, name: str) -> Job:
        preview = self._drawn(name)

        def finish(_: str) -> None:
            self._appearances[name] = Appearance(name, time.time(), 1.0, preview=preview, outputs=OUTPUTS)
            bundle = self._state.bundle
            assert bundle is not None
            digest = hashlib.sha256(bundle.digest.encode()).hexdigest()
            self.change(made=name, bundle=replace(bundle, version=bundle.version + 1, digest=digest))

        return self._begin(f"New appearance {name}", "solving", finish, appearance=name)

    def reach(self, target: Path) -> Reach:
        pictures = {name: self._drawn(name, 200 - 60 * at) for at, name in enumerate(("target", "result", "map"))}
        return Reach(0.45, 0.3, 0.15, 0.05, pictures, held_back=1.23)

    def computed(self, target: Path) -> Computed:
        return Computed(0.9, 4.1, 0.5, 0.45, 0.4, "processor", {"result": self._drawn("computed", 120)})

    def scenes(self) -> Sequence[Scene]:
        shipped = [Scene(name, True, self._drawn(name)) for name in BUILTIN]
        return [*shipped, Scene("leaves.blend", False)]

    def scene_reach(self, scene: str) -> Reach:
        self._known_scene(scene)
        return self.reach(self._folder)

    def _known_scene(self, scene: str) -> None:
        if scene not in [one.name for one in self.scenes()]:
            raise UsageError("scene-unknown", what="There is no such scene.", remedy="Choose another.")

    def compute_scene(self, name: str, scene: str) -> Job:
        settings.check_name(name)
        self._known_scene(scene)
        self.asked.append(("compute-scene", (name, scene)))
        return self._solve(name)

    def meshes(self) -> Sequence[str]:
        return ["bust.glb"]

    def mesh_picture(self, mesh: str, side: int) -> Path:
        self._known_mesh(mesh)
        return self._drawn(f"{mesh}-{side}")

    def lay_mesh(self, mesh: str, side: int, points: str = "") -> None:
        self._known_mesh(mesh)
        self.asked.append(("lay-mesh", (mesh, side, points)))
        self.laid = mesh

    def laid_mesh(self) -> LaidMesh | None:
        pictures = {name: self._drawn(name) for name in ("laid", "map")}
        size = "in mm, 1.02 times as large as the object"
        return LaidMesh(self.laid, 0.12, 0.4, size, pictures) if self.laid else None

    def _known_mesh(self, mesh: str) -> None:
        if mesh not in self.meshes():
            raise UsageError("mesh-unknown", what="There is no such mesh.", remedy="Choose another.")

    def appearances(self) -> Sequence[Appearance]:
        return list(self._appearances.values())

    def projector_picture(self, name: str, projector: str) -> Path | None:
        self._known(name)
        return self._drawn(projector, 90) if projector in OUTPUTS else None

    def view(self) -> Path:
        return self._drawn("view", 255)

    def photograph(self) -> bytes | None:
        job = self._state.job
        return None if job is None or job.ended else self.camera_picture()

    def compare(self, name: str | None = None) -> Job:
        names = [self._known(name).name] if name is not None else list(self._appearances)

        def finish(run: str) -> None:
            for one in names:
                before = self._comparisons[one].history if one in self._comparisons else ()
                now = Achieved(
                    run, BORN + 86400 * len(before), 1.25 + len(before), 3.5, 0.012, 0.81, 0.66, 0.45, 0.41, 1.23
                )
                kinds = ("before", "target", "achieved", "error", "resolution")
                pictures = {kind: self._drawn(kind, 60 + 30 * at) for at, kind in enumerate(kinds)}
                self._comparisons[one] = Comparison(one, (now, *before), pictures)
                self._appearances[one] = replace(self._appearances[one], delta_e=now.delta_e)

        return self._begin("Photographs", "calibrating", finish)

    def comparisons(self) -> Sequence[Comparison]:
        return [self._comparisons[name] for name in self._appearances if name in self._comparisons]

    def remove_appearance(self, name: str) -> None:
        if name == self._state.playing or name in [row.appearance for row in self._schedule.rows]:
            raise UsageError("appearance-in-use", what="It is playing, or scheduled.", remedy="Play another one.")
        self._check_idle()
        self._known(name)
        del self._appearances[name]

    def lamp_history(self) -> Sequence[LampDay]:
        return examples.lamp_history()

    def schedule(self) -> Schedule:
        return self._schedule

    def effect_of_schedule(self, schedule: Schedule) -> str:
        check(schedule, list(self._appearances))
        return self.effect

    def set_schedule(self, schedule: Schedule) -> None:
        check(schedule, list(self._appearances))
        self._schedule = schedule
        self.change()

    def identify(self, on: bool) -> None:
        self.change(identifying=on)

    def seen(self, number: int | None = None) -> None:
        self.change(failures=tuple(row for row in self._state.failures if number is not None and row.number > number))

    def doctor(self) -> Sequence[Notice]:
        return examples.findings()

    def backup(self, *, photographs: bool = False) -> Path:
        file = self._folder.parent / "backup.velatura"
        file.write_bytes(b"a backup\n" + self._toml.encode())
        return file

    def restore(self, backup: Path) -> None:
        self._check_idle()
        head, _, text = backup.read_bytes().partition(b"\n")
        if head != b"a backup":
            raise UsageError("not-a-backup", what="This file is not a backup.", remedy="Choose another file.")
        self._toml = text.decode()

    def diagnostics(self) -> Path:
        file = self._folder.parent / "diagnostics.zip"
        file.write_bytes(b"diagnostics")
        return file

    def test_backup(self) -> None:
        raise UsageError("backup-nowhere", what="stage.toml names no place for backups.", remedy="Add one.")

    def changes(self) -> Changes:
        return examples.changes()

    def settings(self) -> str:
        return self._toml

    def validate_settings(self, text: str) -> None:
        settings.validate(text)

    def save_settings(self, text: str) -> None:
        self._check_idle()
        self.validate_settings(text)
        self._toml = text
        self.change(needs_setup=False)

    def camera_picture(self) -> bytes | None:
        out = io.BytesIO()
        Image.radial_gradient("L").resize((480, 320)).save(out, "JPEG")
        return out.getvalue()

    def runs(self) -> Sequence[str]:
        return list(self._results)[::-1]

    def results(self, run: str) -> Results:
        if run not in self._results:
            raise UsageError("run-unknown", what="There is no such run.", remedy="Choose another.")
        return self._results[run]

    def report(self, run: str) -> Path:
        self.results(run)
        file = self._folder.parent / "report.html"
        file.write_text("<!doctype html><title>A report</title>")
        return file

    def aiming(self) -> Aiming:
        return examples.aiming(self._drawn("aiming"))

    def test_shots(self) -> Job:
        return self._begin("Test shots", "calibrating", lambda run: None)

    def find_devices(self) -> Sequence[FoundDevice]:
        return examples.found_devices()

    def try_device(self, key: str) -> TriedDevice:
        if key not in [one.key for one in self.find_devices()]:
            return TriedDevice(False, "The device was not found any more. Plug it in and search again.")
        return TriedDevice(key == "usb", "It answered in 12 ms." if key == "usb" else "No answer. Check the cable.")
