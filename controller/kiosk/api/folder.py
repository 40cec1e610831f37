"""The operations that need only the stage's folder, and no running kiosk."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path

from controller.config import load_stage
from controller.core.errors import VelaturaError
from controller.kiosk.changes.machine import Machine
from controller.kiosk.changes.watch import since_good, take
from controller.kiosk.schedule import ScheduleFile, check
from controller.kiosk.state import EventRow
from controller.kiosk.store import archive, runs, settings
from controller.kiosk.store.archive import diagnostics
from controller.kiosk.store.bundle_store import BundleStore
from controller.kiosk.store.event_log import EventLog
from controller.kiosk.supervisors.light_records import LampHistory
from controller.kiosk.values import Appearance, Changes, Comparison, LaidMesh, LampDay, Reach, Results, Scene, Schedule
from controller.stage.sessions.calibrations import finished_calibration, stage_trust, worst_grade
from controller.stage.sessions.check import Checked, check_stage


class FolderKiosk:
    """The methods of the ``offline`` operations; those that change something need the stage's lock.

    See ``controller.kiosk.interface.Kiosk`` for what each does.
    """

    def __init__(self, stage: Path) -> None:
        self.stage = stage

    def events(self, after: int = 0) -> Sequence[EventRow]:
        with contextlib.closing(EventLog(self.stage / EventLog.FILE)) as log:
            return log.after(after)

    def appearances(self) -> Sequence[Appearance]:
        return appearances_of(self._bundles(), self.comparisons(), check_stage(self.stage), playing="")

    def projector_picture(self, name: str, projector: str) -> Path | None:
        return projector_picture(self._bundles(), check_stage(self.stage), name, projector)

    def view(self) -> Path:
        from controller.kiosk.preview.preview_light import view_picture

        return view_picture(self.stage, finished_calibration(self.stage), check_stage(self.stage).names)

    def comparisons(self) -> Sequence[Comparison]:
        return runs.comparisons(self.stage, self._bundles().names())

    def lamp_history(self) -> Sequence[LampDay]:
        return LampHistory(self.stage).days()

    def runs(self) -> Sequence[str]:
        return runs.names(self.stage)

    def results(self, run: str) -> Results:
        return runs.results(self.stage, run, worst_grade(check_stage(self.stage)))

    def changes(self) -> Changes:
        try:
            tables = load_stage(self.stage).tables
        except VelaturaError:
            tables = None
        return since_good(self.stage, take(self.stage, tables, (), Machine(), ""))

    def reach(self, target: Path) -> Reach:
        from controller.kiosk.preview.reach import reach

        return reach(check_stage(self.stage), target)

    def scenes(self) -> Sequence[Scene]:
        from controller.kiosk.preview.scenes import scenes

        return scenes(self.stage)

    def scene_reach(self, scene: str) -> Reach:
        from controller.kiosk.preview.scenes import scene_reach

        return scene_reach(check_stage(self.stage), scene)

    def meshes(self) -> Sequence[str]:
        from controller.kiosk.preview.meshes import meshes

        return meshes(self.stage)

    def mesh_picture(self, mesh: str, side: int) -> Path:
        from controller.kiosk.preview.meshes import mesh_picture

        return mesh_picture(self.stage, mesh, side)

    def lay_mesh(self, mesh: str, side: int, points: str = "") -> None:
        from controller.kiosk.preview.meshes import lay_mesh

        lay_mesh(self.stage, mesh, side, points)

    def laid_mesh(self) -> LaidMesh | None:
        from controller.kiosk.preview.meshes import laid_mesh

        return laid_mesh(self.stage)

    def schedule(self) -> Schedule:
        return self._schedule().now

    def set_schedule(self, schedule: Schedule) -> None:
        self._schedule().replace(schedule, self._bundles().names())

    def effect_of_schedule(self, schedule: Schedule) -> str:
        check(schedule, self._bundles().names())
        return ""

    def settings(self) -> str:
        return settings.text(self.stage)

    def validate_settings(self, text: str) -> None:
        settings.validate(text)

    def effect_of_settings(self, text: str) -> str:
        settings.validate(text)
        return ""

    def save_settings(self, text: str) -> None:
        settings.save(self.stage, text)

    def backup(self, *, photographs: bool = False) -> Path:
        return archive.backup(self.stage, photographs=photographs)

    def restore(self, backup: Path) -> None:
        archive.restore(self.stage, backup)

    def diagnostics(self) -> Path:
        return diagnostics(self.stage, {"state": "no kiosk runs"})

    def _bundles(self) -> BundleStore:
        return BundleStore(self.stage, stage_trust(load_stage(self.stage)))

    def _schedule(self) -> ScheduleFile:
        return ScheduleFile(self.stage, load_stage(self.stage).tables.schedule)


def projector_picture(bundles: BundleStore, checked: Checked, name: str, projector: str) -> Path | None:
    """What this projector shows of an appearance. Raises UsageError("appearance-unknown")."""
    bundles.check_name(name)
    fed = {table.name: table.output for table in checked.stage.tables.projectors}
    return bundles.output_picture(name, fed[projector]) if projector in fed else None


def appearances_of(
    bundles: BundleStore, compared: Sequence[Comparison], checked: Checked, *, playing: str
) -> tuple[Appearance, ...]:
    """The appearances of the installed bundle, in its order. ``playing``: the name of the one that plays, or empty."""
    index = bundles.index(bundles.bundle())
    if index is None:
        return ()
    shown = {one.name for one in index.outputs}
    outputs = tuple(table.name for table in checked.stage.tables.projectors if table.output in shown)
    sources = {table.name: table.kind for table in checked.stage.tables.appearances}
    made, previews = float(index.created_unix_s), bundles.previews()
    errors = {comparison.name: comparison.history[0].delta_e for comparison in compared}
    return tuple(
        Appearance(
            entry.name, made, errors.get(entry.name), entry.name == playing, previews.get(entry.name), outputs,
            sources.get(entry.name, ""),
        )
        for entry in index.appearances
    )  # fmt: skip
