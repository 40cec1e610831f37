"""``velatura live``: a folder, a video or a running render shown on a calibrated stage as it comes."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from controller.app import Checked, check_stage, run_on_stage
from controller.arrays import ByteImage, FloatImage
from controller.errors import UsageError
from controller.live.scaling import LiveScaler
from controller.live.sources import open_source
from controller.services import usable_calibration
from controller.session.live import LiveFigures, run_live
from controller.session.machine import Event
from controller.session.progress import Reporter
from controller.session.rig import Rig
from controller.session.runner import Context, Step
from controller.session.solving import Calibrated
from controller.solve.feasibility import choose_exposure


def live(
    *,
    stage: Path,
    source: Path,
    rate_hz: float,
    loop: bool,
    seconds: float | None,
    reporter: Reporter,
    cancel: threading.Event,
) -> Mapping[str, Any]:
    """Light the projectors and show ``source`` until it ends, ``seconds`` have passed or it is stopped.

    Raises UsageError "live-source-unreadable" or "no-base", what ``usable_calibration`` raises, and what devices raise.
    """
    checked = check_stage(stage)
    run = usable_calibration(checked, reporter)
    if not (run / "base.npz").exists():
        raise UsageError(
            "no-base",
            what="The last calibration has no solved base image yet.",
            remedy="Run `velatura appearance` on the stage first; it solves the base that live pictures scale.",
        )
    pictures = open_source(source, loop=loop, rate_hz=rate_hz)
    pictures.close()
    scaler = _scaler(checked, run)
    told: dict[str, Any] = {}

    def steps(rig: Rig, _: Path) -> Sequence[Step]:
        def show(context: Context) -> Sequence[Path]:
            def tell(figures: LiveFigures) -> None:
                now = figures.told()
                context.advance(
                    0.0 if seconds is None else min(figures.seconds / seconds, 1.0),
                    f"{now['pictures_per_s']:.1f} pictures a second, {figures.late} late",
                )

            def present(frames: Mapping[str, ByteImage]) -> None:
                rig.display.show(rig.on_outputs(dict(frames)), deadline=context.deadline.within(20))

            opened = open_source(source, loop=loop, rate_hz=rate_hz)
            figures = run_live(opened, scaler, present, rate_hz=rate_hz, seconds=seconds, tell=tell)
            told.update(figures.told())
            return ()

        return [Step("live", show, title=f"Live: {source.name}", enter=Event.PLAY, leave=Event.PAUSE, always=True)]

    run_on_stage(checked, steps, name="live", reporter=reporter, cancel=cancel)
    return told


def _scaler(checked: Checked, run: Path) -> LiveScaler:
    """Scales pictures whose white is the brightest that the stated share of the object can show."""
    calibrated = Calibrated(run, checked.names)
    transport, black = calibrated.transport, calibrated.calibration.black
    white: FloatImage = np.ones_like(black)
    share = checked.stage.tables.solve.exposure_share
    exposure = choose_exposure(transport, white, black, share=share, drive=calibrated.drive)
    return LiveScaler(calibrated.calibration, transport, calibrated.base, exposure=exposure)
