"""The work of a kiosk in memory: its state and events, and jobs whose steps only take time."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace

from controller.core.errors import WorkError
from controller.kiosk.state import EventRow, Job, JobStep, KioskState
from controller.kiosk.values import Unsubscribe
from tests.controller.panel.example_values import BORN

STEPS = ("Power", "Warm up", "Find the brackets", "Photograph patterns", "Decode", "Solve the geometry", "Grade")


class MemoryWork:
    """``step_s`` how long a step of a job takes; ``state``: at the start."""

    def __init__(self, step_s: float, state: KioskState) -> None:
        self._step_s, self._state = step_s, state
        self._lock = threading.RLock()
        self._callbacks: list[Callable[[], None]] = []
        self._cancel = threading.Event()
        self._worker: threading.Thread | None = None
        self._events: list[EventRow] = []

    def change(self, **values: object) -> None:
        with self._lock:
            self._state = replace(self._state, revision=self._state.revision + 1, **values)  # type: ignore[arg-type]
        for callback in tuple(self._callbacks):
            callback()

    def note(self, level: str, text: str, code: str = "") -> None:
        with self._lock:
            number = len(self._events) + 1
            self._events.append(EventRow(number, BORN + number, level, text, code))  # type: ignore[arg-type]
        for callback in tuple(self._callbacks):
            callback()

    def snapshot(self) -> KioskState:
        return self._state

    def events(self, after: int = 0) -> Sequence[EventRow]:
        with self._lock:
            return [row for row in self._events if row.number > after][-2000:]

    def subscribe(self, callback: Callable[[], None]) -> Unsubscribe:
        self._callbacks.append(callback)
        return lambda: self._callbacks.remove(callback) if callback in self._callbacks else None

    def _begin(self, name: str, state: str, finish: Callable[[str], None], appearance: str = "") -> Job:
        with self._lock:
            self._check_idle()
            old = self._state.job
            number = 1 if old is None else old.number + 1
            job = Job(number, name, tuple(JobStep(title, 0.0) for title in STEPS), 60.0, run=f"run-{number}",
                      appearance=appearance)  # fmt: skip
            self._cancel.clear()
            self.change(job=job, state=state, reason=f"{name} is running.", made="")
            self._worker = threading.Thread(target=self._work, args=(job, finish), daemon=True)
            self._worker.start()
            return job

    def _check_idle(self) -> None:
        if self._state.job is not None and not self._state.job.ended:
            what = f"{self._state.job.name} is running."
            raise WorkError("busy", what=what, remedy="Wait until it ends, or cancel it.")

    def job(self, number: int) -> Job | None:
        job = self._state.job
        if job is None or job.number != number:
            raise WorkError("job-given-up", what="The job will not start.", remedy="See the events.")
        return job

    def close(self) -> None:
        """End the job that is running."""
        self._cancel.set()
        if self._worker is not None:
            self._worker.join(20)

    def _work(self, job: Job, finish: Callable[[str], None]) -> None:
        for at in range(len(STEPS)):
            for done in (0.5, 1.0):
                if self._cancel.wait(self._step_s / 2):
                    ended = replace(job, ended=True, failed=True, outcome="It was cancelled.")
                    self.change(job=ended, state="playing", reason="The job was cancelled; the old calibration stays.")
                    return
                share = [1.0] * at + [done] + [0.0] * (len(STEPS) - at - 1)
                steps = tuple(JobStep(title, part) for title, part in zip(STEPS, share, strict=True))
                job = replace(job, steps=steps, left_s=(len(STEPS) - at) * self._step_s)
                self.change(job=job)
        finish(job.run)
        done_job = replace(job, ended=True, outcome="It ended well.", left_s=0.0)
        self.change(job=done_job, state="playing", reason="All is well.")

    def cancel(self) -> None:
        job = self._state.job
        if job is None or job.ended:
            raise WorkError("nothing-to-cancel", what="No job is running.", remedy="There is nothing to cancel.")
        self._cancel.set()
