"""The table of operations. A new one needs a declaration here and a method of ``StageKiosk`` (of ``FolderKiosk`` if it
works offline).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from controller.kiosk.decide.days import ALLOWED as ALLOWED_DAYS
from controller.kiosk.decide.days import expanded
from controller.kiosk.operations.accounts import ACCOUNT_OPERATIONS
from controller.kiosk.operations.fields import NAME, Field, Flag
from controller.kiosk.operations.operation import Answer, Effect, Operation, Values
from controller.kiosk.roles import Role
from controller.kiosk.values import NewTarget, Schedule, ScheduleRow

VIEWER, OPERATOR, TECHNICIAN = Role.VIEWER, Role.OPERATOR, Role.TECHNICIAN
LOOKS, SHOWS, CHANGES, WORKS = Effect.LOOKS, Effect.SHOWS, Effect.CHANGES, Effect.WORKS
_ABOUT_NAME: Final = "an appearance's name, 1 to 64 letters, digits, spaces, dots, dashes"
APPEARANCE: Final = Field("name", _ABOUT_NAME, pattern=NAME, names="appearance")
NEW_NAME: Final = Field("name", "a name of 1 to 64 letters, digits, - and _; the first is a letter or digit",
                        pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$", names="appearance")  # fmt: skip
"""The same rule as in stage.toml."""
TIME: Final = r"^(([01][0-9]|2[0-3]):[0-5][0-9])?$"
DAY: Final = r"^[^\u0000-\u001f\u007f]+$"
"""Which days it names, ``decide.days`` finds out."""
ROW: Final = (
    Field("day", ALLOWED_DAYS, pattern=DAY, longest=64),
    Field("opens", "a time such as 10:00; default: closed", pattern=TIME, longest=5, required=False),
    Field("closes", "a time such as 18:00; default: closed", pattern=TIME, longest=5, required=False),
    Field(
        "appearance",
        "an appearance's name, or * for all in turn; default: the last one",
        pattern=rf"^({NAME[1:-1]}|\*)?$",
        required=False,
    ),
)
SCHEDULE: Final = (
    Field("time_zone", "a time zone such as Europe/Vienna", pattern=r"^[A-Za-z][A-Za-z0-9_+/-]{1,63}$"),
    Field("drift_check", "the time of the nightly check, such as 03:00", pattern=TIME, longest=5, required=False),
    Field("rows", "the opening hours, at most 400 rows", kind="rows", most=400, columns=ROW),
)
TARGET_KEY: Final = r"^[0-9a-f]{24}$"
TARGET: Final = Field("target", "the key of an uploaded target", "target", pattern=TARGET_KEY, longest=24,
                      metavar="PNG")  # fmt: skip
FIT: Final = Field(
    "fit", "how a picture of another size is fitted to the camera's view: fit (whole picture), fill (edges are cut), "
    "crop (original pixels) or wrap (around the object); default: fit", required=False,
    choices=("fit", "fill", "crop", "wrap"),
)  # fmt: skip
SETTINGS: Final = Field("text", "the text of stage.toml", longest=1 << 20)
RUN: Final = Field("run", "a run's name", pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,95}$", longest=96)
_KINDS: Final = ("before", "target", "achieved", "error", "resolution")
PICTURE: Final = Field("picture", "before, target, achieved, error or resolution", choices=_KINDS)
REACH_PICTURE: Final = Field("picture", "target, result or map", choices=("target", "result", "map"))
MOST_EVENTS: Final = 2000
EVENTS: Final = (
    Field("after", "only events after this number", "integer", False, most=1e12),
    Field("level", "only this level", required=False, choices=("info", "warning", "error")),
    Field("most", "only this many of the newest events", "integer", False, least=1, most=MOST_EVENTS),
)
OUTLINE: Final = Field(
    "outline", "regions as lists of corners [x, y], each from 0 to 1 of the picture, such as [[[0,0],[1,0],[1,1]]]",
    longest=1 << 16,
)  # fmt: skip
SCENE: Final = Field("scene", "a scene's name, as `scenes` lists it", pattern=r"^[A-Za-z0-9][A-Za-z0-9 ._-]{0,47}$",
                     longest=48)  # fmt: skip
_FULL_OR_QUICK: Final = Field(
    "kind", "full or quick", choices=("full", "quick"),
    flag=Flag("--quick", "Redo only what changed since the last calibration.", "quick", "full"),
)  # fmt: skip
PROJECTOR: Final = Field("projector", "a projector's name", pattern=r"^[^\u0000-\u001f\u007f/\\]+$", names="projector")
_ONE_PROJECTOR: Final = Field("projector", "only this projector", required=False,
                              pattern=r"^[^\u0000-\u001f\u007f/\\]+$", names="projector")  # fmt: skip
_IDENTIFYING: Final = Field(
    "on", "true or false", "boolean", flag=Flag("--off", "Stop identifying and resume.", False, True)
)

FADE: Final = Field("fade_s", "seconds of the fade, 0 to 600; default: as the playlist says", "number", False, most=600)
PERCENT: Final = Field("percent", "share of the light, 0 to 100", "number", most=100)
_BLACK: Final = Field("on", "true or false", "boolean", flag=Flag("--off", "Show the picture again.", False, True))
_PAUSE: Final = Field("on", "true or false", "boolean", flag=Flag("--off", "Continue.", False, True))


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
    return {"schedule": Schedule(values["time_zone"], expanded(rows), values.get("drift_check", ""))}


def _its_picture(answer: Any, values: Values) -> Any:
    """The chosen picture of a result, or of the result in a list that has the name."""
    if isinstance(answer, list | tuple):
        answer = next((item for item in answer if item.name == values["name"]), None)
    return None if answer is None else answer.pictures.get(values["picture"])


def _preview(answer: Any, values: Values) -> Any:
    return next((item.preview for item in answer if item.name == values["name"]), None)


def _nothing(values: Values) -> Mapping[str, Any]:
    return {}


def _uploaded(values: Values) -> Mapping[str, Any]:
    return {"uploaded": values["file"], "fit": values.get("fit", "fit")}


def _only_target(values: Values) -> Mapping[str, Any]:
    return {"target": values["target"]}


def _only_run(values: Values) -> Mapping[str, Any]:
    return {"run": values["run"]}


OPERATIONS: Final[tuple[Operation, ...]] = (
    # -- the stage now
    Operation("state", "The state, as on the first page", VIEWER, LOOKS, call="snapshot", at_socket="status",
              within="kiosk status"),
    Operation("events", "The event log, oldest first", VIEWER, LOOKS, EVENTS, take=_after, part=_chosen_events,
              offline=True, within="kiosk events"),
    Operation("start", "Switch the lamps on, and play", OPERATOR, SHOWS, answer=Answer.NOTHING, verb="open",
              said="The stage opens.",
              more="It stays open until the next scheduled change."),
    Operation("stop", "Stop playing, and cool the lamps down", OPERATOR, SHOWS, answer=Answer.NOTHING, verb="close",
              said="The stage closes; the lamps cool down.",
              asks="Close the stage? It becomes black, and the lamps have to cool before they can be lit again.",
              more="It stays closed until the next scheduled change."),
    Operation("play", "Show this appearance now", OPERATOR, SHOWS, (APPEARANCE, FADE), Answer.NOTHING, command="show",
              said="{name} plays now.", more="A closed stage opens."),
    Operation("rotate", "Show all appearances in turn, with their times and fades", OPERATOR, SHOWS,
              answer=Answer.NOTHING, verb="rotate", said="All appearances are shown in turn.",
              more="Their times are shown_s and fade_s in stage.toml. A closed stage opens."),
    Operation("next", "Show the next appearance", OPERATOR, SHOWS, (FADE,), Answer.NOTHING,
              said="The next appearance is shown.", more="The order is that of the playlist, else of the bundle."),
    Operation("black", "Show black with the lamps lit, or the picture again", OPERATOR, SHOWS, (_BLACK, FADE),
              Answer.NOTHING, said="Done.", more="It ends when an appearance is chosen, or when the stage closes."),
    Operation("pause", "Stay at the present appearance, or continue", OPERATOR, SHOWS, (_PAUSE,), Answer.NOTHING,
              said="Done.", more="It ends when an appearance is chosen, or when the stage closes."),
    Operation("brightness", "Show a share of the light", OPERATOR, SHOWS, (PERCENT,), Answer.NOTHING,
              said="The brightness is {percent} %.", more="It is 100 again when the stage closes."),
    Operation("identify", "Show each projector's name on it, or stop that", OPERATOR, SHOWS, (_IDENTIFYING,),
              Answer.NOTHING, said="Look at the projectors."),
    Operation("camera", "What the camera sees", VIEWER, LOOKS, answer=Answer.JPEG, call="camera_picture",
              at_socket="camera-picture", within="kiosk aim"),
    Operation("photograph", "The newest photograph of the job that runs", VIEWER, LOOKS, answer=Answer.JPEG,
              within="kiosk status"),
    Operation("lamp-history", "Hours and strikes of each lamp, day by day", VIEWER, LOOKS, offline=True,
              http=("GET", "/lamps"), command="lamps"),
    # -- jobs
    Operation("recalibrate", "Calibrate on the running kiosk", OPERATOR, WORKS, (_FULL_OR_QUICK, _ONE_PROJECTOR),
              http=("POST", "/recalibrations"), command="calibrate", said="The recalibration has started."),
    Operation("cancel", "End the running job at its next safe point", OPERATOR, CHANGES, answer=Answer.NOTHING,
              said="The job ends at its next safe point."),
    Operation("compute", "Compute an appearance from a target picture", OPERATOR, WORKS, (NEW_NAME, TARGET, FIT),
              http=("POST", "/appearances"), command="add", said="The computation has started.",
              more="The target is added to stage.toml as an appearance, and installed."),
    Operation("compute-scene", "Render a scene with Blender, and compute an appearance from it", OPERATOR, WORKS,
              (NEW_NAME, SCENE), http=("POST", "/appearances/rendered"), within="appearance",
              said="The computation has started.",
              more="The scene is added to stage.toml as an appearance; each calibration renders it again."),
    Operation("compare", "Photograph the installed appearances, and compare them with their targets", OPERATOR, WORKS,
              (Field("name", "only this appearance", required=False, pattern=NAME, names="appearance", argument=True),),
              http=("POST", "/comparisons"), command="photograph",
              said="The appearances are shown and photographed, one after the other."),
    Operation("test-shots", "Take test shots that show how projectors and camera are aimed", TECHNICIAN, WORKS,
              http=("POST", "/aiming/shots"), within="kiosk aim", said="The test shots have started."),
    # -- appearances
    Operation("appearances", "List the appearances", VIEWER, LOOKS, offline=True),
    Operation("preview", "A picture of how an appearance will look", VIEWER, LOOKS, (APPEARANCE,), Answer.PICTURE,
              call="appearances", take=_nothing, part=_preview, offline=True,
              http=("GET", "/appearances/{name}/preview"), within="bundle inspect"),
    Operation("projector-picture", "A small picture of what a projector shows of an appearance", VIEWER, LOOKS,
              (APPEARANCE, PROJECTOR), Answer.PICTURE, offline=True,
              http=("GET", "/appearances/{name}/projectors/{projector}"), within="bundle inspect"),
    Operation("view", "The object in white light as the camera sees it, to paint a target on", OPERATOR, LOOKS,
              answer=Answer.PICTURE, offline=True, command="canvas"),
    Operation("remove-appearance", "Remove an appearance", TECHNICIAN, CHANGES, (APPEARANCE,), Answer.NOTHING,
              http=("DELETE", "/appearances/{name}"), command="remove", asks="Remove the appearance {name}?",
              said="A new bundle without {name} is being made.",
              more="An appearance that is playing, or that is in the schedule, can't be removed."),
    Operation("upload-target", "Upload a picture as a target", OPERATOR, CHANGES,
              (Field("file", "a PNG, JPEG, TIFF or WebP", "file"), FIT), holder="targets", call="add",
              take=_uploaded, part=lambda key, values: NewTarget(key), gives=NewTarget,
              http=("POST", "/targets"), within="kiosk add", said="The picture is uploaded."),
    Operation("target-picture", "An uploaded target, as it is stored", OPERATOR, LOOKS,
              (Field("target", TARGET.about, pattern=TARGET_KEY, longest=24),), Answer.PICTURE, holder="targets",
              call="path", take=lambda values: {"key": values["target"]}, http=("GET", "/targets/{target}"),
              within="kiosk add"),
    Operation("outline-target", "Use only these parts of an uploaded target; everything else stays dark", OPERATOR,
              CHANGES, (Field("target", TARGET.about, pattern=TARGET_KEY, longest=24), OUTLINE), Answer.NOTHING,
              holder="targets", call="restrict",
              take=lambda values: {"key": values["target"], "text": values["outline"]},
              http=("PUT", "/targets/{target}/outline"), within="kiosk add", said="The outline is used."),
    Operation("reach", "How much of a target the projectors can make", OPERATOR, LOOKS, (TARGET,), offline=True,
              http=("GET", "/targets/{target}/reach")),
    Operation("reach-picture", "The target, what it will look like, or a map of what is out of reach", OPERATOR, LOOKS,
              (TARGET, REACH_PICTURE), Answer.PICTURE, call="reach", take=_only_target, part=_its_picture,
              offline=True, http=("GET", "/targets/{target}/reach/{picture}"), within="kiosk reach"),
    Operation("computed-preview", "What the object will look like by a whole solve on a graphics processor", OPERATOR,
              LOOKS, (TARGET,), call="computed", http=("GET", "/targets/{target}/computed"), within="kiosk add"),
    Operation("computed-picture", "A picture of a whole solve on a graphics processor", OPERATOR, LOOKS, (TARGET,),
              Answer.PICTURE, call="computed", part=lambda found, values: found.pictures["result"],
              http=("GET", "/targets/{target}/computed/picture"), within="kiosk add"),
    Operation("feasibility", "A map of where the target can't be reached", OPERATOR, LOOKS, (TARGET,), Answer.PICTURE,
              call="reach", part=lambda found, values: found.pictures["map"], offline=True,
              http=("GET", "/targets/{target}/feasibility"), within="kiosk reach"),
    Operation("scenes", "Scenes that Blender can render on the object", OPERATOR, LOOKS, offline=True,
              within="appearance"),
    Operation("scene-picture", "A small picture of a scene", OPERATOR, LOOKS, (SCENE,), Answer.PICTURE, call="scenes",
              take=_nothing, part=lambda found, values: next(
                  (one.preview for one in found if one.name == values["scene"]), None),
              offline=True, http=("GET", "/scenes/{scene}/picture"), within="appearance"),
    Operation("scene-reach", "How much of a scene the projectors can make", OPERATOR, LOOKS, (SCENE,), offline=True,
              http=("GET", "/scenes/{scene}/reach"), within="appearance"),
    Operation("scene-reach-picture", "The scene, what it will look like, or a map of what is out of reach", OPERATOR,
              LOOKS, (SCENE, REACH_PICTURE), Answer.PICTURE, call="scene_reach",
              take=lambda values: {"scene": values["scene"]}, part=_its_picture, offline=True,
              http=("GET", "/scenes/{scene}/reach/{picture}"), within="appearance"),
    # -- results
    Operation("comparisons", "How close the photographed appearances are to their targets", VIEWER, LOOKS, offline=True,
              within="kiosk results"),
    Operation("comparison-picture", "A picture of such a comparison", VIEWER, LOOKS, (APPEARANCE, PICTURE),
              Answer.PICTURE, call="comparisons", take=_nothing, part=_its_picture, offline=True,
              http=("GET", "/appearances/{name}/pictures/{picture}"), within="kiosk results"),
    Operation("runs", "Runs with results, newest first", VIEWER, LOOKS, offline=True, within="kiosk results"),
    Operation("results", "Grade and figures of a run", VIEWER, LOOKS, (RUN,), offline=True, http=("GET", "/runs/{run}"),
              within="kiosk results"),
    Operation("run-picture", "A picture of a run", VIEWER, LOOKS, (RUN, PICTURE), Answer.PICTURE, call="results",
              take=_only_run, part=_its_picture, offline=True, http=("GET", "/runs/{run}/pictures/{picture}"),
              within="kiosk results"),
    Operation("report", "A run's report, one HTML file", VIEWER, LOOKS, (RUN,), Answer.PAGE,
              http=("GET", "/runs/{run}/report"), within="report"),
    Operation("aiming", "Coverage, focus and exposure now", TECHNICIAN, LOOKS, within="kiosk aim"),
    Operation("aiming-picture", "A picture of the object that marks the problems", TECHNICIAN, LOOKS,
              answer=Answer.PICTURE, call="aiming", part=lambda aiming, values: aiming.picture,
              http=("GET", "/aiming/picture"), within="kiosk aim"),
    Operation("seen", "Confirm failures, so that they leave the state", OPERATOR, CHANGES,
              (Field("number", "the event number of the newest one to confirm; default: all", "integer", False,
                     most=1e12),),
              Answer.NOTHING, http=("POST", "/failures/seen"), command="confirm", said="The failures are confirmed."),
    # -- settings
    Operation("schedule", "Opening hours", VIEWER, LOOKS, offline=True, within="kiosk schedule"),
    Operation("set-schedule", "Replace the opening hours", OPERATOR, CHANGES, SCHEDULE, Answer.NOTHING,
              take=_schedule_of, offline=True, http=("PUT", "/schedule"), within="kiosk schedule",
              said="The schedule is in use."),
    Operation("effect-of-schedule", "What people see when this schedule is saved", OPERATOR, LOOKS, SCHEDULE,
              Answer.TEXT, take=_schedule_of, offline=True, http=("POST", "/schedule/effect"), within="kiosk schedule"),
    Operation("settings", "The text of stage.toml", TECHNICIAN, LOOKS, answer=Answer.TEXT, offline=True,
              within="kiosk settings"),
    Operation("check-settings", "Check a stage.toml without saving it", TECHNICIAN, LOOKS, (SETTINGS,), Answer.NOTHING,
              call="validate_settings", offline=True, http=("POST", "/settings/check"), at_socket="validate-settings",
              within="kiosk settings", said="The settings are valid."),
    Operation("effect-of-settings", "What people see when this stage.toml is saved", TECHNICIAN, LOOKS, (SETTINGS,),
              Answer.TEXT, offline=True, http=("POST", "/settings/effect"), within="kiosk settings"),
    Operation("save-settings", "Check stage.toml, save it, and apply it", TECHNICIAN, CHANGES, (SETTINGS,),
              Answer.NOTHING, offline=True, http=("PUT", "/settings"), within="kiosk settings",
              said="The settings are in use."),
    # -- maintenance
    Operation("doctor", "Find problems", OPERATOR, LOOKS, http=("POST", "/doctor"), within="doctor"),
    Operation("changes", "What changed since the last good day", OPERATOR, LOOKS, offline=True,
              more="Kernel, drivers, packages, outputs, adapters, projectors, camera, settings, clock, network."),
    Operation("test-alerts", "Send a test alert to everybody that stage.toml names", TECHNICIAN, CHANGES,
              answer=Answer.NOTHING, http=("POST", "/alerts/test"), said="The test alert was taken by every server."),
    Operation("test-backup", "Make a backup now at every place that stage.toml names, and read it back", TECHNICIAN,
              CHANGES, answer=Answer.NOTHING, http=("POST", "/backup/test"),
              said="The backup is at every place, and was read back."),
    Operation("backup", "Make a backup of settings, calibration and appearances", TECHNICIAN, LOOKS, answer=Answer.FILE,
              offline=True, http=("POST", "/backup"), more="It does not contain accounts and keys."),
    Operation("restore", "Replace settings, calibration and appearances with a backup", TECHNICIAN, CHANGES,
              (Field("backup", "a Velatura backup", "file", metavar="FILE"),), Answer.NOTHING, offline=True,
              said="The backup is in use.",
              asks="Replace settings, calibration and appearances with those of the backup?"),
    Operation("diagnostics", "Make a diagnostics file for remote support", TECHNICIAN, LOOKS, answer=Answer.FILE,
              offline=True, http=("POST", "/diagnostics"),
              more="It contains events, journals and states, but no secrets and no pictures."),
    Operation("find-devices", "Search for devices", TECHNICIAN, LOOKS, http=("POST", "/devices/found"),
              within="doctor"),
    Operation("try-device", "Open a found device and read its identity", TECHNICIAN, LOOKS,
              (Field("key", "the key of a found device", longest=256),), http=("POST", "/devices/tried"),
              within="doctor"),
    *ACCOUNT_OPERATIONS,
)  # fmt: skip

JOB: Final = Operation(
    "job", "A requested job, also after it has ended", VIEWER, LOOKS,
    (Field("number", "the number that was returned when the job was requested", "integer", most=1e12),),
)  # fmt: skip
"""For a client that follows a job at the socket; all others see the last job in the state."""
