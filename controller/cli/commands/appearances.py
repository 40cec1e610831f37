"""``velatura appearance``, ``photograph``, ``play`` and ``live``."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from controller.cli.commands.calibration import AcceptGrade
from controller.cli.groups import StageFolder, appearance_names, work

if TYPE_CHECKING:
    from controller.run.progress import Reporter


@dataclass(frozen=True, slots=True)
class SolveChoice:
    """How appearances are solved, where it is not as stage.toml says."""

    scheduler: Annotated[
        str | None,
        typer.Option(help="Solve on a Dask cluster: tcp://host:8786 or tls://host:8786 (default: that of its house)."),
    ] = None
    refine: Annotated[
        int | None, typer.Option(help="Photographs that correct each result (default: from stage.toml).", min=0, max=9)
    ] = None
    device: Annotated[
        Literal["auto", "cpu", "gpu"] | None, typer.Option(help="What solves (default: from stage.toml).")
    ] = None


def appearance(
    stage: StageFolder,
    solve: SolveChoice,
    names: Annotated[
        list[str] | None, typer.Argument(help="Names from stage.toml (default: all).", autocompletion=appearance_names)
    ] = None,
    blender: Annotated[
        list[str] | None, typer.Option(help="Instead: a scene for Blender, builtin:marble, ... or a .blend file.")
    ] = None,
    accept_grade: AcceptGrade = False,
) -> None:
    """Calculate appearances, and publish them as a signed bundle. Photographs correct each result."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.stage.services.calibrate import AppearanceOrder, make_appearances
        from controller.stage.services.refine import refinement_of
        from controller.stage.sessions.session import OwnSession

        return make_appearances(
            AppearanceOrder(
                names=tuple(names or ()),
                scenes=tuple(blender or ()),
                accept_grade=accept_grade,
                scheduler=solve.scheduler,
                refinement=refinement_of(stage, solve.refine),
                device=solve.device,
            ),
            session=OwnSession(stage),
            reporter=reporter,
            cancel=cancel,
        )

    work(do, stage=stage)


def photograph(
    stage: StageFolder,
    names: Annotated[
        list[str] | None,
        typer.Argument(help="Appearances of the installed bundle (default: all).", autocompletion=appearance_names),
    ] = None,
) -> None:
    """Photograph appearances, and compare them with their targets. Writes a report."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.stage.services.compare import photograph
        from controller.stage.sessions.session import OwnSession

        return photograph(session=OwnSession(stage), names=tuple(names or ()), reporter=reporter, cancel=cancel)

    work(do, stage=stage)


def play(
    stage: StageFolder,
    names: Annotated[
        list[str] | None,
        typer.Argument(help="The appearances to show, one after the other.", autocompletion=appearance_names),
    ] = None,
    sequence: Annotated[Path | None, typer.Option(help="Instead: a TOML file with [[item]] tables.")] = None,
    seconds: Annotated[
        float,
        typer.Option(
            help="Seconds for each appearance (default: 10; a single one is shown until Ctrl-C).",
            min=0,
            show_default=False,
        ),
    ] = 0.0,
    fade: Annotated[float, typer.Option(help="Cross-fade in seconds.", min=0, max=600)] = 0,
    repeat: Annotated[
        int, typer.Option(help="How often the playlist repeats (default: until Ctrl-C).", min=0, show_default=False)
    ] = 0,
) -> None:
    """Switch the projectors on, and show appearances."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.stage.services.play import PlayRequest, play
        from controller.stage.sessions.session import OwnSession

        request = PlayRequest(tuple(names or ()), sequence, seconds or None, fade, repeat)
        return play(request, session=OwnSession(stage), reporter=reporter, cancel=cancel)

    work(do, stage=stage)


@dataclass(frozen=True, slots=True)
class LiveTargets:
    """Target pictures that change while they are shown."""

    source: Annotated[
        str,
        typer.Argument(
            help="A video file, a folder that receives pictures, a shared frame file, or a stream: rtsp://, udp://,"
            " ndi:// or /dev/video0."
        ),
    ]
    fps: Annotated[float, typer.Option(help="Maximum pictures per second.", min=0.1, max=240)] = 25.0
    loop: Annotated[bool, typer.Option("--loop", help="Repeat the video, or the pictures of the folder.")] = False
    seconds: Annotated[
        float,
        typer.Option(help="Duration in seconds (default: to the end or until Ctrl-C).", min=0, show_default=False),
    ] = 0.0


def live(
    stage: StageFolder,
    targets_shown: LiveTargets,
    into: Annotated[
        Path | None, typer.Option(help="Use no device: write to this frame file for another player.")
    ] = None,
    targets: Annotated[
        bool, typer.Option("--targets", help="With --into: write targets, for a player with shaders.")
    ] = False,
) -> None:
    """Show a video, a folder or a stream as it changes. Switches the projectors on."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.stage.services.live import LiveInput, feed, live
        from controller.stage.sessions.session import OwnSession

        shown = targets_shown
        pictures = LiveInput(shown.source, shown.fps, shown.loop, shown.seconds or None)
        if into is not None:
            return feed(pictures, into, stage=stage, targets=targets, reporter=reporter, cancel=cancel)
        return live(pictures, session=OwnSession(stage), reporter=reporter, cancel=cancel)

    work(do)
