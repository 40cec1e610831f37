"""Failover frames: the appearances solved for the projectors that still work, in a separate bundle."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from controller.bundle.install import current, install, revision_floor
from controller.bundle.reader import Bundle
from controller.bundle.signing import load_signing_key
from controller.bundle.writer import NewAppearance, NewBundle, write_bundle
from controller.core.errors import UsageError, VelaturaError
from controller.kiosk.store.bundle_store import slots_without
from controller.run.journal import Journal
from controller.run.progress import Reporter
from controller.run.runner import Context, Runner, Step
from controller.run.step_id import StepId
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.published import BUNDLE
from controller.stage.artefacts.solved import read_solved
from controller.stage.sessions.calibrations import output_sizes, signing_key, stage_trust, usable_calibration
from controller.stage.sessions.check import Checked, check_stage
from controller.stage.sessions.run import LONGEST_RUN_S
from controller.stage.sessions.session import StageSession
from controller.stage.steps import costs
from controller.stage.steps.appearance.requests import requests_of
from controller.stage.steps.appearance.solving import AppearanceRequest, options_of, solve_steps
from hal.deadline import in_seconds

FOLDER: Final = "without"


class Survivors(Calibrated):
    """A calibration reduced to some of its projectors; its solutions are stored in ``own``, not in the run."""

    def __init__(self, run: Path, projectors: Sequence[str], own: Path) -> None:
        super().__init__(run, projectors)
        self._own = own

    @property
    def base_folder(self) -> Path:
        """See ``Calibrated``."""
        return self._own


def solve_without(
    session: StageSession, missing: Sequence[str], *, reporter: Reporter, cancel: threading.Event
) -> Path:
    """Solve the installed bundle's appearances without these projectors, and install them as a separate bundle.

    Finished steps of the same calibration are not repeated. Returns the bundle's file. Raises what
    ``usable_calibration``, ``requests_of`` and the solver raise, and UsageError("no-projector-left").
    """
    checked = check_stage(session.stage)
    left = tuple(name for name in checked.names if name not in missing)
    if not left or len(left) == len(checked.names):
        raise UsageError("no-projector-left", what="No working projector would remain.", remedy="Repair a projector.")
    folder = checked.stage.folder
    with session.locked():
        run = usable_calibration(checked, reporter)
        own = run / FOLDER / slots_without(run, missing).name
        survivors = Survivors(run, left, own)
        requests = _requests(checked, survivors, _installed(folder, checked))
        options = options_of(checked.stage.tables.solve)
        scale = costs.scale(size for _, size in output_sizes(checked).values())
        names = [request.name for request in requests]
        install_step = Step(
            StepId(StepKind.PUBLISH), partial(_publish, checked, tuple(missing), run, names),
            after=tuple(StepId(StepKind.APPEARANCE, item=name) for name in names),
            title=f"Installing frames without {', '.join(missing)}",
            always=True,
        )  # fmt: skip
        with Journal(own) as journal:
            steps = [*solve_steps(survivors, requests, options, (), scale), install_step]
            Runner(steps, journal, reporter=reporter).run("takeover", deadline=in_seconds(LONGEST_RUN_S, cancel))
    bundle = current(slots_without(folder, missing))
    assert bundle is not None
    return bundle


def _requests(checked: Checked, survivors: Survivors, names: Sequence[str]) -> list[AppearanceRequest]:
    """Without those that can't be solved, which were reported when they were published.

    Raises as ``requests_of`` if none can be solved.
    """
    solvable: list[AppearanceRequest] = []
    for name in names or [table.name for table in checked.stage.tables.appearances]:
        with contextlib.suppress(VelaturaError):
            solvable += requests_of(checked.stage, survivors, (name,))
    return solvable or requests_of(checked.stage, survivors, names)


def _installed(folder: Path, checked: Checked) -> Sequence[str]:
    """The installed bundle's appearances that stage.toml still has; empty if nothing is installed."""
    file, known = current(folder / "bundles"), {table.name for table in checked.stage.tables.appearances}
    if file is None:
        return ()
    with Bundle.open_trusted(file, stage_trust(checked.stage)) as bundle:
        return [appearance.name for appearance in bundle.index.appearances if appearance.name in known]


def _publish(
    checked: Checked, missing: Sequence[str], run: Path, names: Sequence[str], context: Context
) -> Sequence[Path]:
    outputs, key, trust = output_sizes(checked), signing_key(checked), stage_trust(checked.stage)
    slots, built = slots_without(checked.stage.folder, missing), context.folder / BUNDLE
    left = [name for name in outputs if name not in missing]
    black = {output: np.zeros((size[1], size[0], 3), np.uint8) for output, size in outputs.values()}

    def appearance(name: str) -> NewAppearance:
        context.check()
        solved = read_solved(context.folder, name, left)
        frames = {outputs[projector][0]: frame for projector, frame in solved.frames.items()}
        return NewAppearance(name, black | frames)

    write_bundle(
        built,
        NewBundle(
            stage=checked.stage.tables.stage.name,
            calibration=run.name,
            created_unix_s=int(time.time()),
            outputs=[(output, *size) for output, size in outputs.values()],
            revision=revision_floor(slots, trust) + 1,
        ),
        appearances=map(appearance, names),
        key=None if key is None else load_signing_key(key),
    )
    install(built, slots, trusted=trust.keys, allow_unsigned=trust.allow_unsigned, revoked=trust.revoked)
    return [built]
