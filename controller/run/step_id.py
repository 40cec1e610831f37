"""What identifies a step of a run, and a photograph of a step: values that are compared, never texts to parse."""

from __future__ import annotations

import json
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class StepId:
    """Which step of a run it is; no two steps of a run have the same.

    Parameters
    ----------
    kind : what the step does, for example "radiometry" (``artefacts.kinds.StepKind``)
    projector : the name of the projector that it concerns alone; None if it concerns all, or none
    item : the name of what else it concerns alone: an appearance, or an experiment
    """

    kind: str
    projector: str | None = None
    item: str | None = None

    def __str__(self) -> str:
        """For people: in reports, and in the place of a title."""
        return "-".join(part for part in (self.kind, self.projector, self.item) if part is not None)


@dataclass(frozen=True, slots=True)
class ShotId:
    """Which photograph of a run it is.

    Parameters
    ----------
    kind : the kind of the photographs that it belongs to, usually that of the step which takes it
    name : its own name among those, for example that of its pattern
    projector : the name of the projector that shines alone; None for several, or none
    """

    kind: str
    name: str
    projector: str | None = None

    def __str__(self) -> str:
        """For people: in messages and progress."""
        return " ".join(part for part in (self.projector, self.kind, self.name) if part is not None)


def input_name(step: StepId, number: int) -> str:
    """Under which the hash of a step's artefact stands among the inputs of a later step."""
    return json.dumps([step.kind, step.projector, step.item, number], ensure_ascii=False)
