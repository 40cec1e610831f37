"""``velatura live``: shows a folder, a video or a running render live on a calibrated stage."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from controller.bundle.install import CURRENT, current
from controller.bundle.live_maps import LiveMaps
from controller.bundle.reader import Bundle
from controller.core.arrays import FloatImage
from controller.core.errors import BundleError, UsageError
from controller.core.storage import runtime_folder
from controller.optics.solve.reach.feasibility import exposures
from controller.optics.solve.scaling.interactive import Interactive
from controller.play.frames import FrameFile, FrameSet, OutputSize
from controller.play.live_stream import SILENT_S, TARGET, LiveFile
from controller.run.progress import Reporter
from controller.run.runner import Context, Step
from controller.run.state_machine import Event
from controller.run.step_id import StepId
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.live import (
    LivePicture,
    LiveSource,
    StreamSource,
    is_stream,
    open_source,
    open_stream,
    without_password,
)
from controller.stage.rig.rig import Rig
from controller.stage.sessions.calibrations import stage_trust, usable_calibration
from controller.stage.sessions.check import Checked, check_stage
from controller.stage.sessions.session import StageSession, StageWork
from controller.stage.steps.appearance.live import FrameMaker, Frames, LiveFigures, Maker, TargetMaker, run_live
from controller.stage.steps.appearance.live_parts import live_maps, target_px
from hal.codecs.player import MAGIC
from hal.deadline import Cancelled, Deadline, in_seconds
from hal.errors import DeviceError, DeviceRefused
from hal.notices import Level
from hal.values import LiveStatus

FRAMES_FILE: Final = "live.frame"
TARGETS_FILE: Final = "live-targets.frame"
"""Frame file in the stage's runtime folder that the player shows live."""
NO_SHADERS: Final = {"live-no-shaders", "display-unfit", "bundle-not-live", "bundle-none"}
"""Error codes of a player that refuses targets but accepts finished frames."""
LAST_S: Final = 0.2


@dataclass(frozen=True, slots=True)
class Ready:
    """Prepared before the lamps are lit. ``shaded``: the installed bundle has the maps for shaders."""

    maps: LiveMaps
    brightness: float
    shaded: bool


@dataclass(frozen=True, slots=True)
class LiveInput:
    """What is shown live.

    Parameters
    ----------
    source : a file, a folder, or the address of a stream
    rate_hz : maximum pictures per second
    loop : repeat a video, or the pictures of a folder
    seconds : for how long; None: until the source ends or the work is stopped
    """

    source: str
    rate_hz: float
    loop: bool = False
    seconds: float | None = None


def live(
    pictures: LiveInput, *, session: StageSession, reporter: Reporter, cancel: threading.Event
) -> Mapping[str, Any]:
    """Switch the projectors on and show ``pictures``.

    Raises UsageError "live-source-unreadable" or "live-file-unfit", WorkError "base-not-solved", what
    ``usable_calibration`` raises, and what devices raise.
    """
    checked = check_stage(session.stage)
    calibrated = _calibrated(checked, reporter)
    open_it = partial(_opened, pictures, target_px(calibrated))
    with contextlib.closing(open_it()) as tried:
        _wait_for_picture(tried)
    ready = _ready(checked, calibrated, reporter)
    figures: dict[str, Any] = {}

    def steps(rig: Rig, _: Path) -> Sequence[Step]:
        def show(context: Context) -> Sequence[Path]:
            figures.update(_show(rig, context, ready, open_it, rate_hz=pictures.rate_hz, seconds=pictures.seconds))
            return ()

        return [
            Step(
                StepId("live"),
                show,
                title=f"Live: {_name(pictures.source)}",
                enter=Event.PLAY,
                leave=Event.PAUSE,
                always=True,
            )
        ]

    session.run(checked, StageWork("live", steps), reporter=reporter, cancel=cancel)
    return figures


def _opened(pictures: LiveInput, target_px: tuple[int, int]) -> LiveSource:
    if is_stream(pictures.source):
        return open_stream(pictures.source)
    path = Path(pictures.source)
    if holds_frames(path):
        return FileSource(path, OutputSize(TARGET, *target_px))
    return open_source(path, loop=pictures.loop, rate_hz=pictures.rate_hz)


def _wait_for_picture(source: LiveSource) -> None:
    """A stream that sends nothing is refused before a lamp is lit. Raises UsageError("live-source-unreadable")."""
    if isinstance(source, StreamSource):
        source.wait_for_picture()


