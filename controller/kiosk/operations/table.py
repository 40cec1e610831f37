"""Every operation of a kiosk: a function for each, from which HTTP, socket, commands and building control are made.

To add one, write a function here and the method of ``Kiosk`` that it calls (of ``FolderKiosk``, too, if it works
offline). The types of its arguments say what may be sent; its docstring is the text of the help and of the document.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final, Protocol

from controller.kiosk.interface import Kiosk
from controller.kiosk.operations.accounts import ACCOUNT_OPERATIONS
from controller.kiosk.operations.arguments import (
    MOST_EVENTS,
    AfterNumber,
    AppearanceName,
    BackupFile,
    Black,
    CheckTime,
    ComparisonPicture,
    DeviceKey,
    FadeSeconds,
    FitName,
    FullOrQuick,
    Hours,
    HoursRow,
    Identifying,
    JobNumber,
    LaidPicture,
    MeshName,
    MeshPoints,
    MeshSide,
    MostEvents,
    NewName,
    OnlyAppearance,
    OnlyLevel,
    OnlyProjector,
    Outline,
    Paused,
    Percent,
    PictureFile,
    PointPairs,
    ProjectorName,
    ReachPicture,
    RunName,
    SceneName,
    StageText,
    TargetFile,
    TargetKey,
    TimeZone,
    UpToNumber,
    WithPhotographs,
)
from controller.kiosk.operations.house import HOUSE_OPERATIONS
from controller.kiosk.operations.operation import Download, Effect, Jpeg, Names, Operation, Page, Picture, operation
from controller.kiosk.roles import Role
from controller.kiosk.schedule import expanded
from controller.kiosk.state import EventRow, Job, KioskState
from controller.kiosk.values import (
    Aiming,
    Appearance,
    Changes,
    Comparison,
    Computed,
    Finding,
    Fit,
    FoundDevice,
    LaidMesh,
    LampDay,
    NewTarget,
    Reach,
    Results,
    Scene,
    Schedule,
    ScheduleRow,
    TriedDevice,
)

VIEWER, OPERATOR, TECHNICIAN = Role.VIEWER, Role.OPERATOR, Role.TECHNICIAN
LOOKS, SHOWS, CHANGES, WORKS = Effect.LOOKS, Effect.SHOWS, Effect.CHANGES, Effect.WORKS


class Targets(Protocol):
    """The uploaded targets of a panel; ``controller.panel.uploads`` has them."""

    def add(self, uploaded: Path, fit: Fit = "fit") -> str: ...
    def fit_again(self, key: str, fit: Fit, points: str) -> str: ...
    def restrict(self, key: str, text: str) -> None: ...
    def path(self, key: str) -> Path: ...


# -- the stage now


@operation("GET /state", VIEWER, LOOKS, names=Names(socket="status", part_of="kiosk status"))
def state(kiosk: Kiosk) -> KioskState:
    """The state, as on the first page."""
    return kiosk.snapshot()


@operation("GET /events", VIEWER, LOOKS, names=Names(part_of="kiosk events"), offline=True)
def events(
    kiosk: Kiosk, after: AfterNumber = 0, level: OnlyLevel | None = None, most: MostEvents = MOST_EVENTS
) -> Sequence[EventRow]:
    """The event log, oldest first."""
    return [row for row in kiosk.events(after) if level in (None, row.level)][-most:]


@operation("POST /start", OPERATOR, SHOWS, done="The stage opens.", names=Names(verb="open"))
def start(kiosk: Kiosk) -> None:
    """Switch the lamps on, and play. It stays open until the next scheduled change."""
    kiosk.start()


@operation("POST /stop", OPERATOR, SHOWS, done="The stage closes; the lamps cool down.",
           asks="Close the stage? It becomes black, and the lamps have to cool before they can be lit again.",
           names=Names(verb="close"))  # fmt: skip
def stop(kiosk: Kiosk) -> None:
    """Stop playing, and cool the lamps down. It stays closed until the next scheduled change."""
    kiosk.stop()


@operation("POST /play", OPERATOR, SHOWS, done="{name} plays now.", names=Names(command="show"))
def play(kiosk: Kiosk, name: AppearanceName, fade_s: FadeSeconds | None = None) -> None:
    """Show this appearance now. A closed stage opens."""
    kiosk.play(name, fade_s)


@operation("POST /rotate", OPERATOR, SHOWS, done="All appearances are shown in turn.")
def rotate(kiosk: Kiosk) -> None:
    """Show all appearances in turn, with their times and fades. Their times are shown_s and fade_s in stage.toml. A
    closed stage opens.
    """
    kiosk.rotate()


@operation("POST /next", OPERATOR, SHOWS, done="The next appearance is shown.", names=Names("next"))
def next_appearance(kiosk: Kiosk, fade_s: FadeSeconds | None = None) -> None:
    """Show the next appearance. The order is that of the playlist, else of the bundle."""
    kiosk.next(fade_s)


@operation("POST /black", OPERATOR, SHOWS)
def black(kiosk: Kiosk, on: Black, fade_s: FadeSeconds | None = None) -> None:
    """Show black with the lamps lit, or the picture again. It ends when an appearance is chosen, or when the stage
    closes.
    """
    kiosk.black(on, fade_s)


@operation("POST /pause", OPERATOR, SHOWS)
def pause(kiosk: Kiosk, on: Paused) -> None:
    """Stay at the present appearance, or continue. It ends when an appearance is chosen, or when the stage closes."""
    kiosk.pause(on)


@operation("POST /brightness", OPERATOR, SHOWS, done="The brightness is {percent} %.")
def brightness(kiosk: Kiosk, percent: Percent) -> None:
    """Show a share of the light. It is 100 again when the stage closes."""
    kiosk.brightness(percent)


@operation("POST /identify", OPERATOR, SHOWS, done="Look at the projectors.")
def identify(kiosk: Kiosk, on: Identifying) -> None:
    """Show each projector's name on it, or stop that."""
    kiosk.identify(on)


