"""Every experiment, in the order of the index."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from controller.errors import UsageError
from controller.study.ablation import ABLATION
from controller.study.adaptation import ADAPTATION
from controller.study.appearances import APPEARANCES
from controller.study.drifting import DRIFTING
from controller.study.earlier import EARLIER
from controller.study.effort import EFFORT
from controller.study.frequency import FREQUENCY
from controller.study.live import LIVE
from controller.study.placement import PLACEMENT
from controller.study.regions import REGIONS
from controller.study.residual import RESIDUAL, RESIDUAL_SIX
from controller.study.robustness import ROBUSTNESS
from controller.study.sharpness import SHARPNESS
from controller.study.times import TIMES
from controller.study.values import Experiment

EXPERIMENTS: Final[tuple[Experiment, ...]] = (
    ABLATION,
    REGIONS,
    RESIDUAL,
    RESIDUAL_SIX,
    SHARPNESS,
    FREQUENCY,
    EARLIER,
    APPEARANCES,
    TIMES,
    PLACEMENT,
    EFFORT,
    DRIFTING,
    ROBUSTNESS,
    ADAPTATION,
    LIVE,
)


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
