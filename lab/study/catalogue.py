"""Every experiment, in the order of the index, and every stage that experiments work on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from controller.core.errors import UsageError
from lab.study.experiments.ablation import ABLATION
from lab.study.experiments.appearances.experiment import APPEARANCES
from lab.study.experiments.drift import DRIFTING
from lab.study.experiments.earlier import EARLIER
from lab.study.experiments.effort import EFFORT
from lab.study.experiments.frequency.experiment import FREQUENCY, FREQUENCY_SHARP, sharp_object
from lab.study.experiments.live import LIVE
from lab.study.experiments.placement.experiment import PLACEMENT, planned_object
from lab.study.experiments.plain_dots import PLAIN_ABLATION
from lab.study.experiments.regions import REGIONS
from lab.study.experiments.residual import RESIDUAL, RESIDUAL_SIX
from lab.study.experiments.residual_sweep import RESIDUAL_SWEEP
from lab.study.experiments.robustness import ROBUSTNESS
from lab.study.experiments.sharpness import SHARPNESS
from lab.study.experiments.times.experiment import TIMES
from lab.study.subject.scenes import Scene, same_object
from lab.study.values import Experiment

EXPERIMENTS: Final[tuple[Experiment, ...]] = (
    ABLATION,
    PLAIN_ABLATION,
    REGIONS,
    RESIDUAL,
    RESIDUAL_SIX,
    RESIDUAL_SWEEP,
    SHARPNESS,
    FREQUENCY,
    FREQUENCY_SHARP,
    EARLIER,
    APPEARANCES,
    TIMES,
    PLACEMENT,
    EFFORT,
    DRIFTING,
    ROBUSTNESS,
    LIVE,
)

_ALL: Final = (
    # What users have; the pale shells are about optics alone, and stand in the dark.
    Scene("painted", "a painted vase and bust, three projectors", settings={"room": "room"}),
    Scene("curved", "a pale curved shell, three projectors", same_object),
    Scene(
        "grazing",
        "a pale curved shell, two projectors at grazing angles to its right half, then one from the right",
        same_object,
        {"projectors": ("far-left", "left", "right")},
    ),
    Scene("curved-six", "a pale curved shell, six projectors", same_object, {"projectors": 6}),
    Scene(
        "planned", "the shell, three projectors where they were planned", planned_object, {"stands": "../stands.toml"}
    ),
    Scene(
        "sharp",
        "the shell, three projectors with sharp lenses, in focus at all depths",
        sharp_object,
        {"stands": "../stands.toml"},
    ),
)
SCENES: Final[Mapping[str, Scene]] = {scene.name: scene for scene in _ALL}


def chosen(names: Sequence[str]) -> list[Experiment]:
    """The experiments of these names, in the catalogue's order; without names all that are not optional.

    Raises UsageError("experiment-unknown").
    """
    known = {experiment.name: experiment for experiment in EXPERIMENTS}
    for name in names:
        if name not in known:
            raise UsageError(
                "experiment-unknown",
                what=f"There is no experiment called {name}.",
                remedy=f"Choose from {', '.join(known)}.",
            )
    if names:
        return [experiment for experiment in EXPERIMENTS if experiment.name in names]
    return [experiment for experiment in EXPERIMENTS if not experiment.optional]
