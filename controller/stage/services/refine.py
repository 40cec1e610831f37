"""What the command line asks for after solving: photographs of the results, and frames that are corrected by them."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from controller.config import load_stage
from controller.run.progress import Reporter
from controller.run.runner import Step
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.solved import read_refining, remove_refined
from controller.stage.rig.ambient_light import dark_after
from controller.stage.rig.rig import Rig
from controller.stage.sessions.check import Checked
from controller.stage.sessions.session import StageSession, StageWork
from controller.stage.steps.appearance.refining import RefineOptions, refine_steps, sentence
from hal.deadline import Cancelled
from hal.errors import DeviceError
from hal.notices import Level

REFINE: Final = "refine"
"""What such runs are called; their folders' names end with it."""


@dataclass(frozen=True, slots=True)
class Refinement:
    """At most so many ``photographs`` of each result; 0: the frames as they were solved.

    ``asked``: by a person, now. Else what has been refined already stays as it is, and a stage whose devices can't be
    opened, or whose room is bright, keeps the frames as they were solved, with a warning.
    """

    photographs: int
    asked: bool = True


def refinement_of(stage: Path, typed: int | None) -> Refinement:
    """What a person ``typed``, else what the stage.toml in this folder says."""
    if typed is not None:
        return Refinement(typed)
    return Refinement(load_stage(stage).tables.solve.refine, asked=False)


def refine(
    session: StageSession,
    checked: Checked,
    calibrated: Calibrated,
    titles: Mapping[str, str],
    refinement: Refinement,
    *,
    reporter: Reporter,
    cancel: threading.Event,
) -> Mapping[str, Any]:
    """Light the projectors and refine these solved appearances, title by name; "refined" tells what was achieved.

    Nothing is published. Raises what the devices and the steps raise, where refining was ``asked``.
    """
    folder = calibrated.folder
    if refinement.photographs == 0:
        with session.locked():
            for name, of_view in itertools.product(titles, calibrated.folders):
                remove_refined(of_view, name)
        return {}
    done = () if refinement.asked else tuple(name for name in titles if _enough(folder, name, refinement.photographs))
    left = {name: title for name, title in titles.items() if name not in done}
    tables = checked.stage.tables
    options = RefineOptions(refinement.photographs, tables.solve.smoothness, tables.capture.longest_exposure_s)

    opened = False

    def steps(rig: Rig, _: Path) -> Sequence[Step]:
        nonlocal opened
        opened = True
        return [*refine_steps(rig, calibrated, left, options), *dark_after(rig.ambient_limit, rig.display)]

    try:
        if left:
            session.run(checked, StageWork(REFINE, steps, dark=True), reporter=reporter, cancel=cancel)
    except DeviceError as error:
        # What fails once lamps may be lit has to be seen by a person.
        before_light = not opened or error.code == "room-not-dark"
        if refinement.asked or not before_light or isinstance(error, Cancelled):
            raise
        reporter.say(
            f"The appearances were not refined: {error.what} {error.remedy} Then run the same command again, or set "
            "refine = 0 under [solve] in stage.toml.",
            Level.WARNING,
        )
    by_name = {name: read_refining(folder, name) for name in titles}
    return {"refined": " ".join(sentence(name, figures) for name, figures in by_name.items() if figures is not None)}


def _enough(run: Path, name: str, photographs: int) -> bool:
    figures = read_refining(run, name)
    return figures is not None and int(figures["asked"]) >= photographs
