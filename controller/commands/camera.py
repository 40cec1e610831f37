"""``velatura camera``: the camera's lens, measured once with a printed board."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from controller import console
from controller.commands.running import Json, work

SUMMARY: Final = "Measures the camera's lens with a printed board, once for each lens and zoom."

OutFile = Annotated[Path, typer.Option("--out", help="The file to write; stage.toml names it in [camera].")]


def board(
    out: Annotated[Path, typer.Option(help="The picture to print, a PNG.")] = Path("board.png"), as_json: Json = False
) -> None:
    """Write the ChArUco board to print, on A4 or larger, at any scale; glue it on something flat."""
    from controller.camera_services import board as written

    console.show_result(written(out=out), as_json=as_json)


def calibrate(
    photographs: Annotated[
        list[Path], typer.Argument(metavar="PHOTOS...", help="Ten to fifteen photographs of the board, tilted.")
    ],
    out: OutFile = Path("camera-intrinsics.toml"),
    as_json: Json = False,
) -> None:
    """Find focal length, principal point and distortion from photographs of the board, and how sure they are."""
    work("controller.camera_services:calibrate", as_json=as_json, photographs=tuple(photographs), out=out)


def exif(
    photograph: Annotated[Path, typer.Argument(metavar="PHOTO", help="A photograph as it came from the camera.")],
    out: OutFile = Path("camera-intrinsics.toml"),
    as_json: Json = False,
) -> None:
    """Take the focal length that a photograph tells of itself: rougher than the board, and quicker."""
    from controller.camera_services import from_exif

    console.show_result(from_exif(photograph=photograph, out=out), as_json=as_json)


COMMANDS: Final[tuple[Callable[..., Any], ...]] = (board, calibrate, exif)
