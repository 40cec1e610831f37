"""``velatura init``: from the devices that are plugged in to a first stage.toml."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from controller.config import load_stage, write_stage
from controller.config.loader import FILE
from controller.core.errors import UsageError
from controller.doctor.examine import Tools, examine
from controller.doctor.writing import new_stage
from controller.run.progress import Silent
from controller.services.bundle import make_key

Ask = Callable[[str, str], str]
"""A question and what is suggested -> the answer."""
USUAL_FOCAL_LENGTH_PX: Final = 5000.0


def set_up(
    folder: Path, *, name: str | None, focal_length_px: float | None, ask: Ask, tools: Tools | None = None
) -> dict[str, Any]:
    """Search, ask for names, make the signing key, and write stage.toml; what was written, in words.

    Raises UsageError("stage-exists"), ("doctor-not-enough") when too little is plugged in, and as ``load_stage`` for
    answers that make no stage (nothing is left behind then).
    """
    file = folder / FILE
    if file.exists():
        raise UsageError("stage-exists", what=f"{file} is there already.",
                         remedy="Edit it, or let `velatura doctor --write` add what is new.")  # fmt: skip
    seen = examine(stage=None, write_it=False, reporter=Silent(), cancel=threading.Event(), tools=tools)
    content, words = new_stage(folder, seen)
    content["stage"]["name"] = name or ask("What is the object called?", folder.resolve().name)
    for number, projector in enumerate(content["projectors"], 1):
        asked = f"What is projector {number} ({projector['driver']}, output {projector['output']}) called?"
        projector["name"] = ask(asked, projector["name"])
    camera = content["camera"]
    if focal_length_px is None and "focal_length_px" not in camera:
        focal_length_px = _number(ask("The lens's focal length in pixels?", f"{USUAL_FOCAL_LENGTH_PX:g}"))
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
        raise UsageError("not-a-number", what=f"{text[:40]!r} is not a number.", remedy="Write one.") from error
