"""``velatura camera``: the camera's lens, measured once with a printed board."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from controller.cli import console
from controller.cli.running import Json, work

if TYPE_CHECKING:
    from controller.run.progress import Reporter

SUMMARY: Final = "Measures the camera's lens with a printed board, once for each lens and zoom."

OutFile = Annotated[Path, typer.Option("--out", help="The file to write; stage.toml names it in [camera].")]


def board(
    out: Annotated[Path, typer.Option(help="The picture to print, a PNG.")] = Path("board.png"), as_json: Json = False
) -> None:
    """Write the ChArUco board to print, on A4 or larger, at any scale; glue it on something flat."""
    from controller.services.camera import board as written

    console.show_result(written(out=out), as_json=as_json)


def calibrate(
    photographs: Annotated[
        list[Path], typer.Argument(metavar="PHOTOS...", help="Ten to fifteen photographs of the board, tilted.")
    ],
    out: OutFile = Path("camera-intrinsics.toml"),
    as_json: Json = False,
) -> None:
    """Find focal length, principal point and distortion from photographs of the board, and how sure they are."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.services.camera import calibrate

        return calibrate(photographs=tuple(photographs), out=out, reporter=reporter, cancel=cancel)

    work(do, as_json=as_json)


def exif(
    photograph: Annotated[Path, typer.Argument(metavar="PHOTO", help="A photograph as it came from the camera.")],
    out: OutFile = Path("camera-intrinsics.toml"),
    as_json: Json = False,
) -> None:
    """Take the focal length that a photograph tells of itself: rougher than the board, and quicker."""
    from controller.services.camera import from_exif

    console.show_result(from_exif(photograph=photograph, out=out), as_json=as_json)


COMMANDS: Final[tuple[Callable[..., Any], ...]] = (board, calibrate, exif)
