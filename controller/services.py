"""What the command line and the kiosk ask for, each a run on a stage: calibrate, make appearances, play."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from controller.app import LOCK, LONGEST_RUN_S, Checked, check_stage, marker, run_on_stage
from controller.bundle.install import current
from controller.bundle.signing import Trust, load_signing_key
from controller.config import Stage
from controller.errors import UsageError
from controller.session import costs
from controller.session.calibrating import calibration_steps
from controller.session.darkness import dark_after
from controller.session.dotting import dot_steps
from controller.session.journal import Journal
from controller.session.machine import Event
from controller.session.modes import DotOptions, dot_options
from controller.session.progress import Reporter
from controller.session.publishing import bundle_display, publish_step
from controller.session.rig import Rig
from controller.session.runner import Context, Runner, Step
from controller.session.solving import Calibrated, SolveOptions, solve_steps
from controller.session.wishes import wishes_of
from controller.storage import exclusive
from hal.deadline import in_seconds

KEY_FILE = "keys/stage.key"
"""The stage's signing key, where there is one."""


def calibrate(
    *, stage: Path, reporter: Reporter, cancel: threading.Event, mode: str = "fast", dot_spacing: str | None = None
) -> Mapping[str, Any]:
    """Calibrate the stage, going on with an unfinished calibration; returns where the results lie.

    ``mode`` and ``dot_spacing``, and what is raised for wrong ones: see ``session.modes.dot_options``.
    """
    options = dot_options(mode, dot_spacing)
    checked = check_stage(stage)
    run = run_on_stage(
        checked,
        lambda rig, _: calibrating(rig, checked=checked, options=options),
        name="calibrate",
        reporter=reporter,
        cancel=cancel,
        dark=True,
    )
    return {"run": str(run)}


def calibrating(rig: Rig, *, checked: Checked, options: DotOptions | None = None) -> Sequence[Step]:
    """The calibration's steps between their state markers."""
    longest_s = checked.stage.tables.capture.longest_exposure_s
    return [
        marker("calibrating", "Calibrating", enter=Event.RECALIBRATE),
        *calibration_steps(rig, checked.prior, longest_exposure_s=longest_s),
        *dot_steps(rig, options or DotOptions(), longest_exposure_s=longest_s),
        *dark_after(rig.darkness, rig.display),
        marker("calibrated", "Calibrated", leave=Event.CALIBRATED),
    ]


def make_appearances(
    *, stage: Path, names: Sequence[str], reporter: Reporter, cancel: threading.Event
) -> Mapping[str, Any]:
    """Solve appearances of stage.toml on the last calibration, and install them as the stage's bundle.

    No device is touched: the projectors may be off, or playing.
    Raises UsageError with code "not-calibrated", and what ``wishes_of`` and the steps raise.
    """
    checked = check_stage(stage)
    folder = checked.stage.folder
    with exclusive(folder / LOCK, what_is_running="Velatura"):
        run = finished_calibration(folder)
        calibrated = Calibrated(run, checked.names)
        wishes = wishes_of(checked.stage, calibrated, names)
        table = checked.stage.tables.solve
        options = SolveOptions(table.exposure_share, table.smoothness, table.mode)
        outputs = output_sizes(checked)
        steps = [
            *solve_steps(calibrated, wishes, options, (), costs.scale(size for _, size in outputs.values())),
            publish_step(folder, outputs, [wish.name for wish in wishes],
                         stage=checked.stage.tables.stage.name, calibration=run.name, key=signing_key(checked)),
        ]  # fmt: skip
        with Journal(run) as journal:
            Runner(steps, journal, reporter=reporter).run("appearance", deadline=in_seconds(LONGEST_RUN_S, cancel))
    return {"bundle": str(current(folder / "bundles")), "appearances": ", ".join(wish.name for wish in wishes)}


def signing_key(checked: Checked) -> Path | None:
    """The stage's own key. Without one, bundles stay unsigned, which stage.toml must allow in so many words.

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
        remedy="Make one with `velatura keys STAGE`, which also tells which line to add to stage.toml.",
    )


def _check_own_key(path: Path, trust: Trust) -> None:
    # Before the work: otherwise the player alone would tell, once everything is solved.
    public = bytes(load_signing_key(path).verify_key)
    if public in trust.revoked:
        problem, remedy = "is revoked", f"Move {path} away, make a new key with `velatura keys STAGE`, and trust that."
    elif public not in trust.keys and (trust.keys or not trust.allow_unsigned):
        problem, remedy = "is not trusted", f'Add "{public.hex()}" to trusted_keys under [bundle] in stage.toml.'
    else:
        return
    raise UsageError("signing-key-refused", what=f"The stage's own signing key {problem} by stage.toml.", remedy=remedy)


def stage_trust(stage: Stage) -> Trust:
    """Which bundles stage.toml lets play."""
    table = stage.tables.bundle
    keys, revoked = (tuple(map(bytes.fromhex, keys)) for keys in (table.trusted_keys, table.revoked_keys))
    return Trust(keys, table.allow_unsigned, revoked)


def finished_calibration(stage: Path) -> Path:
    """The newest run folder whose calibration is complete. Raises UsageError("not-calibrated")."""
    for folder in sorted((stage / "runs").glob("*"), reverse=True):
        if not (folder / Journal.FILE).exists():
            continue
        with Journal(folder) as journal:
            if "calibrated" in journal.steps():
                return folder
    raise UsageError(
        "not-calibrated",
        what="This stage has no finished calibration.",
        remedy="Run `velatura calibrate` on it first.",
    )


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


def play(
    *, stage: Path, name: str, seconds: float | None, reporter: Reporter, cancel: threading.Event
) -> Mapping[str, Any]:
    """Light the projectors and show an appearance of the installed bundle, for ``seconds`` or until stopped.

    Raises UsageError("nothing-installed"), DeviceRefused for a name that the bundle does not have.
    """
    checked = check_stage(stage)
    folder = checked.stage.folder
    if current(folder / "bundles") is None:
        raise UsageError(
            "nothing-installed",
            what="No bundle is installed on this stage.",
            remedy="Run `velatura appearance` on it first.",
        )
    run_on_stage(
        checked, lambda rig, _: _playing(rig, name=name, seconds=seconds), name="play", reporter=reporter, cancel=cancel
    )
    return {"played": name}


def _playing(rig: Rig, *, name: str, seconds: float | None) -> Sequence[Step]:
    def show(context: Context) -> Sequence[Path]:
        display = bundle_display(rig)
        display.load_bundle(rig.stage / "bundles" / "current", deadline=context.deadline.within(20))
        display.play(name, deadline=context.deadline.within(20))
        until = in_seconds(LONGEST_RUN_S if seconds is None else seconds)
        while not until.passed:
            context.advance(0.0 if seconds is None else 1 - until.left_s() / max(seconds, 1e-9), name)
            context.deadline.sleep(min(0.5, until.left_s()))
        display.stop(deadline=context.deadline.within(20))
        return ()

    return [Step("play", show, title=f"Playing {name}", enter=Event.PLAY, leave=Event.PAUSE, always=True)]
