"""Solve and publish all appearances of a stage; one that can't be made stops no other."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from controller.core.errors import VelaturaError
from controller.run.progress import Reporter
from controller.stage.check import check_stage
from controller.stage.session import StageSession


@dataclass(frozen=True, slots=True)
class Published:
    """``names`` are in the new bundle, none where there is no new bundle; ``failed``: by name, why it is not."""

    names: tuple[str, ...]
    failed: Mapping[str, str]

    @property
    def failures(self) -> str:
        """Sentences that name each."""
        return " ".join(f"{name} was not solved: {why}" for name, why in self.failed.items())


def publish_appearances(session: StageSession, *, reporter: Reporter, cancel: threading.Event) -> Published:
    """What stage.toml has, on the newest calibration.

    Raises what ``services.calibrate.make_appearances`` raises where that concerns every appearance, and Cancelled.
    """
    from controller.services.calibrate import make_appearances

    names, failed = _checked(session.stage)
    if failed and not names:
        return Published((), failed)

    def make(some: Sequence[str]) -> None:
        make_appearances(session=session, names=some, reporter=reporter, cancel=cancel)

    try:
        make(names)
    except VelaturaError as error:
        if len(names) < 2:
            raise
        whole = error
    else:
        return Published(names, failed)
    # One of them is at fault, or all are; what is solved already is not solved again.
    made = []
    for name in names:
        try:
            make((name,))
            made.append(name)
        except VelaturaError as error:
            failed[name] = f"{error.what} {error.remedy}"
    if not made:
        raise whole
    return Published(tuple(made), failed)


def _checked(stage: Path) -> tuple[tuple[str, ...], dict[str, str]]:
    """Those of stage.toml that can be begun, and why the others can't."""
    from controller.artefacts.calibrated import Calibrated
    from controller.stage.calibrations import finished_calibration
    from controller.steps.appearance.requests import wishes_of

    checked = check_stage(stage)
    calibrated = Calibrated(finished_calibration(checked.stage.folder), checked.names)
    names, failed = [], {}
    for table in checked.stage.tables.appearances:
        try:
            wishes_of(checked.stage, calibrated, (table.name,))
            names.append(table.name)
        except VelaturaError as error:
            failed[table.name] = f"{error.what} {error.remedy}"
    return tuple(names), failed
