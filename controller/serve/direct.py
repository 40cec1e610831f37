"""What a command asks of a stage: of the running kiosk, or of the folder itself where none runs."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from controller.app import stage_lock
from controller.calibrations import stage_trust, worst_grade
from controller.checking import check_stage
from controller.config import load_stage
from controller.errors import UsageError
from controller.panel.kiosk import Schedule, ScheduleRow
from controller.serve import archive, runs, settings
from controller.serve.account_ops import account_operations, stage_accounts
from controller.serve.control import ask, is_running, plain
from controller.serve.eventlog import EventLog
from controller.serve.hours import check_schedule
from controller.serve.lamp_history import LampHistory
from controller.serve.schedule_file import ScheduleFile
from controller.serve.stock import BundleStock
from controller.text import printable

_DIRECT: Final[dict[str, Callable[..., Any]]] = {}
LEVELS: Final = ("info", "warning", "error")
LONG_S: Final = 600.0


def call(stage: Path, op: str, **arguments: Any) -> Any:
    """Ask the running kiosk, or do it here. Raises UsageError("not-serving") for what only a running one can do."""
    if is_running(stage):
        return ask(stage, op, timeout_s=LONG_S, **arguments)
    folder = load_stage(stage).folder
    if op not in _DIRECT:
        raise UsageError("not-serving", what="No kiosk runs on this stage.", remedy="Start it with `velatura serve`.")
    return _DIRECT[op](folder, **arguments)


def _events(folder: Path, after: int = 0) -> Any:
    with contextlib.closing(EventLog(folder / EventLog.FILE)) as log:
        return plain(log.after(after))


def _set_schedule(folder: Path, time_zone: str, rows: list[dict[str, str]], drift_check: str) -> None:
    wanted = Schedule(time_zone, tuple(ScheduleRow(**row) for row in rows), drift_check)
    # A kiosk that begins has read its schedule before it answers: it would not know of this one.
    with stage_lock(folder):
        names = BundleStock(folder, stage_trust(load_stage(folder))).names()
        _schedule(folder).replace(wanted, names)


def _restore(folder: Path, backup: str) -> None:
    with stage_lock(folder):
        archive.restore(folder, Path(backup))


def _schedule(stage: Path) -> ScheduleFile:
    loaded = load_stage(stage)
    return ScheduleFile(loaded.folder, loaded.tables.schedule)


def status_of(stage: Path) -> dict[str, Any]:
    """The running kiosk's state, or that none runs."""
    if is_running(stage):
        return dict(ask(stage, "status"))
    loaded = load_stage(stage)
    stock = BundleStock(loaded.folder, stage_trust(loaded))
    reason = "No kiosk runs on this stage."
    return {"stage": loaded.tables.stage.name, "state": "off", "reason": reason, "devices": [], "playing": "",
            "appearances": list(stock.names()), "serving": False}  # fmt: skip


def status_text(state: Mapping[str, Any]) -> str:
    """For people: what devices said in it reaches no terminal as it came."""
    lines = [f"{state['stage']}: {state['state']}" + (f" ({state['reason']})" if state["reason"] else "")]
    if state.get("playing"):
        lines.append(f"Playing {state['playing']}.")
    for row in state["devices"]:
        values = ", ".join(f"{value['label']} {value['text']}" for value in row["values"])
        lines.append(f"  {row['kind']:<10} {row['name']:<12} {values}")
        if row["problem"]:
            lines.append(f"    {row['problem']} {row['remedy']}")
    job = state.get("job")
    if job and not job["ended"]:
        step = job["steps"][-1] if job["steps"] else {"title": "", "done": 0.0}
        lines.append(f"{job['name']}: {step['title']} {step['done']:.0%}")
    return "\n".join(map(printable, lines))


def changed_schedule(
    now: Mapping[str, Any], zone: str | None, hours: Sequence[str] | None, drift_check: str | None
) -> dict[str, Any]:
    """The schedule with what a command line says. Raises UsageError("schedule-wrong", "schedule-zone")."""
    rows = list(now["rows"]) if hours is None else [_row(text) for text in hours]
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
        raise UsageError("schedule-wrong", what=f"{text[:64]!r} are no opening hours.",
                         remedy="Write DAY=HH:MM-HH:MM or DAY=closed.")  # fmt: skip
    if span == "closed":
        opens = closes = ""
    return {"day": day, "opens": opens, "closes": closes, "appearance": ""}


def schedule_text(schedule: Mapping[str, Any]) -> str:
    """For people."""
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


def _appearances(folder: Path) -> Any:
    index = (stock := BundleStock(folder, stage_trust(load_stage(folder)))).index(stock.bundle())
    if index is None:
        return []
    names = [one.name for one in index.appearances]
    errors = {one.name: one.history[0].delta_e for one in runs.comparisons(folder, names)}
    return [
        {"name": name, "made_unix_s": index.created_unix_s, "delta_e": errors.get(name), "playing": False}
        for name in names
    ]


def _comparisons(folder: Path) -> Any:
    return plain(runs.comparisons(folder, BundleStock(folder, stage_trust(load_stage(folder))).names()))


def _settings(folder: Path, text: str) -> None:
    with stage_lock(folder):
        settings.save(folder, text)


def _feasibility(folder: Path, target: str) -> str:
    from controller.serve.aim import feasibility_map

    return str(feasibility_map(folder, Path(target)))


def _results(folder: Path, run: str) -> Any:
    return plain(runs.results(folder, run, worst_grade(check_stage(folder))))


def _account(name: str) -> Callable[..., Any]:
    def do(folder: Path, **arguments: Any) -> Any:
        with stage_lock(folder):
            accounts = stage_accounts(folder)
            return account_operations(lambda: accounts, lambda _: None)[name](**arguments)

    return do


def aiming_text(found: Mapping[str, Any]) -> str:
    """For people."""
    lines = [f"{one['projector']}: {one['coverage']:.0%} of the object, focus {one['focus']:.0%}"
             for one in found["projectors"]]  # fmt: skip
    lines.append(f"Lit by two or more {found['overlap']:.0%}, too dark {found['too_dark']:.0%}, "
                 f"too grazing {found['too_grazing']:.0%}")  # fmt: skip
    if not found["source"]:
        lines = ["Nothing has been measured yet. Take test shots: `velatura aim STAGE --shots`."]
    pictures = [f"Picture: {found['picture']}"] if found["picture"] else []
    return "\n".join(map(printable, [*lines, *found["hints"], *pictures]))


_DIRECT.update(
    {
        **{name: _account(name) for name in account_operations(lambda: stage_accounts(Path()), lambda _: None)},
        "appearances": _appearances,
        "lamp-history": lambda folder: plain(LampHistory(folder).days()),
        "comparisons": _comparisons,
        "runs": lambda folder: list(runs.names(folder)),
        "results": _results,
        "settings": settings.text,
        "validate-settings": lambda folder, text: settings.validate(text),
        "save-settings": _settings,
        "feasibility": _feasibility,
        "events": _events,
        "schedule": lambda folder: plain(_schedule(folder).now),
        "set-schedule": _set_schedule,
        "backup": lambda folder: str(archive.backup(folder)),
        "diagnostics": lambda folder: str(archive.diagnostics(folder, {"state": "no kiosk runs"})),
        "restore": _restore,
    }
)
