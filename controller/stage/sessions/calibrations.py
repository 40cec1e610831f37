"""A stage's finished calibrations, and the keys that sign its bundles.

It imports little: the kiosk uses it before its first picture, before the calibration code is loaded.
"""

from __future__ import annotations

from pathlib import Path

from controller.bundle.signing import Trust, load_signing_key
from controller.config import Stage
from controller.core.errors import UsageError
from controller.run.journal import Journal, JournalError
from controller.run.progress import Reporter
from controller.stage.artefacts.grade import passes
from controller.stage.artefacts.kinds import CALIBRATED
from controller.stage.artefacts.outline import keep_outline
from controller.stage.sessions.check import Checked
from controller.stage.steps.calibrate.gate import accept, below_grade

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
        "not-calibrated", what="This stage has no finished calibration.", remedy="Run `velatura calibrate` on it first."
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


def signing_key(checked: Checked) -> Path | None:
    """The stage's own key; None for unsigned bundles, if stage.toml allows them.

    Raises UsageError("no-signing-key", or "signing-key-refused" for one whose bundles the stage would not play).
    """
    key = checked.stage.path(KEY_FILE)
    if key.exists():
        _check_own_key(key, stage_trust(checked.stage))
        return key
    if checked.stage.tables.bundle.allow_unsigned:
        return None
    raise UsageError(
        "no-signing-key",
        what=f"The stage has no signing key in {KEY_FILE}.",
        remedy="Make one with `velatura bundle key STAGE`. It also shows the line to add to stage.toml.",
    )


def _check_own_key(path: Path, trust: Trust) -> None:
    # Before the work: otherwise the player refuses the bundle when everything is solved.
    public = bytes(load_signing_key(path).verify_key)
    if public in trust.revoked:
        problem, remedy = (
            "is revoked",
            f"Move {path} away, make a new key with `velatura bundle key STAGE`, and add it to trusted_keys.",
        )
    elif public not in trust.keys and (trust.keys or not trust.allow_unsigned):
        problem, remedy = "is not trusted", f'Add "{public.hex()}" to trusted_keys under [bundle] in stage.toml.'
    else:
        return
    raise UsageError("signing-key-refused", what=f"The stage's own signing key {problem} by stage.toml.", remedy=remedy)


def usable_calibration(checked: Checked, reporter: Reporter, *, accept_grade: bool = False) -> Path:
    """The newest calibration, if its grade is good enough.

    An older one is never used instead: the stage may have changed. ``accept_grade`` accepts any grade with a warning.
    Raises UsageError("not-calibrated") and CalibrationError("calibration-below-grade").
    """
    run, worst = finished_calibration(checked.stage.folder), worst_grade(checked)
    if accept_grade:
        accept(run, reporter, worst)
    if not passes(run, worst):
        raise below_grade(run, worst)
    keep_outline(run, checked.stage.tables.object.outline)
    return run