@operation("GET /camera", VIEWER, LOOKS, names=Names(socket="camera-picture", part_of="kiosk aim"))
def camera(kiosk: Kiosk) -> Jpeg:
    """What the camera sees."""
    return kiosk.camera_picture()


@operation("GET /photograph", VIEWER, LOOKS, names=Names(part_of="kiosk status"))
def photograph(kiosk: Kiosk) -> Jpeg:
    """The newest photograph of the job that runs."""
    return kiosk.photograph()


@operation("GET /lamps", VIEWER, LOOKS, names=Names(command="lamps"), offline=True)
def lamp_history(kiosk: Kiosk) -> Sequence[LampDay]:
    """Hours and strikes of each lamp, day by day."""
    return kiosk.lamp_history()


# -- jobs


@operation(
    "POST /recalibrations", OPERATOR, WORKS, done="The recalibration has started.", names=Names(command="calibrate")
)
def recalibrate(kiosk: Kiosk, kind: FullOrQuick, projector: OnlyProjector | None = None) -> Job:
    """Calibrate on the running kiosk."""
    return kiosk.recalibrate(kind, projector)


@operation("POST /cancel", OPERATOR, CHANGES, done="The job ends at its next safe point.")
def cancel(kiosk: Kiosk) -> None:
    """End the running job at its next safe point."""
    kiosk.cancel()


@operation("POST /appearances", OPERATOR, WORKS, done="The computation has started.", names=Names(command="add"))
def compute(kiosk: Kiosk, name: NewName, target: TargetFile, fit: FitName = "fit") -> Job:
    """Compute an appearance from a target picture. The target is added to stage.toml as an appearance, and
    installed.
    """
    return kiosk.compute(name, target, fit)


@operation("POST /appearances/rendered", OPERATOR, WORKS, done="The computation has started.",
           names=Names(part_of="appearance"))  # fmt: skip
def compute_scene(kiosk: Kiosk, name: NewName, scene: SceneName) -> Job:
    """Render a scene with Blender, and compute an appearance from it. The scene is added to stage.toml as an
    appearance; each calibration renders it again.
    """
    return kiosk.compute_scene(name, scene)