def _name(source: str) -> str:
    return without_password(source) if is_stream(source) else Path(source).name


def _calibrated(checked: Checked, reporter: Reporter) -> Calibrated:
    return Calibrated(usable_calibration(checked, reporter), checked.names)


def _ready(checked: Checked, calibrated: Calibrated, reporter: Reporter) -> Ready:
    """The maps, and the brightest white that the given share of the object can show."""
    maps = live_maps(calibrated, {table.name: table.output for table in checked.stage.tables.projectors})
    black = calibrated.calibration.black
    white: FloatImage = np.ones_like(black)
    share = checked.stage.tables.solve.exposure_share
    brightness, _ = exposures(calibrated.drive, white, black, share=share, indirect=calibrated.indirect)
    reporter.say(f"White of a target has the radiance {brightness:.7g}.")
    return Ready(maps, brightness, _in_bundle(checked, calibrated.folder.name))


def _in_bundle(checked: Checked, calibration: str) -> bool:
    """Whether the installed bundle has a live section of this calibration."""
    file = current(checked.stage.folder / "bundles")
    with contextlib.suppress(BundleError):
        if file is not None:
            with Bundle.open_trusted(file, stage_trust(checked.stage)) as bundle:
                return bundle.index.live is not None and bundle.index.calibration == calibration
    return False


def _show(
    rig: Rig,
    context: Context,
    ready: Ready,
    open_it: Callable[[], LiveSource],
    *,
    rate_hz: float,
    seconds: float | None,
) -> dict[str, Any]:
    display = rig.bundle_display()
    status: LiveStatus | None = None

    def report(figures: LiveFigures) -> None:
        nonlocal status
        status = display.playing(deadline=context.deadline.within(20)).live or status
        made_hz = figures.made / max(figures.seconds, 1e-3)
        context.advance(
            0.0 if seconds is None else min(figures.seconds / seconds, 1.0),
            f"{made_hz:.1f} pictures a second, {figures.late} late, {figures.bad} bad",
        )

    try:
        with live_mode(rig, context, ready) as mode:
            figures = run_live(open_it(), mode.maker, mode.write, rate_hz=rate_hz, seconds=seconds, report=report)
            # the last one is shown at the next tick of the player's clock
            context.deadline.sleep(LAST_S)
            report(figures)
    finally:
        # The lamps stay lit for a while: show black. A player that ended shows black when it restarts.
        with contextlib.suppress(DeviceError):
            display.stop(deadline=in_seconds(20))
    if figures.bad:
        context.reporter.say(
            f"{figures.bad} pictures could not be shown. The last error: {figures.trouble}", Level.WARNING
        )
    return figures.as_json() | _delivered(figures, status)


def _delivered(figures: LiveFigures, status: LiveStatus | None) -> dict[str, Any]:
    """The player's figures. Pictures that it did not show were replaced by newer ones."""
    if status is None:
        return {"shown": 0, "by": None, "shown_after_p50_ms": None, "shown_after_p99_ms": None}
    p50_ms, p99_ms = (None if s is None else 1e3 * s for s in (status.delay_p50_s, status.delay_p99_s))
    late = figures.late + max(figures.made - status.shown, 0)
    return {"shown": status.shown, "late": late, "by": status.by,
            "shown_after_p50_ms": p50_ms, "shown_after_p99_ms": p99_ms}  # fmt: skip


@dataclass(frozen=True, slots=True)
class LiveMode:
    """How pictures are shown: as targets for the player's shaders, or as finished frames."""

    maker: Maker
    write: Callable[[Frames], object]


@contextlib.contextmanager
def live_mode(rig: Rig, context: Context, ready: Ready) -> Iterator[LiveMode]:
    """Start live mode in the player in a way that it supports, and end it on leaving; the picture stays.

    Raises what devices raise.
    """
    display, folder = rig.bundle_display(), runtime_folder(rig.stage)
    deadline = context.deadline.within(60)
    if ready.shaded:
        size = OutputSize(TARGET, *ready.maps.target_px)
        with _fresh(folder / TARGETS_FILE, [size]) as file:
            if _takes_targets(rig, file.path, ready.brightness, deadline):
                yield LiveMode(TargetMaker(ready.maps.target_px), _target_writer(file))
                return
    outputs = [OutputSize(o.name, o.width_px, o.height_px) for o in display.outputs(deadline=deadline)]
    with _fresh(folder / FRAMES_FILE, outputs) as file:
        display.live(file.path, deadline=deadline)
        yield LiveMode(FrameMaker(Interactive(ready.maps), ready.brightness), _writer(file, outputs, ready.maps))


