"""The interface of a kiosk: one Protocol; its values are in ``state`` and ``values``.

``controller.kiosk.api.kiosk`` implements it. The panel itself stores only accounts and sessions: every page and every
answer of the API is made from these values.

Every method may be called from any thread. Questions are answered from memory in milliseconds and never wait for a
device; a docstring with "Seconds" marks the methods that may take longer. Any text may come from a device or a file, so
it is untrusted: escape it where it is shown. Refusals are ``VelaturaError`` with code, what and remedy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from controller.kiosk.state import EventLevel, EventRow, Job, KioskState
from controller.kiosk.values import (
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
    TriedDevice,
    Unsubscribe,
)
from hal.notices import Notice


class Kiosk(Protocol):
    """A running stage, as the panel sees it. Commands return when they are accepted; progress is in
    ``snapshot().job``.
    """

    def snapshot(self) -> KioskState: ...

    def events(self, after: int = 0) -> Sequence[EventRow]:
        """Events with a number above ``after``, oldest first, at most the newest 2,000."""

    def record(self, code: str, what: str, level: EventLevel = "info") -> None:
        """Add one line to the event log: what a person or a program did here, and who it was."""

    def warn(self, about: str, what: str) -> None:
        """Show ``what`` among the warnings of the snapshot until the next call with the same ``about``; "": no more."""

    def subscribe(self, callback: Callable[[], None]) -> Unsubscribe:
        """Call ``callback`` (quick, from any thread) after every change of the snapshot or the event log."""

    def recalibrate(self, kind: RecalibrationKind, projector: str | None = None) -> Job:
        """Start a calibration, of one projector if it is named. Raises WorkError while another job is running."""

    def job(self, number: int) -> Job | None:
        """A requested job; None while it waits. Raises WorkError("job-given-up") if it will never start."""

    def cancel(self) -> None:
        """End the running job at its next safe point. Raises WorkError if none is running."""

    def play(self, name: str, fade_s: float | None = None) -> None:
        """Show this appearance; it fades in for ``fade_s`` seconds, None: as the bundle's playlist says."""

    def next(self, fade_s: float | None = None) -> None:
        """Show the next appearance. Raises WorkError("nothing-plays"), as the next three do."""

    def black(self, on: bool, fade_s: float | None = None) -> None:
        """Show black with the lamps lit, or the picture again."""

    def pause(self, on: bool) -> None:
        """Stay at the present appearance, or continue from there."""

    def brightness(self, percent: float) -> None:
        """Show ``percent`` (0 to 100) of the light, until the stage closes."""

    def rotate(self) -> None:
        """Show all appearances in turn, as the bundle's playlist says."""

    def stop(self) -> None:
        """Close: stop playing and cool the lamps down."""

    def start(self) -> None:
        """Open: lamps on, warm up, and play."""

    def view_px(self) -> tuple[int, int] | None:
        """(width, height) of the camera's view; None while it is unknown."""

    def fitted(self, target: Path, fit: Fit = "fit", points: str = "") -> bytes:
        """The picture ``target`` (PNG) fitted to the camera's view; unchanged while the view is unknown.

        ``fit``: see ``store.targets.fitted``; "wrap" wraps it around the object; "restore" lays it on what it
        shows, or by ``points`` (see ``operations.arguments.PointPairs``). Raises UsageError("target-unreadable",
        "not-calibrated", "restoration-not-matched", "restoration-points").
        """

    def compute(self, name: str, target: Path, fit: Fit = "fit") -> Job:
        """Start to solve for the picture ``target`` (PNG, sRGB), fitted by ``fitted``, as the appearance ``name``.

        The kiosk copies the picture before it returns. An existing appearance is replaced when the solve succeeds.
        """

    def reach(self, target: Path) -> Reach:
        """How much of the target can be made, and what the object will look like. Seconds. Raises UsageError without
        a calibration.
        """

    def computed(self, target: Path) -> Computed:
        """What the object will look like by a whole solve. Seconds; more at the first target.

        Raises UsageError("not-calibrated"), WorkError("preview-ended") while a job runs,
        WorkError("memory-too-small", "preview-slow").
        """

    def scenes(self) -> Sequence[Scene]:
        """What Blender can render on the object: the scenes of Velatura, and those of the stage."""

    def scene_reach(self, scene: str) -> Reach:
        """As ``reach``, of a quick rendering of the scene. Tens of seconds at the first time.

        Raises UsageError("scene-unknown", "blender-missing", "not-calibrated"), WorkError("blender-failed").
        """

    def compute_scene(self, name: str, scene: str) -> Job:
        """Start to render the scene and to solve for it, as the appearance ``name``; each calibration renders it again.

        Raises UsageError("scene-unknown", "blender-missing", "appearance-other").
        """

    def meshes(self) -> Sequence[str]:
        """Files of meshes in the stage's folder."""

    def mesh_picture(self, mesh: str, side: int) -> Path:
        """A mesh from one of 32 sides (PNG). Raises UsageError("mesh-unknown", "mesh-unreadable", "mesh-no-faces")."""

    def lay_mesh(self, mesh: str, side: int, points: str = "") -> None:
        """Lay a mesh on the object, by itself or by ``points`` (see ``operations.arguments.MeshPoints``). Seconds.

        Raises UsageError and WorkError with codes "mesh-...", UsageError("not-calibrated", "shape-unknown").
        """

    def laid_mesh(self) -> LaidMesh | None:
        """The mesh that lies on the object. Raises UsageError("not-calibrated")."""

    def appearances(self) -> Sequence[Appearance]: ...

    def projector_picture(self, name: str, projector: str) -> Path | None:
        """A small JPEG of what this projector shows of an appearance; None if it has none. Seconds at the first time.

        Raises UsageError("appearance-unknown").
        """

    def view(self) -> Path:
        """The object in white light as the camera sees it (PNG), to paint a target on. Seconds at the first time.

        Raises UsageError("not-calibrated").
        """

    def photograph(self) -> bytes | None:
        """The newest photograph of the job that runs, small, as JPEG; None without one."""

    def compare(self, name: str | None = None) -> Job:
        """Start to photograph the installed appearances, or only ``name``, and compare them with their targets.

        Raises WorkError with the reason why it can't run now, and UsageError("appearance-unknown").
        """

    def comparisons(self) -> Sequence[Comparison]:
        """What the photographed installed appearances achieved, in the bundle's order."""

    def remove_appearance(self, name: str) -> None:
        """Raises UsageError if it is playing, or in the schedule."""

    def lamp_history(self) -> Sequence[LampDay]:
        """Each lamp's last days, at most 400, oldest first; days without light are omitted."""

    def schedule(self) -> Schedule: ...

    def set_schedule(self, schedule: Schedule) -> None:
        """Replace the schedule. Raises UsageError with the row's number for a wrong day, time, zone or appearance, and
        for hours that overlap.
        """

    def effect_of_schedule(self, schedule: Schedule) -> str:
        """What people will see when it is saved, in sentences; empty if nothing. Raises as ``set_schedule``."""

    def identify(self, on: bool) -> None:
        """Show each projector's name and a frame on it, or stop that."""

    def seen(self, number: int | None = None) -> None:
        """Confirm the failures up to this number of the event log, or all; they leave the state."""

    def doctor(self) -> Sequence[Notice]:
        """Find problems of the machine, the stage and the devices. Seconds."""

    def changes(self) -> Changes:
        """What differs from the last day that graded well. Seconds."""

    def test_alerts(self) -> None:
        """Send a test alert to everybody that stage.toml names. Seconds. Raises UsageError, WorkError."""

    def test_backup(self) -> None:
        """Make a backup at every place that stage.toml names. Minutes. Raises UsageError, WorkError."""

    def backup(self, *, photographs: bool = False) -> Path:
        """A new file with settings, what they name, calibration, appearances; without keys and accounts. Seconds.

        ``photographs``: also those of the calibration.
        """

    def restore(self, backup: Path) -> None:
        """Replace settings, calibration and appearances. Raises UsageError for a file that is not a Velatura backup."""

    def diagnostics(self) -> Path:
        """A new file for remote support: events, journals, states; without secrets and pictures. Seconds."""

    def settings(self) -> str:
        """The text of stage.toml, empty if there is none."""

    def validate_settings(self, text: str) -> None:
        """Raises UsageError naming line, key and what is allowed."""

    def effect_of_settings(self, text: str) -> str:
        """What people will see when this text is saved, in sentences; empty if nothing. Raises as above."""

    def save_settings(self, text: str) -> None:
        """Validate, keep the old text in a copy, write, and apply it: only what differs restarts. Raises as above.

        With the first stage.toml the stage gets a signing key, which the text then trusts.
        """

    def camera_picture(self) -> bytes | None:
        """The camera's last live picture as JPEG, made by the kiosk itself; None if there is none."""

    def runs(self) -> Sequence[str]:
        """Names of the runs that have results, newest first."""

    def results(self, run: str) -> Results:
        """Raises UsageError("run-unknown")."""

    def report(self, run: str) -> Path:
        """A run's report, one HTML file. Seconds if it must be made first. Raises as ``results``."""

    def aiming(self) -> Aiming:
        """The newest measurement: of the last test shots, or of the calibration if that is newer. Seconds."""

    def test_shots(self) -> Job:
        """Start to photograph patterns that show how projectors and camera are aimed. Raises WorkError."""

    def find_devices(self) -> Sequence[FoundDevice]:
        """Search ports, network and USB. Seconds."""

    def try_device(self, key: str) -> TriedDevice:
        """Open the device and read its identity. Seconds; changes nothing."""
