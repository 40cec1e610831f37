"""Identities of steps and photographs: values to compare, not texts to parse."""

from __future__ import annotations

import json
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class StepId:
    """Identity of a step, unique in its run.

    Parameters
    ----------
    kind : the work of the step, for example "radiometry" (``artefacts.kinds.StepKind``)
    projector : the name of its projector; None if it concerns all, or none
    item : the name of its appearance or experiment, or of the part of the work that it is
    """

    kind: str
    projector: str | None = None
    item: str | None = None

    def __str__(self) -> str:
        """For people: in reports, and if there is no title."""
        return "-".join(part for part in (self.kind, self.projector, self.item) if part is not None)


@dataclass(frozen=True, slots=True)
class ShotId:
    """Identity of a photograph in its run.

    Parameters
    ----------
    kind : the kind of its set of photographs, usually that of the step that takes it
    name : its name in the set, for example that of its pattern
    projector : the name of the only lit projector; None for several, or none
    """

    kind: str
    name: str
    projector: str | None = None

    def __str__(self) -> str:
        """For people: in messages and progress."""
        return " ".join(part for part in (self.projector, self.kind, self.name) if part is not None)


def input_name(step: StepId, number: int) -> str:
    """Name of the hash of a step's artefact among the inputs of a later step."""
    return json.dumps([step.kind, step.projector, step.item, number], ensure_ascii=False)
