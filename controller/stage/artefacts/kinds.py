"""Kinds of steps that other code uses, and short functions for their identities."""

from __future__ import annotations

import enum
from collections.abc import Iterable
from typing import Final

from controller.run.step_id import StepId


class StepKind(enum.StrEnum):
    """The ``kind`` of a ``StepId``. A step's file usually has this name: see ``artefacts.names``."""

    EXPOSURE = "exposure"
    DELAY = "delay"
    CAMERA_RESPONSE = "camera-response"
    BLACK = "black"
    CAMERA = "camera"
    LIGHT = "light"
    RADIOMETRY = "radiometry"
    CODES = "codes"
    PIXELS = "pixels"
    INDIRECT = "indirect"
    SHAPE = "shape"
    GEOMETRY = "geometry"
    DOTS = "dots"
    METAPIXELS = "metapixels"
    STUDY_DOTS = "study-dots"
    STUDY_SHARES = "study-shares"
    MODE = "mode"
    DRIFT_PHOTOGRAPHS = "drift-photographs"
    DRIFT = "drift"
    SKEW = "skew"
    PLAN = "plan"
    VERIFICATION_PHOTOGRAPHS = "verification-photographs"
    VERIFY = "verify"
    CALIBRATED = "calibrated"
    BASE = "base"
    TARGET = "target"
    APPEARANCE = "appearance"
    REFINE = "refine"
    REFINED = "refined"
    CAUSES = "causes"
    PUBLISH = "publish"
    PHOTOGRAPH = "photograph"
    TRADITIONAL = "traditional"
    DIMMED = "dimmed"
    PLAYBACK = "playback"
    COMPARE = "compare"
    PICTURES = "pictures"


OF_PROJECTORS: Final = (
    StepKind.LIGHT, StepKind.RADIOMETRY, StepKind.CODES, StepKind.PIXELS, StepKind.INDIRECT, StepKind.DOTS,
    StepKind.METAPIXELS, StepKind.STUDY_DOTS, StepKind.STUDY_SHARES,
)  # fmt: skip
"""Kinds of the steps that each projector has of its own."""

WHITE_ITEM: Final = "white"
CALIBRATED: Final = StepId(StepKind.CALIBRATED)
"""The step whose row in the journal marks the run's calibration as complete."""


def white_of(projector: str) -> StepId:
    """The first part of the light of a projector, a step of its own: white, from which the camera is measured."""
    return StepId(StepKind.LIGHT, projector, WHITE_ITEM)


def of_projectors(names: Iterable[str], *kinds: StepKind) -> tuple[StepId, ...]:
    """The steps of these kinds of each of these projectors, one projector after the other."""
    return tuple(StepId(kind, projector) for projector in names for kind in kinds)


__all__ = ["CALIBRATED", "OF_PROJECTORS", "StepKind", "of_projectors", "white_of"]
