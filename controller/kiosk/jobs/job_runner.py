"""Runs one job at a time in its own thread, and keeps what the panel shows of it."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

from controller.core.errors import SEND_DIAGNOSTICS
from controller.kiosk.decide.interfaces import BACKGROUND, Finished, Request, title_of
from controller.kiosk.state import Job, JobStep
from controller.kiosk.store.event_log import EventLog
from controller.kiosk.world import Thread, World
from controller.run.progress import Phase, Progress
from hal.deadline import Cancelled
from hal.errors import CodedError
from hal.notices import Level, Notice

REMEMBERED: Final = 16
"""Ended jobs, for a client that polls only now and then."""


class JobReporter:
    """A ``run.progress.Reporter`` that keeps a ``Job`` up to date. ``changed`` is called after each change."""

    def __init__(self, job: Job, log: EventLog, changed: Callable[[], None]) -> None:
        self.job, self._log, self._changed = job, log, changed
        self._steps: list[JobStep] = []

    def progress(self, now: Progress) -> None:
        if len(self._steps) != now.count:
            self._steps = [JobStep("", 0.0)] * now.count
        done = 1.0 if now.phase is not Phase.RUNNING else now.step_fraction
        self._steps[now.index] = JobStep(now.step, done)
        # one that runs beside others may begin before earlier ones are shown
        begun = tuple(step for step in self._steps if step.title)
        self.job = replace(self.job, steps=begun, left_s=now.left_s, count=now.count, why=now.why)
        self._changed()

    def say(self, text: str, level: Level = Level.INFO) -> None:
        self._log.add(Notice("work-message", text, "", level))
        self._changed()


Do = Callable[[Request, JobReporter, threading.Event], Finished]
"""Does one kind of job; raises VelaturaError, DeviceError or Cancelled."""


@dataclass(frozen=True, slots=True)
class JobHandler:
    """``refusal`` says from memory why the job can't run now, or None."""

    do: Do
    refusal: Callable[[Request], Notice | None] = lambda request: None


class JobRunner:
    """See ``interfaces.Jobs``. ``number``: that of the last job of the previous service."""

    def __init__(
        self,
        handlers: Mapping[str, JobHandler],
        log: EventLog,
        changed: Callable[[], None] = lambda: None,
        *,
        number: int = 0,
        world: World | None = None,
    ) -> None:
        self._world = world or World()
        self._handlers, self._log, self._changed = handlers, log, changed
        self._number = number
        self._lock = threading.Lock()
        self._request: Request | None = None
        self._reporter: JobReporter | None = None
        self._ended: OrderedDict[int, Job] = OrderedDict()
        self._cancel = self._world.event()
        self._finished: Finished | None = None
        self._thread: Thread | None = None
        self._made = ""

    @property
    def made(self) -> str:
        """The appearance that was computed last, until other work of people begins or it is ``seen``; else empty."""
        return self._made

    def seen(self) -> None:
        """The new appearance was shown."""
        self._made = ""

    @property
    def job(self) -> Job | None:
        """The job that is running, or ended last."""
        return None if self._reporter is None else self._reporter.job

    @property
    def number(self) -> int:
        """The highest job number used or reserved, also by previous services."""
        return self._number

    def reserve(self) -> int:
        """A number for a job that is requested now and may start later or never; no other job gets it."""
        with self._lock:
            self._number += 1
            return self._number

    def known(self, number: int) -> Job | None:
        """The job of this number if it runs or ended recently; None while it waits, and if it never started."""
        job = self.job
        return job if job is not None and job.number == number else self._ended.get(number)

    @property
    def running(self) -> Request | None:
        return self._request

    def refusal(self, request: Request) -> Notice | None:
        return self._handlers[request.kind].refusal(request)

    def begin(self, request: Request) -> None:
        self._request, self._cancel = request, self._world.event()
        title = title_of(request)
        if request.kind not in BACKGROUND:
            self._made = ""
        # Only a job that is named after an appearance makes one.
        made = request.arguments[0] if request.kind == "compute" and request.arguments else ""
        job = Job(request.number or self.reserve(), title, appearance=made, background=request.kind in BACKGROUND)
        self._reporter = JobReporter(job, self._log, self._changed)
        self._log.add(Notice("work-begins", f"Started: {title}."))
        run = partial(self._run, request, self._reporter, self._cancel)
        thread = self._world.thread(run, f"work-{request.kind}")
        try:
            thread.start()
            self._thread = thread
        except RuntimeError as error:
            # The system has no thread left. Without this the job would never end.
            self._end(_crashed(request, error), self._reporter)

    def finished(self) -> Finished | None:
        with self._lock:
            finished, self._finished = self._finished, None
            if finished is not None:
                self._request = None
            return finished

    def cancel(self) -> None:
        self._cancel.set()

    def close(self, timeout_s: float) -> None:
        """Cancel the job and wait until it ends."""
        self._cancel.set()
        if self._thread is not None:
            self._thread.join(timeout_s)

    def _run(self, request: Request, reporter: JobReporter, cancel: threading.Event) -> None:
        try:
            finished = self._handlers[request.kind].do(request, reporter, cancel)
        except Cancelled as error:
            finished = Finished(request, Notice(error.code, error.what, error.remedy), failed=True)
        except CodedError as error:
            finished = Finished(request, Notice(error.code, error.what, error.remedy, Level.ERROR), failed=True)
        except BaseException as error:  # noqa: BLE001 - the last boundary of this thread: the kiosk reports it and continues
            finished = _crashed(request, error)
        self._end(finished, reporter)

    def _end(self, finished: Finished, reporter: JobReporter) -> None:
        reporter.job = replace(
            reporter.job, ended=True, failed=finished.failed, outcome=finished.outcome.text, left_s=None
        )
        self._ended[reporter.job.number] = reporter.job
        if reporter.job.appearance and not finished.failed:
            self._made = reporter.job.appearance
        while len(self._ended) > REMEMBERED:
            self._ended.popitem(last=False)
        with self._lock:
            self._finished = finished
        self._changed()


def _crashed(request: Request, error: BaseException) -> Finished:
    what = f"The job failed with an unexpected error ({type(error).__name__}: {error})."
    return Finished(request, Notice("crash", what, SEND_DIAGNOSTICS, Level.ERROR), failed=True)


def run_name(result: Mapping[str, object]) -> str:
    """The name of the run folder that a service returned."""
    return Path(str(result["run"])).name if "run" in result else ""
