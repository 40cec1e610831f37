"""Solve and publish all appearances of a stage; one that fails does not stop the others."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from controller.core.errors import VelaturaError
from controller.run.progress import Reporter
from controller.stage.sessions.check import check_stage
from controller.stage.sessions.session import StageSession


@dataclass(frozen=True, slots=True)
class Published:
    """``names`` are in the new bundle (empty: there is none); ``failed``: the reason for each other one."""

    names: tuple[str, ...]
    failed: Mapping[str, str]

    @property
    def failures(self) -> str:
        """One sentence for each."""
        return " ".join(f"{name} was not solved: {why}" for name, why in self.failed.items())


def publish_appearances(session: StageSession, *, reporter: Reporter, cancel: threading.Event) -> Published:
    """Solve the appearances of stage.toml on the newest calibration.

    Raises what ``services.calibrate.make_appearances`` raises if no appearance can be solved, and Cancelled.
    """
    from controller.stage.services.calibrate import make_appearances

    names, failed = _checked(session.stage)
    if failed and not names:
        return Published((), failed)

    def make(subset: Sequence[str]) -> None:
        make_appearances(session=session, names=subset, reporter=reporter, cancel=cancel)

    try:
        make(names)
    except VelaturaError as error:
        if len(names) < 2:
            raise
        first_error = error
    else:
        return Published(names, failed)
    # Find out which ones fail; finished solutions are reused.
    made = []
    for name in names:
        try:
            make((name,))
            made.append(name)
        except VelaturaError as error:
            failed[name] = f"{error.what} {error.remedy}"
    if not made:
        raise first_error
    return Published(tuple(made), failed)


def _checked(stage: Path) -> tuple[tuple[str, ...], dict[str, str]]:
    """The appearances of stage.toml that can be solved, and why the others can't."""
    from controller.stage.artefacts.calibrated import Calibrated
    from controller.stage.sessions.calibrations import finished_calibration
    from controller.stage.steps.appearance.requests import requests_of

    checked = check_stage(stage)
    calibrated = Calibrated(finished_calibration(checked.stage.folder), checked.names)
    names, failed = [], {}
    for table in checked.stage.tables.appearances:
        try:
            requests_of(checked.stage, calibrated, (table.name,))
            names.append(table.name)
        except VelaturaError as error:
            failed[table.name] = f"{error.what} {error.remedy}"
    return tuple(names), failed
