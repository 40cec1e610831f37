"""What the steps of a run took in the last runs of its kind."""

from __future__ import annotations

import contextlib
import statistics
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from controller.core.errors import VelaturaError
from controller.run.journal import Journal
from controller.run.step_id import StepId

RUNS: Final = 3
"""So many runs of the same kind are asked, the newest first."""


def measured(run: Path, steps: Sequence[StepId]) -> list[float | None]:
    """Seconds that each step took in the last runs of this kind beside ``run`` (DATE-TIME-KIND); None: not known.

    A step that no run had (a new appearance) takes as long as the others of its kind.
    """
    kind = run.name.rpartition("-")[2]
    same: defaultdict[StepId, list[float]] = defaultdict(list)
    alike: defaultdict[str, list[float]] = defaultdict(list)
    others = (path for path in sorted(run.parent.glob(f"*-*-{kind}"), reverse=True) if path != run)
    for folder in [path for path in others if (path / Journal.FILE).is_file()][:RUNS]:
        # A journal that can't be read only makes the estimate worse.
        with contextlib.suppress(VelaturaError), Journal(folder) as journal:
            for step, seconds in journal.steps().items():
                same[step].append(seconds)
                alike[step.kind].append(seconds)
    found = [same.get(step) or alike.get(step.kind) for step in steps]
    return [None if seconds is None else max(0.01, statistics.median(seconds)) for seconds in found]
