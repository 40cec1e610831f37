"""Tells a technician what a step found, and keeps it for the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from controller.core.errors import TroubleCode
from controller.run.runner import Context
from controller.run.step_id import StepId
from controller.stage.artefacts.grade import write_troubles
from hal.notices import Level, Notice


def tell(context: Context, step: StepId, sentences: Mapping[TroubleCode, str | None]) -> Path:
    """Say what was found of the step's projector, if it has one, as warnings; None is nothing.

    Returns the file that keeps it, an artefact of the step.
    """
    found = [
        Notice.warning(code, text, about=step.projector or "") for code, text in sentences.items() if text is not None
    ]
    return tell_all(context, step, found)


def tell_all(context: Context, step: StepId, found: Sequence[Notice]) -> Path:
    """As ``tell``."""
    for trouble in found:
        context.reporter.say(trouble.what, Level.WARNING)
    return write_troubles(context.folder, step, found)


__all__ = ["tell", "tell_all"]
