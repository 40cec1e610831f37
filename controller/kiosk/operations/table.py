"""The table of operations. A new one is a declaration here, and a method of ``StageKiosk`` (of ``FolderKiosk`` where it
can be done offline).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from controller.kiosk.operations.accounts import ACCOUNT_OPERATIONS
from controller.kiosk.operations.fields import NAME, Field, Flag
from controller.kiosk.operations.operation import Answer, Effect, Operation, Values
from controller.kiosk.roles import Role
from controller.kiosk.values import Schedule, ScheduleRow

VIEWER, OPERATOR, TECHNICIAN = Role.VIEWER, Role.OPERATOR, Role.TECHNICIAN
LOOKS, SHOWS, CHANGES, WORKS = Effect.LOOKS, Effect.SHOWS, Effect.CHANGES, Effect.WORKS
_ABOUT_NAME: Final = "an appearance's name, 1 to 64 letters, digits, spaces, dots, dashes"
APPEARANCE: Final = Field("name", _ABOUT_NAME, pattern=NAME, names="appearance")
NEW_NAME: Final = Field("name", "a name of 1 to 64 letters, digits, - and _, a letter or digit first",
                        pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$", names="appearance")  # fmt: skip
"""As stage.toml allows it."""
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
TARGET_KEY: Final = r"^[0-9a-f]{24}$"
TARGET: Final = Field("target", "the key of an uploaded target", "target", pattern=TARGET_KEY, longest=24,
                      metavar="PNG")  # fmt: skip
FIT: Final = Field(
    "fit", "how a picture of another size fits the camera's view: fit (whole), fill (cut at the edges) or crop (its "
    "own pixels); left out: fit", required=False, choices=("fit", "fill", "crop"),
)  # fmt: skip
SETTINGS: Final = Field("text", "the text of stage.toml", longest=1 << 20)
RUN: Final = Field("run", "a run's name", pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,95}$", longest=96)
_KINDS: Final = ("before", "target", "achieved", "error", "resolution")
PICTURE: Final = Field("picture", "before, target, achieved, error or resolution", choices=_KINDS)
MOST_EVENTS: Final = 2000
EVENTS: Final = (
    Field("after", "an event's number: only later ones", "integer", False, most=1e12),
    Field("level", "only this level", required=False, choices=("info", "warning", "error")),
    Field("most", "how many, the newest", "integer", False, least=1, most=MOST_EVENTS),
)
_FULL_OR_QUICK: Final = Field(
    "kind", "full or quick", choices=("full", "quick"),
    flag=Flag("--quick", "Look what has changed, and repeat only that.", "quick", "full"),
)  # fmt: skip
_ONE_PROJECTOR: Final = Field("projector", "only this projector", required=False,
                              pattern=r"^[^\u0000-\u001f\u007f/\\]+$", names="projector")  # fmt: skip
_NAMING: Final = Field("on", "true or false", "boolean", flag=Flag("--off", "Back to what was shown.", False, True))


def _after(values: Values) -> Mapping[str, Any]:
    return {"after": values.get("after", 0)}


def _chosen_events(rows: Any, values: Values) -> Any:
    level = values.get("level")
    return [row for row in rows if level in (None, row.level)][-values.get("most", MOST_EVENTS) :]


def _schedule_of(values: Values) -> Mapping[str, Any]:
    rows = tuple(
        ScheduleRow(row["day"], row.get("opens", ""), row.get("closes", ""), row.get("appearance", ""))
        for row in values["rows"]
    )
    return {"schedule": Schedule(values["time_zone"], rows, values.get("drift_check", ""))}


def _its_picture(answer: Any, values: Values) -> Any:
    """The picture of one answer, or of the one in a list that has the name."""
    if isinstance(answer, list | tuple):
        answer = next((one for one in answer if one.name == values["name"]), None)
    return None if answer is None else answer.pictures.get(values["picture"])


def _preview(answer: Any, values: Values) -> Any:
    return next((one.preview for one in answer if one.name == values["name"]), None)


def _nothing(values: Values) -> Mapping[str, Any]:
    return {}


def _uploaded(values: Values) -> Mapping[str, Any]:
    return {"uploaded": values["file"], "fit": values.get("fit", "fit")}


def _only_run(values: Values) -> Mapping[str, Any]:
    return {"run": values["run"]}


OPERATIONS: Final[tuple[Operation, ...]] = (
    # -- what the stage does now
    Operation("state", "Everything on the first page", VIEWER, LOOKS, call="snapshot", at_socket="status",
              within="status"),
    Operation("events", "The event log, oldest first", VIEWER, LOOKS, EVENTS, take=_after, part=_chosen_events,
              offline=True, within="events"),
    Operation("start", "Lamps on, and play", OPERATOR, SHOWS, answer=Answer.NOTHING, verb="open",
              said="The stage opens.",
              more="It stays open until the schedule says otherwise the next time."),
    Operation("stop", "Stop playing, and cool down", OPERATOR, SHOWS, answer=Answer.NOTHING, verb="close",
              said="The stage closes; the lamps cool down.",
              more="It stays closed until the schedule says otherwise the next time."),
    Operation("play", "Show this appearance now", OPERATOR, SHOWS, (APPEARANCE,), Answer.NOTHING, command="show",
              said="{name} is played from now on.", more="A closed stage opens."),
    Operation("identify", "Show each projector's name on it, or end that", OPERATOR, SHOWS, (_NAMING,),
              Answer.NOTHING, said="Look at the projectors."),
    Operation("camera", "What the camera sees", VIEWER, LOOKS, answer=Answer.JPEG, call="camera_picture",
              at_socket="camera-picture", within="aim"),
    Operation("lamp-history", "Each lamp's hours and strikes at the end of its last days", VIEWER, LOOKS, offline=True,
              http=("GET", "/lamps"), command="lamps"),
    # -- work
    Operation("recalibrate", "Begin a calibration", OPERATOR, WORKS, (_FULL_OR_QUICK, _ONE_PROJECTOR),
              http=("POST", "/recalibrations"), said="The recalibration has begun."),
    Operation("cancel", "End the running job at its next safe point", OPERATOR, CHANGES, answer=Answer.NOTHING,
              said="The job ends at its next safe point."),
    Operation("compute", "Solve for an uploaded target", OPERATOR, WORKS, (NEW_NAME, TARGET, FIT),
              http=("POST", "/appearances"), said="The computation has begun.",
              more="The target becomes an appearance of stage.toml, and is installed."),
    Operation("compare", "Photograph what is installed, and compare with the targets", OPERATOR, WORKS,
              (Field("name", "only this appearance", required=False, pattern=NAME, names="appearance", argument=True),),
              http=("POST", "/comparisons"), said="The appearances are shown and photographed, one after the other."),
    Operation("test-shots", "Photograph how projectors and camera are aimed", TECHNICIAN, WORKS,
              http=("POST", "/aiming/shots"), within="aim", said="The test shots have begun."),
    # -- appearances
    Operation("appearances", "All appearances", VIEWER, LOOKS, offline=True),
    Operation("preview", "How it will look", VIEWER, LOOKS, (APPEARANCE,), Answer.PICTURE, call="appearances",
              take=_nothing, part=_preview, offline=True, http=("GET", "/appearances/{name}/preview"),
              within="bundle inspect"),
    Operation("remove-appearance", "Remove an appearance", TECHNICIAN, CHANGES, (APPEARANCE,), Answer.NOTHING,
              http=("DELETE", "/appearances/{name}"), command="remove",
              said="{name} is removed with the next bundle.",
              more="One that plays now, or that the schedule names, can't be removed."),
    Operation("upload-target", "Upload a picture as a target", OPERATOR, CHANGES,
              (Field("file", "a PNG, JPEG, TIFF or WebP", "file"), FIT), holder="targets", call="add",
              take=_uploaded, part=lambda key, values: {"target": key},
              http=("POST", "/targets"), within="compute", said="This is what we read."),
    Operation("target-picture", "An uploaded target, as we encoded it", OPERATOR, LOOKS,
              (Field("target", TARGET.about, pattern=TARGET_KEY, longest=24),), Answer.PICTURE, holder="targets",
              call="path", take=lambda values: {"key": values["target"]}, http=("GET", "/targets/{target}"),
              within="compute"),
    Operation("feasibility", "Where the target can't be reached", OPERATOR, LOOKS, (TARGET,), Answer.PICTURE,
              offline=True, http=("GET", "/targets/{target}/feasibility")),
    # -- results
    Operation("comparisons", "What the appearances achieve, as photographed", VIEWER, LOOKS, offline=True,
              within="results"),
    Operation("comparison-picture", "A picture of what an appearance achieves", VIEWER, LOOKS, (APPEARANCE, PICTURE),
              Answer.PICTURE, call="comparisons", take=_nothing, part=_its_picture, offline=True,
              http=("GET", "/appearances/{name}/pictures/{picture}"), within="results"),
    Operation("runs", "Runs with results, newest first", VIEWER, LOOKS, offline=True, within="results"),
    Operation("results", "Grade and figures of a run", VIEWER, LOOKS, (RUN,), offline=True, http=("GET", "/runs/{run}"),
              within="results"),
    Operation("run-picture", "A picture of a run", VIEWER, LOOKS, (RUN, PICTURE), Answer.PICTURE, call="results",
              take=_only_run, part=_its_picture, offline=True, http=("GET", "/runs/{run}/pictures/{picture}"),
              within="results"),
    Operation("report", "A run's report, one HTML file", VIEWER, LOOKS, (RUN,), Answer.PAGE,
              http=("GET", "/runs/{run}/report"), within="report"),
    Operation("aiming", "Coverage, focus and exposure now", TECHNICIAN, LOOKS, within="aim"),
    Operation("aiming-picture", "The object, and what is wrong where", TECHNICIAN, LOOKS, answer=Answer.PICTURE,
              call="aiming", part=lambda aiming, values: aiming.picture, http=("GET", "/aiming/picture"),
              within="aim"),
    Operation("seen", "Take failures that somebody has seen out of the state", OPERATOR, CHANGES,
              (Field("number", "the newest one's number in the events; left out: all", "integer", False, most=1e12),),
              Answer.NOTHING, http=("POST", "/failures/seen"), said="The failures are marked as seen."),
    # -- what is set up
    Operation("schedule", "Opening hours", VIEWER, LOOKS, offline=True, within="schedule"),
    Operation("set-schedule", "Replace the opening hours", OPERATOR, CHANGES, SCHEDULE, Answer.NOTHING,
              take=_schedule_of, offline=True, http=("PUT", "/schedule"), within="schedule",
              said="The schedule is in use."),
    Operation("settings", "The text of stage.toml", TECHNICIAN, LOOKS, answer=Answer.TEXT, offline=True,
              within="settings"),
    Operation("check-settings", "Check a stage.toml without saving it", TECHNICIAN, LOOKS, (SETTINGS,), Answer.NOTHING,
              call="validate_settings", offline=True, http=("POST", "/settings/check"), at_socket="validate-settings",
              within="settings", said="They are right."),
    Operation("save-settings", "Check stage.toml, save it, take it into use", TECHNICIAN, CHANGES, (SETTINGS,),
              Answer.NOTHING, offline=True, http=("PUT", "/settings"), within="settings",
              said="The settings are in use."),
    # -- care
    Operation("doctor", "Look for what is wrong", OPERATOR, LOOKS, http=("POST", "/doctor"), within="doctor"),
    Operation("backup", "A file with settings, calibration and appearances", TECHNICIAN, LOOKS, answer=Answer.FILE,
              offline=True, http=("POST", "/backup"), more="Accounts and keys are not in it."),
    Operation("restore", "Replace everything by a backup", TECHNICIAN, CHANGES,
              (Field("backup", "a backup of ours", "file", metavar="FILE"),), Answer.NOTHING, offline=True,
              said="The backup is in use."),
    Operation("diagnostics", "A file for whoever helps from afar", TECHNICIAN, LOOKS, answer=Answer.FILE, offline=True,
              http=("POST", "/diagnostics"), more="Events, journals and states are in it; secrets and pictures not."),
    Operation("find-devices", "Search for devices", TECHNICIAN, LOOKS, http=("POST", "/devices/found"),
              within="doctor"),
    Operation("try-device", "Ask a found device who it is", TECHNICIAN, LOOKS,
              (Field("key", "the key of a found device", longest=256),), http=("POST", "/devices/tried"),
              within="doctor"),
    *ACCOUNT_OPERATIONS,
)  # fmt: skip

JOB: Final = Operation("job", "A job that was asked for, also when it has ended", VIEWER, LOOKS,
                       (Field("number", "the number that its beginning answered", "integer", most=1e12),))  # fmt: skip
"""For whoever follows a job at the socket; the state has the last one for everybody else."""
