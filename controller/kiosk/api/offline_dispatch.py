"""Commands on a stage: sent to the running kiosk, or done on its folder if none runs."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, Final

from controller.config import load_stage
from controller.core.errors import UsageError, VelaturaError, WorkError
from controller.core.text import printable
from controller.kiosk.api.control import call_kiosk, is_running, plain, user_name
from controller.kiosk.api.folder import FolderKiosk
from controller.kiosk.operations.accounts import Accounts
from controller.kiosk.operations.dispatch import local_values, offline_operation
from controller.kiosk.operations.operation import Effect, Operation
from controller.kiosk.schedule import check_schedule, expanded
from controller.kiosk.state import EventLevel
from controller.kiosk.store.bundle_store import BundleStore
from controller.kiosk.store.event_log import EventLog
from controller.kiosk.values import Schedule, ScheduleRow
from controller.run.progress import Phase, Progress, Reporter
from controller.stage.sessions.calibrations import stage_trust
from controller.stage.sessions.run import stage_lock
from hal.deadline import Cancelled
from hal.notices import Level, Notice

LEVELS: Final = ("info", "warning", "error")
LONG_S: Final = 600.0


def call(stage: Path, op: str, **arguments: Any) -> Any:
    """Ask the running kiosk, or do it here. Raises UsageError("not-serving") for operations that need a running one."""
    if is_running(stage):
        return call_kiosk(stage, op, timeout_s=LONG_S, **arguments)
    # A restore repairs a stage without settings, or with damaged ones, too.
    folder = stage.resolve() if op == "restore" else load_stage(stage).folder
    operation = offline_operation(op)
    if operation is None:
        remedy = "Start it with `velatura kiosk serve`."
        raise UsageError("not-serving", what="No kiosk runs on this stage.", remedy=remedy)
    values = local_values(operation, arguments)
    if operation.effect is Effect.LOOKS:
        return plain(operation.function(_holder(operation, folder), **values))
    # A starting kiosk reads these files before it answers, and would miss a change.
    with stage_lock(folder):
        who = f"User {user_name(os.getuid())}, while no kiosk ran"
        with operation.logged(partial(_record, folder), who, values):
            return plain(operation.function(_holder(operation, folder), **values))


def _record(folder: Path, code: str, text: str, level: EventLevel) -> None:
    """Add a line to the event log, as a running kiosk does."""
    with contextlib.closing(EventLog(folder / EventLog.FILE)) as log:
        log.add(Notice(code, text, "", Level(level)))


def _holder(operation: Operation, folder: Path) -> object:
    if operation.holder == "kiosk":
        return FolderKiosk(folder)
    from controller.kiosk.store.accounts import stage_accounts

    accounts = stage_accounts(folder)
    return Accounts(lambda: accounts)


def status_of(stage: Path) -> dict[str, Any]:
    """The running kiosk's state, or a state that says that none runs."""
    if is_running(stage):
        return dict(call_kiosk(stage, "status"))
    loaded = load_stage(stage)
    bundles = BundleStore(loaded.folder, stage_trust(loaded))
    reason = "No kiosk runs on this stage."
    return {"stage": loaded.tables.stage.name, "state": "off", "reason": reason, "devices": [], "playing": "",
            "appearances": list(bundles.names()), "serving": False}  # fmt: skip


def status_text(state: Mapping[str, Any]) -> str:
    """The state as text for a terminal; control characters of devices are removed."""
    lines = [f"{state['stage']}: {state['state']}" + (f" ({state['reason']})" if state["reason"] else "")]
    if state.get("playing"):
        lines.append(f"Playing {state['playing']}{', one of all in turn' if state.get('in_turn') else ''}.")
    lines += [f"Warning: {warning}" for warning in state.get("warnings", ())]
    for row in state["devices"]:
        values = ", ".join(f"{value['label']} {value['text']}" for value in row["values"])
        lines.append(f"  {row['kind']:<10} {row['name']:<12} {values}")
        if row["problem"]:
            lines.append(f"    {row['problem']} {row['remedy']}")
    job = state.get("job")
    if job and not job["ended"]:
        step = job["steps"][-1] if job["steps"] else {"title": "", "done": 0.0}
        now = job.get("waits") or f"{step['title']} {step['done']:.0%}"
        lines.append(f"{job['name']}: {now}")
    return "\n".join(map(printable, lines))


