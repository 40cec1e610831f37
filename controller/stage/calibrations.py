"""A stage's finished calibrations, and the keys that may sign its bundles.

It imports little: the kiosk uses it before its first picture, before the calibration code is loaded.
"""

from __future__ import annotations

from pathlib import Path

from controller.artefacts.kinds import CALIBRATED
from controller.bundle.signing import Trust
from controller.config import Stage
from controller.core.errors import UsageError
from controller.run.journal import Journal
from controller.run.journal_schema import JournalError
from controller.stage.check import Checked

KEY_FILE = "keys/stage.key"
"""The stage's signing key, if it exists."""


def stage_trust(stage: Stage) -> Trust:
    """Which bundles stage.toml allows."""
    table = stage.tables.bundle
    keys, revoked = (tuple(map(bytes.fromhex, keys)) for keys in (table.trusted_keys, table.revoked_keys))
    return Trust(keys, table.allow_unsigned, revoked)


def finished_calibrations(stage: Path) -> list[Path]:
    """The run folders whose calibration is complete, the newest first.

    A run with a damaged journal counts as not complete.
    Raises JournalError for a journal that can't be used now.
    """
    found = []
    for folder in sorted((stage / "runs").glob("*"), reverse=True):
        if not (folder / Journal.FILE).exists():
            continue
        try:
            with Journal(folder) as journal:
                if CALIBRATED in journal.steps():
                    found.append(folder)
        except JournalError as error:
            if error.code not in ("journal-damaged", "journal-not-ours"):
                raise
    return found


def finished_calibration(stage: Path) -> Path:
    """The newest run folder whose calibration is complete. Raises UsageError("not-calibrated")."""
    found = finished_calibrations(stage)
    if found:
        return found[0]
    raise UsageError(
        "not-calibrated",
        what="This stage has no finished calibration.",
        remedy="Run `velatura calibrate` on it first.",
    )


def worst_grade(checked: Checked) -> float:
    """The largest error, in per cent, at which the stage publishes."""
    return checked.stage.tables.calibration.worst_grade


def output_sizes(checked: Checked) -> dict[str, tuple[str, tuple[int, int]]]:
    """Output name and (width, height) by projector, from stage.toml. Raises UsageError("stage-key-missing")."""
    display = checked.stage.tables.display
    sizes = {output.name: (output.width_px, output.height_px) for output in display.outputs}
    if not sizes:
        raise display.place.missing("outputs", "a list of [[display.outputs]] tables with name, width_px and height_px")
    order = list(sizes)
    # The player compares a bundle's outputs with its own, in the display's order.
    tables = sorted(checked.stage.tables.projectors, key=lambda table: order.index(table.output))
    return {table.name: (table.output, sizes[table.output]) for table in tables}