@operation("POST /comparisons", OPERATOR, WORKS, names=Names(command="photograph"),
           done="The appearances are shown and photographed, one after the other.")  # fmt: skip
def compare(kiosk: Kiosk, name: OnlyAppearance | None = None) -> Job:
    """Photograph the installed appearances, and compare them with their targets."""
    return kiosk.compare(name)


@operation(
    "POST /aiming/shots", TECHNICIAN, WORKS, done="The test shots have started.", names=Names(part_of="kiosk aim")
)
def test_shots(kiosk: Kiosk) -> Job:
    """Take test shots that show how projectors and camera are aimed."""
    return kiosk.test_shots()


# -- appearances


@operation("GET /appearances", VIEWER, LOOKS, offline=True)
def appearances(kiosk: Kiosk) -> Sequence[Appearance]:
    """List the appearances."""
    return kiosk.appearances()


@operation("GET /appearances/{name}/preview", VIEWER, LOOKS, names=Names(part_of="bundle inspect"), offline=True)
def preview(kiosk: Kiosk, name: AppearanceName) -> Picture:
    """A picture of how an appearance will look."""
    return next((row.preview for row in kiosk.appearances() if row.name == name), None)


@operation("GET /appearances/{name}/projectors/{projector}", VIEWER, LOOKS, names=Names(part_of="bundle inspect"),
           offline=True)  # fmt: skip
def projector_picture(kiosk: Kiosk, name: AppearanceName, projector: ProjectorName) -> Picture:
    """A small picture of what a projector shows of an appearance."""
    return kiosk.projector_picture(name, projector)


@operation("GET /view", OPERATOR, LOOKS, offline=True, names=Names(command="canvas"))
def view(kiosk: Kiosk) -> Picture:
    """The object in white light as the camera sees it, to paint a target on."""
    return kiosk.view()


@operation("DELETE /appearances/{name}", TECHNICIAN, CHANGES, done="A new bundle without {name} is being made.",
           asks="Remove the appearance {name}?", names=Names(command="remove"))  # fmt: skip
def remove_appearance(kiosk: Kiosk, name: AppearanceName) -> None:
    """Remove an appearance. An appearance that is playing, or that is in the schedule, can't be removed."""
    kiosk.remove_appearance(name)


@operation("POST /targets", OPERATOR, CHANGES, done="The picture is uploaded.", names=Names(part_of="kiosk add"))
def upload_target(targets: Targets, file: PictureFile, fit: FitName = "fit") -> NewTarget:
    """Upload a picture as a target."""
    return NewTarget(targets.add(file, fit))


@operation("POST /targets/{target}/fit", OPERATOR, CHANGES, done="The picture is fitted again.",
           names=Names(name="fit-target", part_of="kiosk add"))  # fmt: skip
def fit_target(targets: Targets, target: TargetKey, fit: FitName, points: PointPairs = "") -> NewTarget:
    """Make another target of an uploaded picture, with another fit."""
    return NewTarget(targets.fit_again(target, fit, points))


@operation("GET /targets/{target}", OPERATOR, LOOKS, names=Names(part_of="kiosk add"))
def target_picture(targets: Targets, target: TargetKey) -> Picture:
    """An uploaded target, as it is stored."""
    return targets.path(target)


@operation("PUT /targets/{target}/outline", OPERATOR, CHANGES, done="The outline is used.",
           names=Names(part_of="kiosk add"))  # fmt: skip
def outline_target(targets: Targets, target: TargetKey, outline: Outline) -> None:
    """Use only these parts of an uploaded target; everything else stays dark."""
    targets.restrict(target, outline)


@operation("GET /targets/{target}/reach", OPERATOR, LOOKS, offline=True)
def reach(kiosk: Kiosk, target: TargetFile) -> Reach:
    """How much of a target the projectors can make."""
    return kiosk.reach(target)


@operation("GET /targets/{target}/reach/{picture}", OPERATOR, LOOKS, offline=True, names=Names(part_of="kiosk reach"))
def reach_picture(kiosk: Kiosk, target: TargetFile, picture: ReachPicture) -> Picture:
    """The target, what it will look like, or a map of what is out of reach."""
    return kiosk.reach(target).pictures.get(picture)