def _takes_targets(rig: Rig, path: Path, white: float, deadline: Deadline) -> bool:
    display = rig.bundle_display()
    display.load_bundle(rig.stage / "bundles" / CURRENT, deadline=deadline)
    try:
        display.live(path, white=white, deadline=deadline)
    except DeviceRefused as error:
        if error.code not in NO_SHADERS:
            raise
        return False
    return True


@contextlib.contextmanager
def _fresh(path: Path, outputs: Sequence[OutputSize]) -> Iterator[FrameFile]:
    """A frame file without an old picture, removed on leaving."""
    path.unlink(missing_ok=True)
    file = FrameFile(path, outputs)
    try:
        yield file
    finally:
        file.close()
        path.unlink(missing_ok=True)


def _writer(file: FrameFile, outputs: Sequence[OutputSize], maps: LiveMaps) -> Callable[[Frames], object]:
    """Writes frames in the maps' order to a file of ``outputs``; those without a projector stay black."""
    black = {output.name: image for output, image in zip(outputs, FrameSet.black(outputs).pixels, strict=True)}
    names = [output.name for output in maps.outputs]

    def write(frames: Frames) -> None:
        found = black | dict(zip(names, frames, strict=True))
        file.write(FrameSet(tuple(found[output.name] for output in outputs)))

    return write


def feed(
    pictures: LiveInput, into: Path, *, stage: Path, targets: bool, reporter: Reporter, cancel: threading.Event
) -> Mapping[str, Any]:
    """Write ``pictures`` to the frame file ``into``, for another player to show live.

    Writes finished frames, or with ``targets`` targets for the bundle's live section. Uses no device. The file stays,
    with its last picture.
    """
    checked = check_stage(stage)
    calibrated = _calibrated(checked, reporter)
    source = _opened(pictures, target_px(calibrated))
    _wait_for_picture(source)
    ready = _ready(checked, calibrated, reporter)
    outputs = [OutputSize(o.name, o.width_px, o.height_px) for o in checked.stage.tables.display.outputs]
    if targets:
        outputs = [OutputSize(TARGET, *ready.maps.target_px)]
    with contextlib.closing(FrameFile(into, outputs)) as file:
        maker = TargetMaker(ready.maps.target_px) if targets else FrameMaker(Interactive(ready.maps), ready.brightness)
        write = _target_writer(file) if targets else _writer(file, outputs, ready.maps)

        def report(figures: LiveFigures) -> None:
            if cancel.is_set():
                raise Cancelled

        figures = run_live(source, maker, write, rate_hz=pictures.rate_hz, seconds=pictures.seconds, report=report)
    return {"white": ready.brightness, **figures.as_json()}


def _target_writer(file: FrameFile) -> Callable[[Frames], object]:
    return lambda frames: file.write(FrameSet(tuple(frames)))


def holds_frames(path: Path) -> bool:
    """Whether ``path`` is a frame file."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


class FileSource:
    """The newest picture that another process wrote there; see ``controller.stage.live.LiveSource``."""

    def __init__(self, path: Path, size: OutputSize) -> None:
        """Raises UsageError("live-file-unfit"), naming both sizes."""
        self._path, self._file = path, LiveFile(path, [size])
        self._set = FrameSet.black([size])
        self._number = 0
        self._heard_s = time.monotonic()
        self._told_gone = False

    def next(self, at_s: float) -> LivePicture | None:
        """See ``LiveSource``. Raises UsageError("live-source-gone") once when the writer ended; it may come back."""
        if self._file.newest(self._set) is not None:
            self._heard_s, self._told_gone = time.monotonic(), False
            self._number += 1
            return LivePicture(self._set.pixels[0], self._number - 1, 0)
        if time.monotonic() - self._heard_s > SILENT_S:
            self._heard_s = time.monotonic()
            self._file = self._file.reopened() or self._file
            if not self._file.has_writer() and not self._told_gone:
                self._told_gone = True
                raise UsageError(
                    "live-source-gone",
                    what=f"The source of {self._path} has ended. The last picture stays.",
                    remedy="Restart the source; playback resumes.",
                )
        return None

    @property
    def ended(self) -> bool:
        """False: a writer may come back at any time."""
        return False

    def close(self) -> None:
        """Release the mapping."""
        self._file.close()
