"""``velatura simulate``."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from controller.cli.groups import work

if TYPE_CHECKING:
    from controller.run.progress import Reporter


def simulate(
    seed: Annotated[int, typer.Option(help="Random seed of the events and of their order.", min=0)] = 1,
    years: Annotated[float, typer.Option(help="Years of a kiosk, in lives of 14 days.", min=0.001)] = 0.1,
    keep: Annotated[Path | None, typer.Option(help="File for the shortened scenario of a violation.")] = None,
) -> None:
    """Run the kiosk's own code for months of virtual time. Faults come from a seed; its invariants are checked."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from lab.simulate.simulation import simulate

        # From here on relative names are those of a folder in memory.
        file = None if keep is None else keep.resolve()
        return simulate(seed=seed, years=years, keep=file, reporter=reporter, cancel=cancel)

    work(do)