@operation("GET /targets/{target}/computed", OPERATOR, LOOKS, names=Names(part_of="kiosk add"))
def computed_preview(kiosk: Kiosk, target: TargetFile) -> Computed:
    """What the object will look like by a whole solve."""
    return kiosk.computed(target)


@operation("GET /targets/{target}/computed/picture", OPERATOR, LOOKS, names=Names(part_of="kiosk add"))
def computed_picture(kiosk: Kiosk, target: TargetFile) -> Picture:
    """A picture of a whole solve."""
    return kiosk.computed(target).pictures["result"]


@operation("GET /targets/{target}/feasibility", OPERATOR, LOOKS, offline=True, names=Names(part_of="kiosk reach"))
def feasibility(kiosk: Kiosk, target: TargetFile) -> Picture:
    """A map of where the target can't be reached."""
    return kiosk.reach(target).pictures["map"]


@operation("GET /scenes", OPERATOR, LOOKS, names=Names(part_of="appearance"), offline=True)
def scenes(kiosk: Kiosk) -> Sequence[Scene]:
    """Scenes that Blender can render on the object."""
    return kiosk.scenes()


@operation("GET /scenes/{scene}/picture", OPERATOR, LOOKS, names=Names(part_of="appearance"), offline=True)
def scene_picture(kiosk: Kiosk, scene: SceneName) -> Picture:
    """A small picture of a scene."""
    return next((row.preview for row in kiosk.scenes() if row.name == scene), None)


@operation("GET /scenes/{scene}/reach", OPERATOR, LOOKS, names=Names(part_of="appearance"), offline=True)
def scene_reach(kiosk: Kiosk, scene: SceneName) -> Reach:
    """How much of a scene the projectors can make."""
    return kiosk.scene_reach(scene)


@operation("GET /scenes/{scene}/reach/{picture}", OPERATOR, LOOKS, names=Names(part_of="appearance"), offline=True)
def scene_reach_picture(kiosk: Kiosk, scene: SceneName, picture: ReachPicture) -> Picture:
    """The scene, what it will look like, or a map of what is out of reach."""
    return kiosk.scene_reach(scene).pictures.get(picture)


@operation("GET /meshes", OPERATOR, LOOKS, names=Names(part_of="register"), offline=True)
def meshes(kiosk: Kiosk) -> Sequence[str]:
    """Meshes in the stage's folder that can be laid on the object."""
    return kiosk.meshes()


@operation("GET /meshes/{mesh}/sides/{side}", OPERATOR, LOOKS, names=Names(part_of="register"), offline=True)
def mesh_picture(kiosk: Kiosk, mesh: MeshName, side: MeshSide) -> Picture:
    """A mesh from one side."""
    return kiosk.mesh_picture(mesh, side)


@operation("POST /meshes/{mesh}", OPERATOR, CHANGES, done="The mesh lies on the object.",
           names=Names(part_of="register"), offline=True)  # fmt: skip
def lay_mesh(kiosk: Kiosk, mesh: MeshName, side: MeshSide = 0, points: MeshPoints = "") -> None:
    """Lay a mesh on the object, by itself or by the same places on both."""
    kiosk.lay_mesh(mesh, side, points)


@operation("GET /mesh", OPERATOR, LOOKS, names=Names(part_of="register"), offline=True)
def laid_mesh(kiosk: Kiosk) -> LaidMesh | None:
    """The mesh that lies on the object."""
    return kiosk.laid_mesh()


@operation("GET /mesh/{picture}", OPERATOR, LOOKS, names=Names(part_of="register"), offline=True)
def laid_mesh_picture(kiosk: Kiosk, picture: LaidPicture) -> Picture:
    """The mesh in the camera's view, or a map of how far it differs from the object."""
    found = kiosk.laid_mesh()
    return None if found is None else found.pictures.get(picture)


# -- results


@operation("GET /comparisons", VIEWER, LOOKS, names=Names(part_of="kiosk results"), offline=True)
def comparisons(kiosk: Kiosk) -> Sequence[Comparison]:
    """How close the photographed appearances are to their targets."""
    return kiosk.comparisons()


