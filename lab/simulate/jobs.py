"""The kiosk's jobs without optics: they take their time, need their devices, fail, and publish real bundles."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Final

from controller.kiosk.decide.interfaces import Finished, Request
from controller.kiosk.jobs.job_handlers import PUBLISH, QUICK, VARIANTS, JobHandlers
from controller.kiosk.jobs.job_runner import JobHandler, JobReporter
from controller.stage.rig.rig import Rig
from hal.deadline import Cancelled
from hal.errors import DeviceRefused
from hal.notices import Level, Notice
from hal.values import Power
from lab.simulate.disk import STAGE
from lab.simulate.stage import NAMES, publish
from lab.simulate.world import SimulatedWorld

SECONDS: Final = {"drift": 25.0, "quick": 90.0, "projector": 60.0, "full": 300.0, "compare": 30.0, "aim": 20.0}
_OTHER_S: Final = 40.0
_EVERY_S: Final = 5.0


class SimulatedJobs:
    """Makes the handlers of a service."""

    def __init__(self, world: SimulatedWorld) -> None:
        self._world = world

    def __call__(self, own: JobHandlers) -> Mapping[str, JobHandler]:
        """The kiosk's own table, whose refusals stay, with work of ours on a stage that is calibrated."""
        own.calibrated = lambda: True

        def do(request: Request, reporter: JobReporter, cancel: threading.Event) -> Finished:
            with self._world.busy():
                if request.light:
                    with own.lend() as rig:
                        self._photograph(rig, self._seconds(request, cancel))
                else:
                    for _ in self._seconds(request, cancel):
                        pass
            return self._end(request)

        return {kind: JobHandler(do, handler.refusal) for kind, handler in own.table().items()}

    def _seconds(self, request: Request, cancel: threading.Event) -> range:
        lasts_s = SECONDS.get(request.kind, _OTHER_S) * self._world.rng.uniform(0.5, 2.0)
        steps = range(int(lasts_s / _EVERY_S) + 1)

        class Steps:
            def __iter__(self) -> object:
                for step in steps:
                    if cancel.wait(_EVERY_S):
                        raise Cancelled
                    yield step

        return Steps()  # type: ignore[return-value]

    def _photograph(self, rig: Rig, steps: range) -> None:
        deadline = self._world.deadline
        for _ in steps:
            rig.display.show({}, deadline=deadline(10.0))
            rig.camera.capture(STAGE, deadline=deadline(10.0))
            for projector in rig.projectors:
                self._look(projector.name, projector.guard.status(deadline=deadline(10.0)).power)

    def _look(self, name: str, power: Power) -> None:
        if power is not Power.ON:
            raise DeviceRefused("lamp-went-off", what=f"The lamp of projector {name} is {power.value}.",
                                remedy="Start the job again when it is lit.")  # fmt: skip

    def _end(self, request: Request) -> Finished:
        world, then = self._world, tuple[Request, ...]()
        if request.kind == "drift":
            drifted, world.drifted = world.drifted, False
            if not drifted:
                return Finished(request, Notice("drift-none", "Nothing has moved or dimmed since the calibration."))
            changed = Notice("drift-found", "The stage has changed.", "A quick recalibration follows.", Level.WARNING)
            return Finished(request, changed, then=(Request("quick", light=QUICK.light, key=request.key),))
        if request.kind in ("quick", "projector", "full"):
            then = (Request(PUBLISH.kind, key=request.key),)
        elif request.kind in ("publish", "compute"):
            publish(STAGE, int(world.wall()))
            then = (Request(VARIANTS.kind, key=request.key),)
        elif request.kind == "variants":
            for name in NAMES:
                publish(STAGE, int(world.wall()), (name,))
        elif request.kind == "takeover":
            publish(STAGE, int(world.wall()), request.arguments)
        return Finished(request, Notice("work-done", f"Done: {request.kind}."), then=then)
