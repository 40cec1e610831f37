"""Everything that can be asked of a kiosk: one table, from which forms, API and its document are all made."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from controller.errors import UsageError
from controller.panel.account_operations import ACCOUNT_COMMANDS, ACCOUNT_QUESTIONS
from controller.panel.accounts import Role
from controller.panel.context import Panel, Values
from controller.panel.fields import NAME, Field
from controller.panel.kiosk import ComputeSettings, Schedule, ScheduleRow
from controller.panel.operation import BytesAnswer, FileAnswer, Operation, done, plain
from controller.panel.uploads import KEY

APPEARANCE: Final = Field("name", "an appearance's name, 1 to 64 letters, digits, spaces, dots, dashes", pattern=NAME)
TIME: Final = r"^(([01][0-9]|2[0-3]):[0-5][0-9])?$"
DAY: Final = r"^(mon|tue|wed|thu|fri|sat|sun|20[0-9]{2}-[01][0-9]-[0-3][0-9])$"
ROW: Final = (
    Field("day", "mon to sun, or a date as 2026-12-24", pattern=DAY, longest=10),
    Field("opens", "a time as 10:00; left out: closed", pattern=TIME, longest=5, required=False),
    Field("closes", "a time as 18:00; left out: closed", pattern=TIME, longest=5, required=False),
    Field("appearance", "an appearance's name; left out: the last one", pattern=f"^({NAME[1:-1]})?$", required=False),
)
SCHEDULE: Final = (
    Field("time_zone", "a time zone as Europe/Vienna", pattern=r"^[A-Za-z][A-Za-z0-9_+/-]{1,63}$"),
    Field("drift_check", "the time of the nightly check as 03:00", pattern=TIME, longest=5, required=False),
    Field("rows", "the opening hours, at most 400 rows", kind="rows", most=400, columns=ROW),
)
TARGET: Final = Field("target", "the key of an uploaded target", pattern=KEY, longest=24)
SETTINGS: Final = Field("text", "the text of stage.toml", longest=1 << 20)
RUN: Final = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,95}$"


def _events(panel: Panel, values: Values) -> Any:
    rows = panel.kiosk.events(values.get("after", 0))
    if "level" in values:
        rows = [row for row in rows if row.level == values["level"]]
    return plain(list(rows)[-values.get("most", 500) :])


def _recalibrate(panel: Panel, values: Values) -> Any:
    return plain(panel.kiosk.recalibrate(values["kind"], values.get("projector")))


def _compute(panel: Panel, values: Values) -> Any:
    target = panel.targets.path(values["target"])
    return plain(panel.kiosk.compute(values["name"], target, ComputeSettings(values.get("brightness"))))


def _set_schedule(panel: Panel, values: Values) -> None:
    rows = tuple(
        ScheduleRow(row["day"], row.get("opens", ""), row.get("closes", ""), row.get("appearance", ""))
        for row in values["rows"]
    )
    panel.kiosk.set_schedule(Schedule(values["time_zone"], rows, values.get("drift_check", "")))


def _camera(panel: Panel, _: Values) -> BytesAnswer:
    jpeg = panel.kiosk.camera_picture()
    if jpeg is None:
        raise UsageError(
            "picture-unknown",
            what="The camera shows no picture now.",
            remedy="Look at the camera's line on the first page.",
        )
    return BytesAnswer(jpeg, "image/jpeg")


def picture_answer(path: Path | None) -> FileAnswer:
    """A picture that the kiosk made. Raises UsageError("picture-unknown") where it is not there."""
    types = {".png": "image/png", ".jpg": "image/jpeg"}
    if path is None or path.suffix not in types or not path.is_file():
        raise UsageError("picture-unknown", what="There is no such picture.", remedy="Load the page again.")
    return FileAnswer(path, types[path.suffix])


def _run_picture(panel: Panel, values: Values) -> FileAnswer:
    return picture_answer(panel.kiosk.results(values["run"]).pictures.get(values["picture"]))


def _preview(panel: Panel, values: Values) -> FileAnswer:
    found = [row.preview for row in panel.kiosk.appearances() if row.name == values["name"]]
    return picture_answer(found[0] if found else None)


def _compared_picture(panel: Panel, values: Values) -> FileAnswer:
    found = [one for one in panel.kiosk.comparisons() if one.name == values["name"]]
    return picture_answer(found[0].pictures.get(values["picture"]) if found else None)


def _saved(path: Path) -> FileAnswer:
    return FileAnswer(path, "application/octet-stream", path.name)


VIEWER, OPERATOR, TECHNICIAN = Role.VIEWER, Role.OPERATOR, Role.TECHNICIAN
_NAME_IN_PATH: Final = Field("name", APPEARANCE.about, pattern=NAME, where="path")
_RUN_IN_PATH: Final = Field("run", "a run's name", pattern=RUN, longest=96, where="path")
_PICTURE_IN_PATH: Final = Field(
    "picture", "before, target, achieved, error or resolution", where="path",
    choices=("before", "target", "achieved", "error", "resolution"),
)  # fmt: skip
_FILE: Final = "application/octet-stream"

QUESTIONS: Final = (
    Operation("state", "GET", "/state", VIEWER, "Everything on the first page", lambda p, v: plain(p.kiosk.snapshot())),
    Operation(
        "events", "GET", "/events", VIEWER, "The event log, oldest first", _events,
        (
            Field("after", "an event's number: only later ones", "integer", False, "query", most=1e12),
            Field("level", "only this level", required=False, where="query", choices=("info", "warning", "error")),
            Field("most", "how many, the newest", "integer", False, "query", least=1, most=2000),
        ),
    ),
    Operation("appearances", "GET", "/appearances", VIEWER, "All appearances",
              lambda p, v: plain(p.kiosk.appearances())),
    Operation("preview", "GET", "/appearances/{name}/preview", VIEWER, "How it will look", _preview,
              (_NAME_IN_PATH,), "image/png"),
    Operation("comparisons", "GET", "/comparisons", VIEWER, "What the appearances achieve, as photographed",
              lambda p, v: plain(p.kiosk.comparisons())),
    Operation("comparison-picture", "GET", "/appearances/{name}/pictures/{picture}", VIEWER,
              "A picture of what an appearance achieves", _compared_picture,
              (_NAME_IN_PATH, _PICTURE_IN_PATH), "image/png"),
    Operation("lamp-history", "GET", "/lamps", VIEWER, "Each lamp's hours and strikes at the end of its last days",
              lambda p, v: plain(p.kiosk.lamp_history())),
    Operation("schedule", "GET", "/schedule", VIEWER, "Opening hours", lambda p, v: plain(p.kiosk.schedule())),
    Operation("runs", "GET", "/runs", VIEWER, "Runs with results, newest first", lambda p, v: list(p.kiosk.runs())),
    Operation("results", "GET", "/runs/{run}", VIEWER, "Grade and figures of a run",
              lambda p, v: plain(p.kiosk.results(v["run"])), (_RUN_IN_PATH,)),
    Operation("report", "GET", "/runs/{run}/report", VIEWER, "A run's report, one HTML file",
              lambda p, v: FileAnswer(p.kiosk.report(v["run"]), "text/html", f"report-{v['run']}.html"),
              (_RUN_IN_PATH,), "text/html"),
    Operation("run-picture", "GET", "/runs/{run}/pictures/{picture}", VIEWER, "A picture of a run", _run_picture,
              (_RUN_IN_PATH, _PICTURE_IN_PATH), "image/png"),
    Operation("camera", "GET", "/camera", VIEWER, "What the camera sees", _camera, media="image/jpeg"),
    Operation("target-picture", "GET", "/targets/{target}", OPERATOR, "An uploaded target, as we encoded it",
              lambda p, v: picture_answer(p.targets.path(v["target"])),
              (Field("target", TARGET.about, pattern=KEY, longest=24, where="path"),), "image/png"),
    Operation("feasibility", "GET", "/targets/{target}/feasibility", OPERATOR, "Where the target can't be reached",
              lambda p, v: picture_answer(p.kiosk.feasibility(p.targets.path(v["target"]))),
              (Field("target", TARGET.about, pattern=KEY, longest=24, where="path"),), "image/png"),
    Operation("aiming", "GET", "/aiming", TECHNICIAN, "Coverage, focus and exposure now",
              lambda p, v: plain(p.kiosk.aiming())),
    Operation("aiming-picture", "GET", "/aiming/picture", TECHNICIAN, "The object, and what is wrong where",
              lambda p, v: picture_answer(p.kiosk.aiming().picture), media="image/png"),
    Operation("settings", "GET", "/settings", TECHNICIAN, "The text of stage.toml",
              lambda p, v: {"text": p.kiosk.settings()}),
    *ACCOUNT_QUESTIONS,
)  # fmt: skip
"""What only looks."""

COMMANDS: Final = (
    Operation("recalibrate", "POST", "/recalibrations", OPERATOR, "Begin a calibration", _recalibrate,
              (Field("kind", "full or quick", choices=("full", "quick")),
               Field("projector", "only this projector", required=False, pattern=r"^[^\u0000-\u001f\u007f/\\]+$")),
              then="/", said="The recalibration has begun."),
    Operation("cancel", "POST", "/cancel", OPERATOR, "End the running job at its next safe point",
              done(lambda p, v: p.kiosk.cancel()), then="/", said="The job ends at its next safe point."),
    Operation("start", "POST", "/start", OPERATOR, "Lamps on, and play", done(lambda p, v: p.kiosk.start()),
              then="/", said="The stage opens."),
    Operation("stop", "POST", "/stop", OPERATOR, "Stop playing, and cool down", done(lambda p, v: p.kiosk.stop()),
              then="/", said="The stage closes; the lamps cool down."),
    Operation("play", "POST", "/play", OPERATOR, "Show this appearance now",
              done(lambda p, v: p.kiosk.play(v["name"])),
              (APPEARANCE,), then="/appearances", said="It is on the projectors."),
    Operation("identify", "POST", "/identify", OPERATOR, "Show each projector's name on it, or end that",
              done(lambda p, v: p.kiosk.identify(v["on"])),
              (Field("on", "true or false", "boolean"),), then="/", said="Look at the projectors."),
    Operation("upload-target", "POST", "/targets", OPERATOR, "Upload a picture as a target",
              lambda p, v: {"target": p.targets.add(v["file"])},
              (Field("file", "a PNG, JPEG, TIFF or WebP", "file"),), then="/appearances/new/{target}",
              said="This is what we read."),
    Operation("compute", "POST", "/appearances", OPERATOR, "Solve for an uploaded target", _compute,
              (APPEARANCE, TARGET, Field("brightness", "0.05 to 1; left out: the brightest that fits", "number", False,
                                         least=0.05, most=1)), then="/", said="The computation has begun."),
    Operation("compare", "POST", "/comparisons", OPERATOR, "Photograph what is installed, and compare with the targets",
              lambda p, v: plain(p.kiosk.compare(v.get("name"))),
              (Field("name", "only this appearance", required=False, pattern=NAME),), then="/",
              said="The appearances are shown and photographed, one after the other."),
    Operation("remove-appearance", "DELETE", "/appearances/{name}", TECHNICIAN, "Remove an appearance",
              done(lambda p, v: p.kiosk.remove_appearance(v["name"])), (_NAME_IN_PATH,),
              then="/appearances", said="Removed."),
    Operation("set-schedule", "PUT", "/schedule", OPERATOR, "Replace the opening hours", done(_set_schedule), SCHEDULE,
              then="/schedule", said="The schedule is in use."),
    Operation("doctor", "POST", "/doctor", OPERATOR, "Look for what is wrong", lambda p, v: plain(p.kiosk.doctor())),
    Operation("backup", "POST", "/backup", TECHNICIAN, "A file with settings, calibration and appearances",
              lambda p, v: _saved(p.kiosk.backup()), media=_FILE, then="/care"),
    Operation("restore", "POST", "/restore", TECHNICIAN, "Replace everything by a backup",
              done(lambda p, v: p.kiosk.restore(v["file"])), (Field("file", "a backup of ours", "file"),),
              then="/care", said="The backup is in use."),
    Operation("diagnostics", "POST", "/diagnostics", TECHNICIAN, "A file for whoever helps from afar",
              lambda p, v: _saved(p.kiosk.diagnostics()), media=_FILE, then="/care"),
    Operation("test-shots", "POST", "/aiming/shots", TECHNICIAN, "Photograph how projectors and camera are aimed",
              lambda p, v: plain(p.kiosk.test_shots()), then="/aiming", said="The test shots have begun."),
    Operation("check-settings", "POST", "/settings/check", TECHNICIAN, "Check a stage.toml without saving it",
              done(lambda p, v: p.kiosk.validate_settings(v["text"])), (SETTINGS,)),
    Operation("save-settings", "PUT", "/settings", TECHNICIAN, "Check stage.toml, save it, take it into use",
              done(lambda p, v: p.kiosk.save_settings(v["text"])), (SETTINGS,), then="/settings",
              said="The settings are in use."),
    Operation("find-devices", "POST", "/devices/found", TECHNICIAN, "Search for devices",
              lambda p, v: plain(p.kiosk.find_devices())),
    Operation("try-device", "POST", "/devices/tried", TECHNICIAN, "Ask a found device who it is",
              lambda p, v: plain(p.kiosk.try_device(v["key"])),
              (Field("key", "the key of a found device", longest=256),)),
    *ACCOUNT_COMMANDS,
)  # fmt: skip
"""What changes or costs something."""

OPERATIONS: Final = (*QUESTIONS, *COMMANDS)