@operation(
    "GET /appearances/{name}/pictures/{picture}", VIEWER, LOOKS, names=Names(part_of="kiosk results"), offline=True
)
def comparison_picture(kiosk: Kiosk, name: AppearanceName, picture: ComparisonPicture) -> Picture:
    """A picture of such a comparison."""
    return next((row.pictures.get(picture) for row in kiosk.comparisons() if row.name == name), None)


@operation("GET /runs", VIEWER, LOOKS, names=Names(part_of="kiosk results"), offline=True)
def runs(kiosk: Kiosk) -> Sequence[str]:
    """Runs with results, newest first."""
    return kiosk.runs()


@operation("GET /runs/{run}", VIEWER, LOOKS, names=Names(part_of="kiosk results"), offline=True)
def results(kiosk: Kiosk, run: RunName) -> Results:
    """Grade and figures of a run."""
    return kiosk.results(run)


@operation("GET /runs/{run}/pictures/{picture}", VIEWER, LOOKS, names=Names(part_of="kiosk results"), offline=True)
def run_picture(kiosk: Kiosk, run: RunName, picture: ComparisonPicture) -> Picture:
    """A picture of a run."""
    return kiosk.results(run).pictures.get(picture)


@operation("GET /runs/{run}/report", VIEWER, LOOKS, names=Names(part_of="report"))
def report(kiosk: Kiosk, run: RunName) -> Page:
    """A run's report, one HTML file."""
    return kiosk.report(run)


@operation("GET /aiming", TECHNICIAN, LOOKS, names=Names(part_of="kiosk aim"))
def aiming(kiosk: Kiosk) -> Aiming:
    """Coverage, focus and exposure now."""
    return kiosk.aiming()


@operation("GET /aiming/picture", TECHNICIAN, LOOKS, names=Names(part_of="kiosk aim"))
def aiming_picture(kiosk: Kiosk) -> Picture:
    """A picture of the object that marks the problems."""
    return kiosk.aiming().picture


@operation("POST /failures/seen", OPERATOR, CHANGES, done="The failures are confirmed.", names=Names(command="confirm"))
def seen(kiosk: Kiosk, number: UpToNumber | None = None) -> None:
    """Confirm failures, so that they leave the state."""
    kiosk.seen(number)


# -- settings


def schedule_of(time_zone: str, rows: list[HoursRow], drift_check: str = "") -> Schedule:
    """The schedule of checked values. Raises UsageError for a day that does not exist."""
    hours = tuple(ScheduleRow(row.day, row.opens, row.closes, row.appearance) for row in rows)
    return Schedule(time_zone, expanded(hours), drift_check)


@operation("GET /schedule", VIEWER, LOOKS, names=Names(part_of="kiosk schedule"), offline=True)
def schedule(kiosk: Kiosk) -> Schedule:
    """Opening hours."""
    return kiosk.schedule()


@operation("PUT /schedule", OPERATOR, CHANGES, done="The schedule is in use.", names=Names(part_of="kiosk schedule"),
           offline=True)  # fmt: skip
def set_schedule(kiosk: Kiosk, time_zone: TimeZone, rows: Hours, drift_check: CheckTime = "") -> None:
    """Replace the opening hours."""
    kiosk.set_schedule(schedule_of(time_zone, rows, drift_check))


@operation("POST /schedule/effect", OPERATOR, LOOKS, names=Names(part_of="kiosk schedule"), offline=True)
def effect_of_schedule(kiosk: Kiosk, time_zone: TimeZone, rows: Hours, drift_check: CheckTime = "") -> str:
    """What people see when this schedule is saved."""
    return kiosk.effect_of_schedule(schedule_of(time_zone, rows, drift_check))


@operation("GET /settings", TECHNICIAN, LOOKS, names=Names(part_of="kiosk settings"), offline=True)
def settings(kiosk: Kiosk) -> str:
    """The text of stage.toml."""
    return kiosk.settings()


@operation("POST /settings/check", TECHNICIAN, LOOKS, done="The settings are valid.",
           names=Names(socket="validate-settings", part_of="kiosk settings"), offline=True)  # fmt: skip
