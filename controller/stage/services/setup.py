"""``velatura init``: writes a first stage.toml for the devices that are plugged in."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from controller.config import load_stage, write_stage
from controller.config.loader import FILE
from controller.core.errors import UsageError
from controller.run.progress import Silent
from controller.stage.doctor.examine import Tools, examine
from controller.stage.doctor.writing import new_stage
from controller.stage.services.bundle import make_key

Ask = Callable[[str, str], str]
"""Question and suggested answer -> answer."""
USUAL_FOCAL_LENGTH_PX: Final = 5000.0


def set_up(
    folder: Path, *, name: str | None, focal_length_px: float | None, ask: Ask, tools: Tools | None = None
) -> dict[str, Any]:
    """Search devices, ask for names, make the signing key, and write stage.toml; returns what was written.

    Raises UsageError("stage-exists"), ("doctor-not-enough") if devices are missing, and as ``load_stage`` for
    answers that are not a valid stage (then no file remains).
    """
    file = folder / FILE
    if file.exists():
        raise UsageError("stage-exists", what=f"{file} exists already.",
                         remedy="Edit it, or run `velatura doctor --write` to add new devices.")  # fmt: skip
    examination = examine(stage=None, write_it=False, reporter=Silent(), cancel=threading.Event(), tools=tools)
    content, words = new_stage(folder, examination)
    content["stage"]["name"] = name or ask("Name of the object?", folder.resolve().name)
    for number, projector in enumerate(content["projectors"], 1):
        question = f"Name of projector {number} ({projector['driver']}, output {projector['output']})?"
        projector["name"] = ask(question, projector["name"])
    camera = content["camera"]
    if focal_length_px is None and "focal_length_px" not in camera:
        focal_length_px = _number(ask("Focal length of the camera lens in pixels?", f"{USUAL_FOCAL_LENGTH_PX:g}"))
    if focal_length_px is not None:
        camera["focal_length_px"] = focal_length_px
    folder.mkdir(parents=True, exist_ok=True)
    write_stage(file, content)
    try:
        load_stage(folder)
        made = make_key(folder, "stage")
        write_stage(file, {**content, "bundle": {"trusted_keys": list(made["trusted_keys"])}})
    except BaseException:
        file.unlink()
        raise
    return {"file": str(file), "words": [*words, "[bundle] with a new signing key"]}


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError as error:
        raise UsageError(
            "not-a-number", what=f"{text[:40]!r} is not a number.", remedy="Enter a number, for example 5000."
        ) from error
