"""The product's kernels are compiled once on a computer, beside the first steps of a run."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Final

from controller.run.progress import Reporter
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from hal.notices import Level
from hal.runtime.compute import can_keep_kernels, usable_cpus
from hal.runtime.kernels import SECONDS, Compilation, are_compiled

KERNELS: Final = StepId("kernels")
LOOK_EVERY_S: Final = 0.2


@contextlib.contextmanager
def kernels_compiled(reporter: Reporter) -> Iterator[Sequence[Step]]:
    """Begin to compile what is not compiled yet; gives the step that waits until all is.

    Put the step before the first one that computes, and after those that wait for devices. There is none where all is
    compiled, and where compiled code cannot be kept for other programs: kernels are then compiled when they are called.
    """
    if are_compiled() or not can_keep_kernels():
        yield ()
        return
    seconds = max(SECONDS // usable_cpus(), 20)
    reporter.say(f"Compiling kernels. This is done once on this computer and takes about {seconds} s.")
    with Compilation() as compilation:
        wait = Step(
            KERNELS, partial(_wait, compilation), title="Compiling kernels, once", weight=seconds, always=True
        )  # fmt: skip
        yield (wait,)


def _wait(compilation: Compilation, context: Context) -> Sequence[Path]:
    while not compilation.wait(LOOK_EVERY_S):
        context.advance(compilation.share)
    for module in compilation.failed:
        context.reporter.say(
            f"The kernels of {module} could not be compiled ahead. They are compiled when they are needed.",
            Level.WARNING,
        )
    return ()
