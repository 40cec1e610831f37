"""``velatura live``."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from controller.cli.running import Json, StageFolder, work

if TYPE_CHECKING:
    from controller.run.progress import Reporter


def live(
    stage: StageFolder,
    source: Annotated[
        str,
        typer.Argument(
            help="A video file, a folder that receives pictures, a shared frame file, or a stream: rtsp://, udp://,"
            " ndi:// or /dev/video0."
        ),
    ],
    fps: Annotated[float, typer.Option(help="Maximum pictures per second.", min=0.1, max=240)] = 25.0,
    loop: Annotated[bool, typer.Option("--loop", help="Repeat the video, or the pictures of the folder.")] = False,
    seconds: Annotated[
        float,
        typer.Option(help="Duration in seconds (default: to the end or until Ctrl-C).", min=0, show_default=False),
    ] = 0.0,
    into: Annotated[
        Path | None,
        typer.Option(help="Use no device: write to this frame file for another player."),
    ] = None,
    targets: Annotated[
        bool, typer.Option("--targets", help="With --into: write targets, for a player with shaders.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Switch the projectors on and show a stream of targets live (base and scale)."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.stage.services.live import feed, live
        from controller.stage.sessions.session import OwnSession

        if into is not None:
            return feed(
                stage=stage, source=source, into=into, targets=targets, rate_hz=fps, loop=loop,
                seconds=seconds or None, reporter=reporter, cancel=cancel,
            )  # fmt: skip
        return live(
            session=OwnSession(stage), source=source, rate_hz=fps, loop=loop, seconds=seconds or None,
            reporter=reporter, cancel=cancel,
        )  # fmt: skip

    work(do, as_json=as_json)
