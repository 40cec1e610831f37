"""Fixed targets, and how near photographs of a method's frames are to them."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from controller.core.arrays import FloatImage, Mask
from controller.core.errors import VelaturaError, WorkError
from controller.optics.solve.result.metrics import PixelSet
from controller.optics.solve.targets.patterns import checkerboard
from controller.optics.solve.targets.values import Target, through_camera
from controller.optics.transport import LightTransport, build_transport
from controller.stage.report.pictures import crop_around
from hal.deadline import Cancelled
from hal.errors import DeviceError
from lab.compare.api import ComparisonTarget
from lab.compare.entries import Entry
from lab.compare.metered_stage import MeteredStage, Shower, checked_frames
from lab.study.experiments.residual import brightest_first
from lab.study.output.drawing import screen
from lab.study.subject.likeness import flip_of
from lab.study.subject.measuring import pixel_sets
from lab.study.subject.subject import ReachableTarget, Subject
from lab.study.subject.trial import photograph_target

GREY: Final = 0.5
"""Of the even grey target, by white."""
TARGETS: Final = {
    "grey": "an even grey, without the object's own paint and shading",
    "checkerboard": "a checkerboard round the object",
    "photograph": "a photograph wrapped on the object",
    "photograph-dim": "the same as bright as one projector can make it",
}


@dataclass(frozen=True, slots=True)
class Failure:
    """Why there are no figures: ``code`` and ``what`` as of an error."""

    code: str
    what: str


@dataclass(frozen=True, slots=True)
class Score:
    """One target of one method.

    ``pixels`` as ``solve.result.metrics``; ``flip``: mean of FLIP over all lit pixels, None where flip-evaluator is not
    installed; ``photograph`` (rows, columns, 3) of its frames
    """

    target: str
    seconds: float
    pixels: Mapping[str, PixelSet]
    photograph: FloatImage | None = None
    failed: Failure | None = None
    flip: float | None = None


@dataclass(frozen=True, slots=True)
class Evaluation:
    """One method on one scene. ``failed``: it did not even measure the stage, so there are no scores."""

    seconds: float
    photographs: int
    scores: Sequence[Score]
    failed: Failure | None = None


def fixed_targets(subject: Subject, only: Mask | None = None) -> dict[str, ReachableTarget]:
    """``TARGETS`` on this stage, each as bright as 95 % of the object can reach, by the reference calibration.

    ``only`` (camera rows, columns): the part of the object on which they are scored; None: all of it
    """

    def wanted(target: Target, transport: LightTransport | None = None) -> ReachableTarget:
        mask = target.mask if only is None else target.mask & only
        return subject.wanted(dataclasses.replace(target, mask=mask), transport=transport)

    picture = photograph_target(subject)
    grey = Target(np.where(subject.mask[..., None], np.float32(GREY), np.float32(0)) * np.ones(3, np.float32),
                  subject.mask)  # fmt: skip
    alone = build_transport(subject.with_projectors(brightest_first(subject)[:1]))
    return {
        "grey": wanted(grey),
        "checkerboard": wanted(through_camera(checkerboard(subject.geometry, subject.mask))),
        "photograph": wanted(picture),
        "photograph-dim": wanted(picture, alone),
    }


def evaluate(entry: Entry, stage: MeteredStage, targets: Mapping[str, ReachableTarget], shower: Shower) -> Evaluation:
    """Let a method measure the stage and make each target; photograph its frames and compare them.

    What the method raises is its result, not an error of the comparison; but a stop and a device's error are raised.
    """
    began_s = time.perf_counter()
    make, failed = _attempt(lambda: _function(entry.method(stage)), stage.check)
    if failed is not None:
        return Evaluation(time.perf_counter() - began_s, stage.photographs, (), failed)
    seconds = time.perf_counter() - began_s
    scores = [_score(make, stage, name, wanted, shower) for name, wanted in targets.items()]
    return Evaluation(seconds, stage.photographs, scores)


def _score(
    make: Callable[[Any], Any], stage: MeteredStage, name: str, wanted: ReachableTarget, shower: Shower
) -> Score:
    began_s = time.perf_counter()
    frames, failed = _attempt(lambda: checked_frames(make(_copied(name, wanted)), stage.projectors_px), stage.check)
    seconds = time.perf_counter() - began_s
    if failed is not None:
        return Score(name, seconds, {}, failed=failed)
    picture, _ = shower.photograph(f"judged-{name}", frames, white=wanted.white)
    return Score(
        name, seconds, pixel_sets(stage.subject, picture, wanted), picture, flip=_flip(stage.subject, picture, wanted)
    )


def _flip(subject: Subject, picture: FloatImage, wanted: ReachableTarget) -> float | None:
    crop, matrix = crop_around(subject.mask), subject.calibration.camera_to_xyz
    reference, shown = (screen(image, matrix, wanted.white, crop) for image in (wanted.radiance, picture))
    return flip_of(reference, shown, wanted.valid & subject.mask, crop)


def _copied(name: str, wanted: ReachableTarget) -> ComparisonTarget:
    """Copies: a method may write into its arrays, and is scored by the originals."""
    return ComparisonTarget(name, wanted.radiance.copy(), wanted.white, wanted.mask.copy(), wanted.valid.copy())


def _function(made: Any) -> Any:
    if not callable(made):
        raise TypeError(f"it returned {type(made).__name__} instead of a function that makes frames")
    return made


def _attempt(work: Callable[[], Any], check: Callable[[], None]) -> tuple[Any, Failure | None]:
    """What ``work`` returns, or why there is nothing.

    A stop and a device's error are raised, and so is what ``check`` raises: the run's end is not the method's fault.
    """
    try:
        return work(), None
    except (Cancelled, DeviceError):
        raise
    except VelaturaError as error:
        found = error
    except Exception as error:  # noqa: BLE001 - another's code may raise anything, and the other methods continue
        found = WorkError(
            "benchmark-method-failed",
            what=f"The method failed: {type(error).__name__}: {error}.",
            remedy="Correct it; the same command then does its part again.",
        )
    check()
    return None, Failure(found.code, found.what)
