"""Paths are traced in a process of their own: Mitsuba has one variant for all who use it, and may end its process."""

from __future__ import annotations

import multiprocessing
from multiprocessing.connection import Connection
from typing import Final

import numpy as np
import numpy.typing as npt

from hal.errors import DeviceError
from plugins.emulated.optics.indirect.mitsuba_scene import REMEDY
from plugins.emulated.optics.indirect.traced import TracedTransfer, trace
from plugins.emulated.optics.objects import StageObject
from plugins.emulated.optics.rays import Progress
from plugins.emulated.optics.truth import BenchTruth

POLL_S: Final = 0.5


def traced_transfer(
    truth: BenchTruth, thing: StageObject, pixels: npt.NDArray[np.int32], progress: Progress
) -> TracedTransfer:
    """As ``traced.trace``. Raises DeviceError ``engine-missing``, ``engine-failed``."""
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(
        target=_run, args=(theirs, truth, thing, pixels), daemon=True
    )
    process.start()
    theirs.close()
    done = 0.0
    try:
        while True:
            while not ours.poll(POLL_S):
                progress(done)
            said = ours.recv()
            if isinstance(said, TracedTransfer):
                return said
            if isinstance(said, dict):
                raise DeviceError(**said)
            progress(done := said)
    except EOFError as error:
        raise DeviceError("engine-failed", what="Mitsuba ended without a result.", remedy=REMEDY) from error
    finally:
        process.terminate()
        process.join()
        ours.close()


def _run(parent: Connection, truth: BenchTruth, thing: StageObject, pixels: npt.NDArray[np.int32]) -> None:
    try:
        parent.send(trace(truth, thing, pixels, parent.send))
    except DeviceError as error:
        parent.send({"code": error.code, "what": error.what, "remedy": error.remedy})


__all__ = ["traced_transfer"]
