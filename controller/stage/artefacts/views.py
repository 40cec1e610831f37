"""The views of a run: the places from which cameras photographed its patterns.

Each view has a folder laid out as the run's own, with a journal, and what reads a run reads a view. The first camera's
view is the run's folder itself; those of other cameras and places are in ``views``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from controller.config.models import ONLY_CAMERA
from controller.stage.artefacts.names import read_json, safe_name, write_json

VIEWS: Final = "views"
"""The folder with the views of a run that are not its first."""
_RECORD: Final = "view.json"


def view_folder(run: Path, name: str) -> Path:
    """The folder of a view that is not the first, whole or not."""
    return run / VIEWS / safe_name(name)


def write_view(folder: Path, name: str, number: int, session: str = "") -> Path:
    """``view.json``, the last file of a view: with it, the view is whole. ``number``: its place in the order.

    ``session``: in which it was photographed; begins with the date and time, as a run's name does
    """
    return write_json(folder / _RECORD, {"name": name, "number": number, "session": session})


def reopen_view(folder: Path) -> None:
    """A view is not whole while something in it may be measured again."""
    (folder / _RECORD).unlink(missing_ok=True)


def is_whole(folder: Path) -> bool:
    """Whether a view that is not the first has all that was asked for."""
    return (folder / _RECORD).is_file()


def first_view(run: Path) -> str:
    """The name of the view that is the run's folder itself."""
    record = run / _RECORD
    return str(read_json(record)["name"]) if record.is_file() else ONLY_CAMERA


def newest_view(run: Path) -> int | None:
    """The number of the view that was photographed last; None where all were at the same time."""
    records = [folder / _RECORD for folder in view_folders(run).values()]
    sessions = [str(read_json(one).get("session", "")) if one.is_file() else "" for one in records]
    return None if len(set(sessions)) == 1 else sessions.index(max(sessions))


def view_folders(run: Path) -> Mapping[str, Path]:
    """The folder of each whole view by its name: the first one, then the others in the stage's order.

    For a run of one camera this is the run's folder alone.
    """
    rows = [(read_json(record), record.parent) for record in run.glob(f"{VIEWS}/*/{_RECORD}")]
    others = sorted((int(row["number"]), str(row["name"]), folder) for row, folder in rows)
    return {first_view(run): run, **{name: folder for _, name, folder in others}}