def check_settings(kiosk: Kiosk, text: StageText) -> None:
    """Check a stage.toml without saving it."""
    kiosk.validate_settings(text)


@operation("POST /settings/effect", TECHNICIAN, LOOKS, names=Names(part_of="kiosk settings"), offline=True)
def effect_of_settings(kiosk: Kiosk, text: StageText) -> str:
    """What people see when this stage.toml is saved."""
    return kiosk.effect_of_settings(text)


@operation("PUT /settings", TECHNICIAN, CHANGES, done="The settings are in use.", names=Names(part_of="kiosk settings"),
           offline=True)  # fmt: skip
def save_settings(kiosk: Kiosk, text: StageText) -> None:
    """Check stage.toml, save it, and apply it."""
    kiosk.save_settings(text)


# -- maintenance


@operation("POST /doctor", OPERATOR, LOOKS, names=Names(part_of="doctor"))
def doctor(kiosk: Kiosk) -> Sequence[Finding]:
    """Find problems."""
    return [Finding.of(notice) for notice in kiosk.doctor()]


@operation("GET /changes", OPERATOR, LOOKS, offline=True)
def changes(kiosk: Kiosk) -> Changes:
    """What changed since the last good day. Kernel, drivers, packages, outputs, adapters, projectors, camera, settings,
    clock, network.
    """
    return kiosk.changes()


@operation("POST /alerts/test", TECHNICIAN, CHANGES, done="The test alert was taken by every server.")
def test_alerts(kiosk: Kiosk) -> None:
    """Send a test alert to everybody that stage.toml names."""
    kiosk.test_alerts()


@operation("POST /backup/test", TECHNICIAN, CHANGES, done="The backup is at every place, and was read back.")
def test_backup(kiosk: Kiosk) -> None:
    """Make a backup now at every place that stage.toml names, and read it back."""
    kiosk.test_backup()


@operation("POST /backup", TECHNICIAN, LOOKS, offline=True)
def backup(kiosk: Kiosk, photographs: WithPhotographs | None = None) -> Download:
    """Make a backup of settings, the files they name, calibration and appearances. It does not contain accounts and
    keys, but the passwords in stage.toml.
    """
    return kiosk.backup(photographs=bool(photographs))


@operation("POST /restore", TECHNICIAN, CHANGES, done="The backup is in use.",
           asks="Replace settings, calibration and appearances with those of the backup?", offline=True)  # fmt: skip
def restore(kiosk: Kiosk, backup: BackupFile) -> None:
    """Replace settings, calibration and appearances with a backup."""
    kiosk.restore(backup)


@operation("POST /diagnostics", TECHNICIAN, LOOKS, offline=True)
def diagnostics(kiosk: Kiosk) -> Download:
    """Make a diagnostics file for remote support. It contains events, journals and states, but no secrets and no
    pictures.
    """
    return kiosk.diagnostics()


@operation("POST /devices/found", TECHNICIAN, LOOKS, names=Names(part_of="doctor"))
def find_devices(kiosk: Kiosk) -> Sequence[FoundDevice]:
    """Search for devices."""
    return kiosk.find_devices()


@operation("POST /devices/tried", TECHNICIAN, LOOKS, names=Names(part_of="doctor"))
def try_device(kiosk: Kiosk, key: DeviceKey) -> TriedDevice:
    """Open a found device and read its identity."""
    return kiosk.try_device(key)


@operation("", VIEWER, LOOKS)
def job(kiosk: Kiosk, number: JobNumber) -> Job | None:
    """A requested job, also after it has ended. For a client that follows a job at the socket; all others see the last
    job in the state.
    """
    return kiosk.job(number)


_DECLARED: Final = (
    *(each for each in list(globals().values()) if isinstance(each, Operation)),
    *ACCOUNT_OPERATIONS,
    *HOUSE_OPERATIONS,
)
OPERATIONS: Final[tuple[Operation, ...]] = tuple(each for each in _DECLARED if each.http)
AT_SOCKET: Final[tuple[Operation, ...]] = _DECLARED