def changed_schedule(
    now: Mapping[str, Any], zone: str | None, hours: Sequence[str] | None, drift_check: str | None
) -> dict[str, Any]:
    """The schedule with the changes of a command line. Raises UsageError("schedule-wrong", "schedule-zone")."""
    rows = list(now["rows"])
    if hours is not None:
        rows = [asdict(row) for row in expanded([ScheduleRow(**_row(text)) for text in hours])]
    content: dict[str, Any] = {
        "time_zone": zone if zone is not None else now["time_zone"],
        "rows": rows,
        "drift_check": drift_check if drift_check is not None else now["drift_check"],
    }
    check_schedule(Schedule(content["time_zone"], tuple(ScheduleRow(**row) for row in rows), content["drift_check"]))
    return content


def _row(text: str) -> dict[str, str]:
    day, equals, span = text.partition("=")
    opens, dash, closes = span.partition("-")
    if not equals or (span != "closed" and not dash):
        raise UsageError("schedule-wrong", what=f"{text[:64]!r} is not a valid opening time.",
                         remedy="Write DAY=HH:MM-HH:MM or DAY=closed.")  # fmt: skip
    if span == "closed":
        opens = closes = ""
    return {"day": day, "opens": opens, "closes": closes, "appearance": ""}


def schedule_text(schedule: Mapping[str, Any]) -> str:
    """The schedule as text for a terminal."""
    lines = [f"Time zone {schedule['time_zone']}"]
    lines += [
        f"  {row['day']:<10} {row['opens']}-{row['closes']} {row['appearance']}"
        if row["opens"] else f"  {row['day']:<10} closed"
        for row in schedule["rows"]
    ]  # fmt: skip
    if not schedule["rows"]:
        lines.append("  always open")
    check = schedule["drift_check"]
    lines.append(f"Drift check at {check}" if check else "No nightly drift check")
    return "\n".join(map(printable, lines))


def aiming_text(aiming: Mapping[str, Any]) -> str:
    """The measurement as text for a terminal."""
    lines = [f"{row['projector']}: {row['coverage']:.0%} of the object, focus {row['focus']:.0%}"
             for row in aiming["projectors"]]  # fmt: skip
    lines.append(f"Lit by two or more {aiming['overlap']:.0%}, too dark {aiming['too_dark']:.0%}, "
                 f"too grazing {aiming['too_grazing']:.0%}")  # fmt: skip
    if not aiming["source"]:
        lines = ["Nothing has been measured yet. Take test shots: `velatura kiosk aim STAGE --shots`."]
    pictures = [f"Picture: {aiming['picture']}"] if aiming["picture"] else []
    return "\n".join(map(printable, [*lines, *aiming["hints"], *pictures]))


EVERY_S: Final = 0.5


def ask_and_follow(
    *,
    stage: Path,
    op: str,
    arguments: Mapping[str, Any],
    reporter: Reporter,
    cancel: threading.Event,
    every_s: float = EVERY_S,
) -> Mapping[str, Any]:
    """Start a job and return its result; ``cancel`` cancels the job, too.

    Raises UsageError("not-serving"), the kiosk's refusal of the job, WorkError("job-given-up") if it will never start
    (the lamps did not light, it was cancelled, the kiosk restarted), WorkError("job-failed") with the kiosk's own
    sentence, and Cancelled.
    """
    number, began_s = int(call_kiosk(stage, op, **arguments)["number"]), time.monotonic()
    last: object = None
    while True:
        job = call_kiosk(stage, "job", number=number)
        if job is not None and job["ended"]:
            return _ended(job)
        if job is not None and job["steps"] != last and job["steps"]:
            last = job["steps"]
            reporter.progress(_progress(job, time.monotonic() - began_s))
        if cancel.wait(every_s):
            with contextlib.suppress(VelaturaError):  # it may have ended in the meantime
                call_kiosk(stage, "cancel")
            raise Cancelled


def _ended(job: Mapping[str, Any]) -> Mapping[str, Any]:
    if job["failed"]:
        raise WorkError("job-failed", what=f"{job['name']}: {job['outcome']}",
                        remedy="See `velatura kiosk events` for the decisions and their reasons.")  # fmt: skip
    return {"job": job["name"], "outcome": job["outcome"], **({"run": job["run"]} if job["run"] else {})}


def _progress(job: Mapping[str, Any], elapsed_s: float) -> Progress:
    """The job lists only the steps so far, so the overall progress follows from the time left."""
    index, step = len(job["steps"]) - 1, job["steps"][-1]
    left_s = job["left_s"]
    share = 0.0 if left_s is None else elapsed_s / max(elapsed_s + left_s, 1e-6)
    phase = Phase.DONE if step["done"] >= 1 else Phase.RUNNING
    return Progress(step["title"], index, max(job["count"], index + 1), phase, share, step["done"], elapsed_s, left_s)
