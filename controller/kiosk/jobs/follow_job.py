"""A job of a running kiosk, followed from another process until it ends."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from controller.core.errors import VelaturaError, WorkError
from controller.kiosk.api.control import call_kiosk
from controller.run.progress import Phase, Progress, Reporter
from hal.deadline import Cancelled

EVERY_S: Final = 0.5


def ask_and_follow(
    *,
    stage: Path,
    op: str,
    arguments: Mapping[str, Any],
    reporter: Reporter,
    cancel: threading.Event,
    every_s: float = EVERY_S,
) -> Mapping[str, Any]:
    """Start a job and return its result; ``cancel`` cancels the job, too.

    Raises UsageError("not-serving"), the kiosk's refusal of the job, WorkError("job-given-up") if it will never start
    (the lamps did not light, it was cancelled, the kiosk restarted), WorkError("job-failed") with the kiosk's own
    sentence, and Cancelled.
    """
    number, began_s = int(call_kiosk(stage, op, **arguments)["number"]), time.monotonic()
    last: object = None
    while True:
        job = call_kiosk(stage, "job", number=number)
        if job is not None and job["ended"]:
            return _ended(job)
        if job is not None and job["steps"] != last and job["steps"]:
            last = job["steps"]
            reporter.progress(_progress(job, time.monotonic() - began_s))
        if cancel.wait(every_s):
            with contextlib.suppress(VelaturaError):  # it may have ended in the meantime
                call_kiosk(stage, "cancel")
            raise Cancelled


def _ended(job: Mapping[str, Any]) -> Mapping[str, Any]:
    if job["failed"]:
        raise WorkError("job-failed", what=f"{job['name']}: {job['outcome']}",
                        remedy="See `velatura kiosk events` for the decisions and their reasons.")  # fmt: skip
    return {"job": job["name"], "outcome": job["outcome"], **({"run": job["run"]} if job["run"] else {})}


def _progress(job: Mapping[str, Any], elapsed_s: float) -> Progress:
    """The job lists only the steps so far, so the overall progress follows from the time left."""
    index, step = len(job["steps"]) - 1, job["steps"][-1]
    left_s = job["left_s"]
    share = 0.0 if left_s is None else elapsed_s / max(elapsed_s + left_s, 1e-6)
    phase = Phase.DONE if step["done"] >= 1 else Phase.RUNNING
    return Progress(step["title"], index, max(job["count"], index + 1), phase, share, step["done"], elapsed_s, left_s)
